// Dynamics: the tool point's frequency response, its resonance over time, and the lobes with the working point.

import { h, put, card, absent, number, unit, NONE } from "../dom.js";
import { Chart } from "../charts.js";
import { ask, Refused } from "../api.js";

const COLOURS = ["--c1", "--c2", "--c3", "--c4"];

export async function page(place, context) {
  place.append(h("h1", { class: "hidden" }, "Dynamics"));
  let found;
  try {
    found = await ask("dynamics");
  } catch (error) {
    if (!(error instanceof Refused) || error.status !== 404) throw error;
    place.append(absent("Dynamics are not configured", `${error.message[0].toUpperCase()}${error.message.slice(1)}.`,
      "Toolpoint models spindle, holder and tool from their drawings, identifies the bearings from an impact test, and then shows here where a cut is stable."));
    return {};
  }
  return new Dynamics(place, found);
}

class Dynamics {
  constructor(place, found) {
    this.facts = h("div", {});
    const charts = [];
    const grid = h("div", { class: "grid" }, h("div", { class: "third" }, this.facts));
    const add = (title, words, chart, data, classes) => {
      charts.push(chart);
      grid.append(h("section", { class: `card ${classes}`, "aria-label": title }, h("h2", {}, title), words && h("p", { class: "dim" }, words), chart.element));
      queueMicrotask(() => chart.set(data));
    };
    this.charts = charts;
    place.append(grid);
    if (found.lobes) this.lobes(found, add);
    if (found.response) this.response(found.response, add);
    if (found.resonance) this.resonance(found.resonance, add);
    this.describe(found);
  }

  leave() { for (const chart of this.charts) chart.remove(); }

  describe(found) {
    const point = found.working_point ?? {};
    put(this.facts, card("Operation now", h("dl", { class: "facts" },
      h("dt", {}, "operation"), h("dd", {}, found.operation ?? NONE),
      h("dt", {}, "spindle speed"), h("dd", {}, unit(point.speed_rpm, "1/min", 0)), h("dt", {}, "depth of cut"), h("dd", {}, unit(point.depth_mm, "mm", 2)),
      h("dt", {}, "limiting depth"), h("dd", {}, unit(point.limiting_depth_mm, "mm", 2)), h("dt", {}, "state"), h("dd", {}, found.state ?? NONE), h("dt", {}, "why"), h("dd", {}, found.why ?? NONE))));
  }

  lobes({ lobes, working_point: point }, add) {
    const chart = new Chart({ title: "Stability lobes", caption: "Below the line a cut is stable; above it, it chatters.", unit: "depth of cut [mm]", unit_short: "mm", digits: 2,
      x: { label: "spindle speed [1/min]", unit: "1/min" }, height: 18, floor: 0, series: [{ label: "limiting depth", colour: "--c3", width: 2.2, fill: "--stable" }],
      marks: point?.speed_rpm ? [{ x: point.speed_rpm, y: point.depth_mm, words: `working point ${number(point.speed_rpm, 0)} 1/min`, colour: "--mark" }] : [] });
    add("Stability lobes", "", chart, [lobes.speed_rpm, lobes.limiting_depth_mm], "wide");
  }

  response({ frequency_hz: frequency, magnitude_um_per_n: by_axis }, add) {
    const names = Object.keys(by_axis);
    const chart = new Chart({ title: "Tool point's frequency response", unit: "receptance [µm/N]", unit_short: "µm/N", digits: 3, log: true,
      x: { label: "frequency [Hz]", unit: "Hz" }, height: 15, series: names.map((name, index) => ({ label: name, colour: COLOURS[index] })) });
    add("Tool point's frequency response", "", chart, [frequency, ...names.map((name) => by_axis[name])], "half");
  }

  resonance({ t, hz }, add) {
    const names = Object.keys(hz);
    const chart = new Chart({ title: "Resonance over time", unit: "frequency [Hz]", unit_short: "Hz", height: 15, least: 5, series: names.map((name, index) => ({ label: name, colour: COLOURS[index], points: t.length < 4 })) });
    add("Resonance over time", "The spindle's bearings change with its temperature, and the resonance with them.", chart, [t, ...names.map((name) => hz[name])], "half");
  }
}

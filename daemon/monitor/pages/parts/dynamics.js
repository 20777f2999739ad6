// Dynamics: the tool point's frequency response, its resonance over time, and the lobes with the working point.

import { h, put, card, absent, number, unit, NONE } from "../dom.js";
import { Chart } from "../charts.js";
import { ask, Refused } from "../api.js";

const COLOURS = ["--c1", "--c2", "--c3", "--c4"];
const AGAIN_MS = 5000;

export async function page(place, context) {
  place.append(h("h1", { class: "hidden" }, "Dynamics"));
  try {
    const view = new Dynamics(place, await ask("dynamics"));
    view.timer = setInterval(() => ask("dynamics").then((found) => view.show(found)).catch(() => {}), AGAIN_MS);
    return view;
  } catch (error) {
    if (!(error instanceof Refused) || error.status !== 404) throw error;
    place.append(absent("Dynamics are not configured", `${error.message[0].toUpperCase()}${error.message.slice(1)}.`,
      "Toolpoint models spindle, holder and tool from their drawings, identifies the bearings from an impact test, and then shows here where a cut is stable."));
    return {};
  }
}

class Dynamics {
  constructor(place, found) {
    this.facts = h("div", { class: "third" });
    this.grid = h("div", { class: "grid" }, this.facts);
    this.charts = {};
    this.drawn = {};
    place.append(this.grid);
    this.show(found);
  }

  leave() {
    clearInterval(this.timer);
    for (const chart of Object.values(this.charts)) chart.remove();
  }

  show(found) {
    this.describe(found);
    if (found.lobes) this.lobes(found);
    if (found.response) this.response(found.response);
    if (found.resonance) this.resonance(found.resonance);
  }

  // Draw a chart, or what is new in it.
  draw(name, heading, words, classes, data, changes, make) {
    const fresh = JSON.stringify([data, changes]);
    if (this.drawn[name] === fresh) return;
    this.drawn[name] = fresh;
    if (!this.charts[name]) {
      this.charts[name] = make();
      this.grid.append(h("section", { class: `card ${classes}`, "aria-label": heading }, h("h2", {}, heading), words && h("p", { class: "dim note" }, words), this.charts[name].element));
    }
    this.charts[name].set(data, changes);
  }

  describe(found) {
    const point = found.working_point;
    put(this.facts, card("Operation now", h("dl", { class: "facts" },
      h("dt", {}, "operation"), h("dd", {}, found.operation ?? NONE),
      h("dt", {}, "spindle speed"), h("dd", {}, unit(point.speed_rpm, "1/min", 0)), h("dt", {}, "target"), h("dd", {}, unit(point.target_rpm, "1/min", 0)), h("dt", {}, "depth of cut"), h("dd", {}, unit(point.depth_mm, "mm", 2)),
      h("dt", {}, "limiting depth"), h("dd", {}, unit(point.limiting_depth_mm, "mm", 2)), h("dt", {}, "state"), h("dd", {}, found.state), h("dt", {}, "why"), h("dd", {}, found.why || NONE)),
    !found.lobes && h("p", { class: "dim" }, "Lobes, frequency response and resonance appear with the first plan: when the NC program announces an operation.")));
  }

  lobes({ lobes, working_point: point }) {
    const marks = point.speed_rpm && point.depth_mm ? [{ x: point.speed_rpm, y: point.depth_mm, words: `working point, ${number(point.speed_rpm, 0)} 1/min`, colour: "--mark" }] : [];
    const elsewhere = point.target_rpm && Math.abs(point.target_rpm - (point.speed_rpm ?? 0)) > 1;
    if (elsewhere && point.depth_mm) marks.push({ x: point.target_rpm, y: point.depth_mm, words: `target, ${number(point.target_rpm, 0)} 1/min`, colour: "--with", below: true });
    this.draw("lobes", "Stability lobes", "", "wide", [lobes.speed_rpm, lobes.limiting_depth_mm], { marks }, () => new Chart({ title: "Stability lobes",
      caption: "Below the line a cut is stable; above it, it chatters.", unit: "depth of cut [mm]", unit_short: "mm", digits: 2, x: { label: "spindle speed [1/min]", unit: "1/min" }, height: 18, floor: 0,
      series: [{ label: "limiting depth", colour: "--c3", width: 2.2, fill: "--stable" }] }));
  }

  response({ frequency_hz: frequency, magnitude_um_per_n: by_axis }) {
    const names = Object.keys(by_axis);
    this.draw("response", "Tool point's frequency response", "", "half", [frequency, ...names.map((name) => by_axis[name])], {}, () => new Chart({ title: "Tool point's frequency response",
      unit: "receptance [µm/N]", unit_short: "µm/N", digits: 3, log: true, x: { label: "frequency [Hz]", unit: "Hz" }, height: 15, series: names.map((name, index) => ({ label: name, colour: COLOURS[index], dash: index % 2 ? [8, 6] : undefined })) }));
  }

  resonance({ t, hz }) {
    const names = Object.keys(hz);
    this.draw("resonance", "Resonance over time", "The spindle's bearings change with its temperature, and the resonance with them.", "half", [t, ...names.map((name) => hz[name])], {},
      () => new Chart({ title: "Resonance over time", unit: "frequency [Hz]", unit_short: "Hz", height: 15, least: 5, series: names.map((name, index) => ({ label: name, colour: COLOURS[index], points: t.length < 4 })) }));
  }
}

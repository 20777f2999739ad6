// Thermal error: the estimate with its band against what is measured, and which sensors it comes from.

import { h, s, put, buttons, choice, card, table, number, signed, um, per, duration, clock, NONE } from "../dom.js";
import { RANGES } from "../words.js";
import { Chart } from "../charts.js";
import { ask, newest, series } from "../api.js";
import { aligned, at, begun, beside, bridge, each, held, since } from "../series.js";

const POINTS = 600;
const SHOWN = 12;

export async function page(place, context) {
  const view = new ThermalError(context);
  place.append(h("h1", { class: "hidden" }, "Thermal error"), view.element);
  await view.load();
  view.timer = setInterval(() => view.window === null && view.load(), 20000);
  return view;
}

class ThermalError {
  constructor({ live }) {
    this.live = live;
    this.range_s = 28800;
    this.window = null;
    this.channel = null;
    this.asking = newest();
    const zoom = (from, to) => { this.window = [from, to]; this.load(); };
    this.error = new Chart({ title: "Estimated and measured thermal error", caption: "Since the reference, without what the compensation moved; shaded: the band in which the true error is expected.", unit: "thermal error [µm]", unit_short: "µm", height: 19, least: 1, zoom,
      series: [{ label: "estimated", colour: "--with", width: 2.2 }, { label: "measured", colour: "--without", width: 1.8 }, { label: "", colour: "--with", hidden: true }, { label: "", colour: "--with", hidden: true }], bands: [{ upper: 3, lower: 4, colour: "--band" }] });
    this.rest = new Chart({ title: "Residual: measured minus estimated", caption: "Measured minus estimated; shaded: the band.", unit: "residual [µm]", unit_short: "µm", height: 11, least: 1, zoom,
      series: [{ label: "residual", colour: "--c4", width: 1.8 }, { label: "", colour: "--with", hidden: true }, { label: "", colour: "--with", hidden: true }], bands: [{ upper: 2, lower: 3, colour: "--band" }] });
    this.choose = h("span", { class: "actions" });
    this.facts = h("div", {});
    this.parts = h("div", {});
    this.marks = h("div", {});
    this.element = h("div", { class: "grid" },
      h("section", { class: "card" }, h("div", { class: "between" }, h("h2", {}, "Estimated against measured"),
        h("span", { class: "actions" }, this.choose, buttons("Range", RANGES.slice(0, 6), this.range_s, (range) => { this.range_s = range; this.window = null; this.load(); }),
          h("button", { type: "button", class: "quiet", onclick: () => { this.window = null; this.load(); } }, "Back to now"))), this.error.element, this.rest.element),
      h("div", { class: "third" }, this.facts), h("div", { class: "third" }, this.parts), h("div", { class: "third" }, this.marks));
  }

  leave() {
    clearInterval(this.timer);
    this.error.remove();
    this.rest.remove();
  }

  async load() {
    const { status } = this.live;
    if (!status) { setTimeout(() => this.element.isConnected && this.load(), 300); return; }
    const wanted_still = this.asking();
    try {
      const estimate = await ask("estimate");
      if (!wanted_still()) return;
      const channels = Object.keys(estimate.channels);
      this.channel ??= channels.includes("Z1") ? "Z1" : channels[0] ?? null;
      if (this.choose.children.length === 0 && channels.length > 1) {
        const axes = (name) => estimate.channels[name].axes.map((axis) => axis.toUpperCase()).join(", ");
        this.choose.append(choice("Channel", channels.map((name) => [name, axes(name) ? `${name}, axis ${axes(name)}` : name]), this.channel, (name) => { this.channel = name; this.load(); }));
      }
      this.describe(estimate, status);
      if (this.channel !== null) await this.draw(estimate, status, wanted_still);
      else this.error.note.textContent = estimate.why || "There is no estimate yet.";
    } catch (error) {
      if (wanted_still()) this.error.note.textContent = error.message;
    }
  }

  async draw(estimate, status, wanted_still) {
    const [from, to] = this.window ?? [await begun(status.time - this.range_s, status.time), status.time];
    const { channel } = this;
    const axis = Object.keys(status.axes).find((name) => status.axes[name].channel === channel);
    const names = [`estimated.${channel}`, `measured.${channel}`, `band.${channel}`, ...(axis ? [`applied.${axis}`] : [])];
    const answers = await series(names, from, to, POINTS);
    if (!wanted_still()) return;
    const [t, estimated, with_applied, band, applied] = aligned(answers, names.map((name) => [name, "mean"]), from, to, POINTS);
    const marks = estimate.references.map((mark) => mark.time).filter((time) => time >= from && time <= to);
    // the displacement sensors see the compensation too: what it moved is taken off
    const moved = held(applied ?? t.map(() => 0));
    const raw = with_applied.map((value, index) => (typeof value === "number" ? value - (moved[index] ?? 0) : value));
    const first = raw.find((value) => typeof value === "number") ?? 0;
    // the estimate is zero at the reference, so what was measured there is taken off
    const start = since(t, marks, (mark) => (mark === null ? first - (estimated.find((value) => typeof value === "number") ?? 0) : at(t, raw, mark) ?? after(t, raw, mark) ?? first));
    const sloped = typeof estimate.channels[channel].pivot_mm === "number";
    const measured = sloped ? raw.map((value) => (value === undefined ? undefined : null)) : each(raw, start, (value, origin) => value - origin);
    const spread = bridge(band);
    const [upper, lower] = beside(estimated, band);
    const shown = marks.map((x) => ({ x, words: "reference" }));
    this.error.options.marks = this.rest.options.marks = shown;
    const unit = per(estimate.channels[channel]);
    await this.error.set([t, estimated, measured, upper, lower], { unit: `thermal error [${unit}]`, unit_short: unit, note: sloped ? `Estimated at ${number(estimate.channels[channel].pivot_mm, 0)} mm, the pivot of the slope of axis ${axis.toUpperCase()}. What was measured, where the axis stood, is not drawn: below it is judged there for now, and \`toolpoint model drift\` judges the past.` : "" });
    const bridged = bridge(estimated);
    const residual = measured.map((value, index) => (typeof value === "number" && typeof bridged[index] === "number" ? value - bridged[index] : value === undefined ? undefined : null));
    await this.rest.set([t, residual, spread, spread.map((value) => (typeof value === "number" ? -value : value))], { unit: `residual [${unit}]`, unit_short: unit });
    if (!sloped && !raw.some((value) => typeof value === "number")) {
      this.rest.note.textContent = "Nothing was measured in this time: the residual needs displacement sensors (section displacements of the configuration). Compensation runs without them.";
    }
  }

  describe(estimate, status) {
    const one = estimate.channels[this.channel];
    put(this.facts, card("Now", estimate.why ? h("p", {}, estimate.why) : h("dl", { class: "facts" },
      h("dt", {}, "estimated"), h("dd", {}, h("b", {}, um(one?.thermal_error_um, one))), h("dt", {}, "band"), h("dd", {}, one?.band_um === null || !one ? NONE : `± ${number(one.band_um)} ${per(one)}`),
      typeof one?.pivot_mm === "number" && [h("dt", {}, "where"), h("dd", {}, `estimated at ${number(one.pivot_mm, 0)} mm, the slope's pivot; measured ${one.position_mm === null ? "nobody knows where" : `at ${number(one.position_mm, 0)} mm, and compared with the estimate there`}`)],
      h("dt", {}, "measured"), h("dd", {}, one?.not_judged ? `not judged: ${one.not_judged}` : um(one?.measured_um, one)), h("dt", {}, "residual"), h("dd", {}, um(one?.residual_um, one)),
      h("dt", {}, "confidence"), h("dd", {}, estimate.confidence === null ? NONE : `${number(100 * estimate.confidence, 0)} % of the model's weight rests on sensors with a usable value`),
      h("dt", {}, "range"), h("dd", {}, estimate.in_domain === false ? "outside the temperatures of the training: the estimate is not followed" : "within the temperatures of the training"),
      h("dt", {}, "imputed"), h("dd", {}, estimate.imputed.length ? `sensors ${estimate.imputed.join(", ")}` : "no sensor"),
      h("dt", {}, "model"), h("dd", {}, estimate.model_id ?? NONE))));
    const parts = one?.contributions;
    put(this.parts, parts ? card("Which sensors contribute how much", contributions(parts, per(one)))
      : card("Which sensors contribute how much", h("p", { class: "dim" }, one ? "This kind of model does not say." : "There is no estimate yet.")));
    const marks = [...estimate.references].reverse();
    put(this.marks, card("Reference marks, last 24 h", marks.length
      ? table(["set at", "by", "ago"], marks.slice(0, 10).map((mark) => [clock(mark.time), mark.source, duration(status.time - mark.time)]), { caption: "Reference marks", classes: "marks" })
      : h("p", { class: "dim" }, "None: a reference is set after work positioning, by the NC program or by hand.")));
  }
}

function after(t, values, instant) {
  const index = t.findIndex((time, place) => time >= instant && typeof values[place] === "number");
  return index < 0 ? null : values[index];
}

function contributions(parts, unit) {
  const most = Math.max(...parts.map((part) => Math.abs(part.um)), 0.1);
  const rest = parts.slice(SHOWN);
  const rows = parts.slice(0, SHOWN).map((part) => [`${part.sensor} ${part.part ?? part.component}`, part.um]);
  if (rest.length) rows.push([`${rest.length} others`, rest.reduce((sum, part) => sum + part.um, 0)]);
  return h("table", { class: "bars" }, h("caption", { class: "hidden" }, `Contribution of each sensor in ${unit}`), h("colgroup", {}, h("col"), h("col"), h("col")), h("tbody", {}, rows.map(([words, value]) => h("tr", {},
    h("td", { title: words }, words), h("td", {}, `${signed(value)} ${unit}`), h("td", {}, bar(value, most))))));
}

function bar(value, most) {
  const share = (48 * Math.abs(value)) / most;
  return s("svg", { viewBox: "0 0 100 12", width: "100%", height: 12, preserveAspectRatio: "none", "aria-hidden": "true" },
    s("rect", { x: value < 0 ? 50 - share : 50, y: 2, width: share, height: 8, fill: `var(${value < 0 ? "--without" : "--with"})` }),
    s("line", { x1: 50, x2: 50, y1: 0, y2: 12, stroke: "var(--dim)" }));
}

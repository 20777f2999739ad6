// Temperatures: every sensor in a list and on a drawing of the machine, and what was recorded of those that are chosen.

import { h, put, buttons, choice, number, duration, clock } from "../dom.js";
import { RANGES } from "../words.js";
import { Chart } from "../charts.js";
import { ask, newest, series } from "../api.js";
import { aligned, begun } from "../series.js";
import { MachineDrawing, title } from "../machine.js";

const MOST = 8;
const POINTS = 700;
const QUALITY = ["good", "held", "missing"];

export async function page(place, context) {
  const found = await ask("sensors");
  const view = new Temperatures(found, context);
  place.append(h("h1", { class: "hidden" }, "Temperatures"), view.element);
  view.start();
  return view;
}

class Temperatures {
  constructor(found, { live }) {
    this.live = live;
    this.sensors = found.sensors;
    this.by = "component";
    this.words = "";
    this.range_s = RANGES[1][0];
    this.window = null;
    this.asking = newest();
    const labelled = [...new Set(this.sensors.map((sensor) => sensor.label).filter(Boolean))].map((label) => `label.${label}`);
    this.labels = labelled;
    this.chosen = labelled.length ? labelled.slice(0, 4) : this.sensors.slice(0, 3).map((sensor) => sensor.name);
    this.drawing = new MachineDrawing(this.sensors, (name) => this.toggle(name));
    this.list = h("div", {});
    this.faults = h("div", {});
    this.age = h("p", {});
    this.chart = new Chart({ title: "Chosen temperatures", caption: "Drag across the chart to look closer.", unit: "temperature [°C]", unit_short: "°C", digits: 2, height: 19, least: 0.1, series: [],
      zoom: (from, to) => { this.window = [from, to]; this.load(); } });
    const whole = h("button", { type: "button", class: "quiet", onclick: () => { this.window = null; this.load(); } }, "Back to now");
    const search = h("input", { type: "search", id: "search", placeholder: "number or name", oninput: (event) => { this.words = event.target.value; this.rows(); } });
    this.element = h("div", { class: "grid" },
      h("section", { class: "card" },
        h("div", { class: "between" }, h("h2", {}, "Chosen temperatures"),
          h("span", { class: "actions" }, buttons("Range", RANGES, this.range_s, (range) => { this.range_s = range; this.window = null; this.load(); }), whole)),
        this.chart.element),
      h("section", { class: "card half" }, h("h2", {}, "The machine, coloured by temperature"), h("div", { class: "scroll whole", tabindex: "0", role: "region", "aria-label": "Sketch of the machine" }, this.drawing.drawing),
        h("p", { class: "dim note" }, "A sketch from the names of the components in the machine's file; a click on a sensor adds it to the chart.")),
      h("section", { class: "card half" }, this.age, this.faults,
        h("div", { class: "between" }, h("h2", {}, `Sensors (${this.sensors.length})`),
          h("span", { class: "actions" }, choice("by", [["component", "component"], ["part", "part"], ["label", "label"], ["degc", "temperature"]], this.by, (by) => { this.by = by; this.rows(); }),
            h("label", { class: "choice" }, h("span", {}, "find"), search))),
        this.list));
  }

  start() {
    this.live.want(true);
    this.rows();
    this.show();
    this.load();
    this.timer = setInterval(() => { if (this.window === null && this.range_s <= 86400) this.load(); }, 15000);
  }

  leave() {
    this.live.want(false);
    clearInterval(this.timer);
    this.chart.remove();
  }

  status({ age_s: age }) {
    this.age.className = age === null || age > 60 ? "said" : "dim";
    put(this.age, age === null ? "No temperature has arrived yet." : `The newest temperature is ${duration(age)} old.`);
  }

  cycle({ degc: values, quality, reason }) {
    if (values.length !== this.sensors.length) return;
    this.sensors.forEach((sensor, index) => {
      sensor.degc = values[index];
      const now = QUALITY[quality[index]] ?? "missing";
      if (now !== sensor.quality) this.reasons = true;
      sensor.quality = now;
      if (reason) sensor.reason = reason[index] ?? "";
    });
    if (this.reasons) this.learn();
    this.show();
  }

  // Why a sensor is not good comes with the list, not with every cycle.
  async learn() {
    this.reasons = false;
    const found = await ask("sensors");
    found.sensors.forEach((sensor, index) => Object.assign(this.sensors[index], sensor));
    this.rows();
    this.show();
  }

  show() {
    this.drawing.show(this.sensors, this.chosen);
    for (const [sensor, cell] of this.cells ?? []) cell.textContent = number(sensor.degc, 2);
    const bad = this.sensors.filter((sensor) => sensor.quality !== "good");
    put(this.faults, bad.length > 0 && h("div", { class: "faulty" }, h("h2", {}, `Not good (${bad.length})`), h("ul", { class: "checks" }, bad.slice(0, 12).map((sensor) =>
      h("li", { class: sensor.degc === null ? "no" : "wait" }, h("span", {}, title(sensor), h("small", {}, `${sensor.quality}: ${sensor.reason}${sensor.age_s === null ? "" : `; last good ${duration(sensor.age_s)} ago`}`))))),
    bad.length > 12 && h("p", { class: "dim" }, `and ${bad.length - 12} more`)));
  }

  rows() {
    const asked = this.words.toLowerCase().split(/\s+/).filter(Boolean);
    const fits = (sensor) => { const words = `${title(sensor)} ${sensor.quality}`.toLowerCase(); return asked.every((word) => words.includes(word)); };
    const key = { component: (one) => one.component, part: (one) => one.part ?? "", label: (one) => one.label ?? "￿", degc: (one) => -(one.degc ?? -999) }[this.by];
    const found = this.sensors.filter(fits).map((sensor) => [key(sensor), sensor]).sort(([a, x], [b, y]) => (a < b ? -1 : a > b ? 1 : x.id - y.id)).map(([, sensor]) => sensor);
    this.cells = [];
    const rows = found.map((sensor) => {
      const value = h("td", {}, number(sensor.degc, 2));
      this.cells.push([sensor, value]);
      return this.row(sensor.name, [[sensor.component, sensor.part && h("small", {}, sensor.part)], sensor.label ?? ""], `Sensor ${sensor.id}`, value, sensor.quality);
    });
    const means = this.by === "label" && !asked.length ? this.labels.map((name) => this.row(name, ["mean of its sensors", name.slice(6)], `Label ${name.slice(6)}`, h("td", {}), "good")) : [];
    this.list.replaceChildren(h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Sensors" }, h("table", { class: "sensors" }, h("thead", {}, h("tr", {},
      ["chart", "component, part", "label", "now [°C]"].map((words) => h("th", { scope: "col" }, words)))), h("tbody", {}, means, rows))));
    if (!rows.length) this.list.append(h("p", { class: "dim" }, "No sensor has these words."));
  }

  row(name, cells, words, value, quality) {
    const box = h("input", { type: "checkbox", checked: this.chosen.includes(name), "aria-label": `${words} in the chart`, onchange: () => this.toggle(name) });
    return h("tr", {}, h("td", {}, h("label", { class: "choice" }, box, words.replace("Sensor ", ""), quality !== "good" && h("span", { class: "tag bad" }, quality))), cells.map((cell) => h("td", {}, cell)), value);
  }

  toggle(name) {
    this.chosen = this.chosen.includes(name) ? this.chosen.filter((other) => other !== name) : [...this.chosen.slice(-MOST + 1), name];
    this.rows();
    this.show();
    this.load();
  }

  async load() {
    const { status } = this.live;
    if (!status) { setTimeout(() => this.element.isConnected && this.load(), 300); return; }
    const began = performance.now(), wanted_still = this.asking();
    const [from, to] = this.window ?? [await begun(status.time - this.range_s, status.time), status.time];
    const names = this.chosen;
    try {
      const answers = names.length ? await series(names, from, to, POINTS) : {};
      if (!wanted_still()) return;
      const single = names.length === 1;
      const wanted = single ? [[names[0], "mean"], [names[0], "max"], [names[0], "min"]] : names.map((name) => [name, "mean"]);
      const data = aligned(answers, wanted, from, to, POINTS);
      await this.chart.set(data, {
        series: single ? [{ label: this.words_of(names[0]), colour: "--c1" }, ...[1, 2].map(() => ({ label: "", colour: "--c1", hidden: true }))] : names.map((name, index) => ({ label: this.words_of(name), colour: `--c${index + 1}` })),
        bands: single ? [{ upper: 2, lower: 3, colour: "--band" }] : [],
        note: single ? "shaded: least and greatest of each piece of time" : `from ${clock(from, { date: true })}`,
      });
      await new Promise(requestAnimationFrame); // it is on the screen then
      performance.measure(`temperatures ${names.length} over ${Math.round(to - from)} s`, { start: began });
    } catch (error) {
      if (wanted_still()) this.chart.note.textContent = error.message;
    }
  }

  words_of(name) {
    const [kind, key] = [name.split(".")[0], name.slice(name.indexOf(".") + 1)];
    if (kind === "label") return `mean of ${key}`;
    const sensor = this.sensors.find((one) => one.name === name);
    return `${key} ${sensor?.part ?? sensor?.component ?? ""}`;
  }
}

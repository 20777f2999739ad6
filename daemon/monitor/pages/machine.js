// A drawing of the machine: its components as boxes where they stand, their sensors as dots coloured by temperature.

import { h, s } from "./dom.js";

// Where a component stands, by the words of its name: [pattern, x, y, width, height] on a sheet of 1000 x 600,
// seen from the side. What no pattern knows goes on a shelf at the right.
const PLACES = [
  [/ambient|room|air/i, 70, 14, 390, 66],
  [/spindle|ram|head|quill/i, 70, 96, 170, 270],
  [/slid|carriage/i, 256, 96, 150, 190],
  [/saddle|cross/i, 422, 96, 150, 330],
  [/column|frame|portal|gantry/i, 588, 96, 152, 330],
  [/trunnion|table|rotary|chuck/i, 70, 386, 336, 60],
  [/bed|base/i, 70, 466, 670, 110],
  [/cool|chill|oil|hydraulic/i, 476, 14, 264, 66],
];
const SHELF = { x: 770, y: 150, width: 210, height: 100, step: 112 };

// viridis, which is read alike with every kind of colour vision and in grey
const SCALE = ["#440154", "#482878", "#3e4a89", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6ece58", "#b5de2b", "#fde725"];

export function colour(value, low, high) {
  if (value === null || value === undefined) return "none";
  const place = Math.min(Math.max((value - low) / Math.max(high - low, 1e-9), 0), 1) * (SCALE.length - 1);
  const index = Math.min(SCALE.length - 2, Math.floor(place)), share = place - index;
  const channel = (start) => Math.round(parseInt(SCALE[index].slice(start, start + 2), 16) * (1 - share) + parseInt(SCALE[index + 1].slice(start, start + 2), 16) * share);
  return `rgb(${channel(1)} ${channel(3)} ${channel(5)})`;
}

// Bounds of the colours: whole degrees around all that is usable but the outermost few.
export function bounds(sensors) {
  const known = sensors.map((sensor) => sensor.degc).filter((value) => value !== null).sort((a, b) => a - b);
  if (!known.length) return [15, 35];
  const cut = Math.floor(known.length / 40);
  const low = Math.floor(known[cut]), high = Math.ceil(known[known.length - 1 - cut]);
  return [low, Math.max(high, low + 2)];
}

export class MachineDrawing {
  constructor(sensors, choose) {
    this.dots = new Map();
    this.drawing = s("svg", { class: "machine", viewBox: "0 0 1000 600", role: "group", "aria-label": "The machine and its temperature sensors" });
    const components = [...new Set(sensors.map((sensor) => sensor.component))];
    const taken = new Set();
    let shelf = SHELF.y;
    for (const component of components) {
      const known = PLACES.findIndex(([pattern], place) => pattern.test(component) && !taken.has(place));
      let box = PLACES[known]?.slice(1);
      if (known >= 0) taken.add(known);
      else {
        box = [SHELF.x, shelf, SHELF.width, SHELF.height];
        shelf += SHELF.step;
      }
      this.component(component, sensors.filter((sensor) => sensor.component === component), box, choose);
    }
    this.drawing.setAttribute("viewBox", `62 0 ${components.length > taken.size ? 926 : 686} ${Math.max(600, shelf)}`);
    this.key = s("g", {});
    this.drawing.append(this.key);
  }

  component(name, sensors, [x, y, width, height], choose) {
    const group = s("g", {}, s("rect", { class: "zone", x, y, width, height, rx: 8 }),
      s("foreignObject", { x: x + 8, y, width: width - 44, height: 30 }, h("div", { class: "name", title: name }, name)), s("text", { class: "small", x: x + width - 8, y: y + 20, "text-anchor": "end" }, sensors.length));
    const free = { width: width - 16, height: height - 38 };
    let step = 26;
    while (step > 4 && Math.floor(free.width / step) * Math.floor(free.height / step) < sensors.length) step -= 0.5;
    const columns = Math.floor(free.width / step);
    sensors.forEach((sensor, index) => {
      const cx = x + 8 + step * ((index % columns) + 0.5), cy = y + 31 + step * (Math.floor(index / columns) + 0.5);
      const dot = s("circle", { class: "sensor", cx, cy, r: step * 0.42, onclick: () => choose(sensor.name) }, s("title", {}, ""));
      const cross = s("path", { class: "fault", d: `M${cx - step * 0.25} ${cy - step * 0.25}l${step * 0.5} ${step * 0.5}m0 ${-step * 0.5}l${-step * 0.5} ${step * 0.5}`, "pointer-events": "none", visibility: "hidden" });
      group.append(dot, cross);
      this.dots.set(sensor.name, { dot, cross });
    });
    this.drawing.append(group);
  }

  show(sensors, chosen) {
    const [low, high] = bounds(sensors);
    for (const sensor of sensors) {
      const { dot, cross } = this.dots.get(sensor.name);
      dot.setAttribute("fill", sensor.degc === null ? "var(--card)" : colour(sensor.degc, low, high));
      dot.setAttribute("class", `sensor${chosen.includes(sensor.name) ? " chosen" : ""}`);
      cross.setAttribute("visibility", sensor.quality === "good" ? "hidden" : "visible");
      dot.firstChild.textContent = `${title(sensor)}: ${sensor.degc === null ? "no value" : `${sensor.degc.toFixed(2)} °C`}${sensor.reason ? `; ${sensor.quality}: ${sensor.reason}` : ""}`;
    }
    this.legend(low, high);
  }

  legend(low, high) {
    const width = 20, y = 588;
    this.drawing.setAttribute("viewBox", this.drawing.getAttribute("viewBox").replace(/600$/, "640"));
    this.key.replaceChildren(
      ...Array.from({ length: 20 }, (_, step) => s("rect", { x: 70 + step * width, y, width, height: 14, fill: colour(step, 0, 19) })),
      s("text", { class: "small", x: 70, y: y + 30 }, `${low} °C or less`), s("text", { class: "small", x: 470, y: y + 30, "text-anchor": "end" }, `${high} °C or more`),
      s("path", { class: "fault", d: `M520 ${y + 2}l10 10m0 -10l-10 10` }), s("text", { class: "small", x: 540, y: y + 13 }, "not good: held or missing"));
  }
}

export const title = (sensor) => `Sensor ${sensor.id}, ${sensor.component}${sensor.part ? `, ${sensor.part}` : ""}${sensor.label ? ` (${sensor.label})` : ""}`;

// Latency: how long a temperature takes to the macro, stage by stage, beside the published delays.

import { h, s, put, card, table, seconds, number } from "../dom.js";
import { ask } from "../api.js";

const STAGES = [
  ["sampling_wait", "Waiting for the sample", "from a change at the sensor to the pass that reads it"],
  ["line_time", "On the wire", "one pass over the line"],
  ["measurement", "Measurement", "from a change at a sensor to the last byte of the cycle that carries it"],
  ["feedback", "Feedback", "from the last byte of a cycle to the macro read back: this computer's share"],
  ["total", "Total", "from a change at a sensor to the macro read back"],
  ["echo", "Until applied", "from the last byte of a cycle to the poll that shows it applied by the guard"],
];

export async function page(place) {
  const charts = h("div", { class: "grid" }), numbers = h("div", {});
  place.append(h("h1", { class: "hidden" }, "Latency"), h("div", { class: "stack" }, numbers, charts));
  const load = async () => {
    const found = await ask("latency");
    put(numbers, summary(found));
    put(charts, STAGES.filter(([name]) => histogram(found, name)).map(([name, words, meaning]) => h("section", { class: "card third", "aria-label": words }, h("h2", {}, words),
      h("p", { class: "dim" }, meaning), histogram(found, name))));
  };
  await load();
  const timer = setInterval(() => load().catch(() => {}), 5000);
  return { leave: () => clearInterval(timer) };
}

function summary({ stages, published_s: published, published_note: note }) {
  const rows = STAGES.filter(([name]) => stages[name]).map(([name, words]) => {
    const one = stages[name];
    return [words, seconds(one.mean), seconds(one.p50), seconds(one.p99), seconds(one.max), published[name] === undefined ? "" : `${name === "measurement" ? "> " : ""}${number(published[name], 1)} s`, one.samples];
  });
  return card("How late is the compensation", table(["stage", "mean", "median", "p99", "largest", "published mean", "samples"], rows, { caption: "Delays by stage", classes: "numbers" }), h("p", { class: "dim" }, `Published: ${note}.`));
}

// Columns over the delay, the mean as a line, and the published mean where it lies on the same scale.
function histogram({ histograms = {}, stages, published_s: published }, name) {
  const one = histograms[name];
  if (!one || !one.counts?.some((count) => count > 0)) return null;
  const { counts } = one;
  const edges = one.edges.length === counts.length ? [one.from ?? 0, ...one.edges] : one.edges;
  let last = counts.length - 1;
  while (last > 0 && counts[last] === 0) last--;
  let first = 0;
  while (first < last && counts[first] === 0) first++;
  const low = edges[first], high = edges[last + 1], most = Math.max(...counts);
  const width = 420, height = 190, base = 150, left = 12;
  const x = (value) => left + ((value - low) / Math.max(high - low, 1e-12)) * (width - 2 * left);
  const total = counts.reduce((sum, count) => sum + count, 0);
  const drawing = s("svg", { class: "histogram", viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": `${total} delays between ${seconds(low)} and ${seconds(high)}, mean ${seconds(stages[name].mean)}` });
  if (seconds(low) === seconds(high)) {
    drawing.append(s("rect", { class: "column", x: width / 2 - 5, y: 26, width: 10, height: base - 26 }), s("line", { class: "axis", x1: left, x2: width - left, y1: base, y2: base }),
      s("text", { x: width / 2, y: base + 18, "text-anchor": "middle" }, seconds(low)), s("text", { x: width - left, y: height - 4, "text-anchor": "end" }, `${total} delays, all alike`));
    return drawing;
  }
  for (let index = first; index <= last; index++) {
    const tall = (counts[index] / most) * (base - 26);
    drawing.append(s("rect", { class: "column", x: x(edges[index]) + 0.5, y: base - tall, width: Math.max(1, x(edges[index + 1]) - x(edges[index]) - 1), height: tall }));
  }
  drawing.append(s("line", { class: "axis", x1: left, x2: width - left, y1: base, y2: base }), s("text", { x: left, y: base + 18 }, seconds(low)), s("text", { x: width - left, y: base + 18, "text-anchor": "end" }, seconds(high)));
  const mark = (value, words, classes) => {
    const at = x(value), right = at > width * 0.6;
    drawing.append(s("line", { class: classes, x1: at, x2: at, y1: 20, y2: base }), s("text", { class: `${classes}-words`, x: at + (right ? -5 : 5), y: 16, "text-anchor": right ? "end" : "start" }, words));
  };
  const { mean } = stages[name];
  if (mean >= low && mean <= high) mark(mean, `mean ${seconds(mean)}`, "published");
  const other = published[name];
  drawing.append(s("text", { x: width - left, y: height - 4, "text-anchor": "end" }, other === undefined ? `${total} delays` : `${total} delays; published mean ${name === "measurement" ? "> " : ""}${number(other, 1)} s`));
  return drawing;
}

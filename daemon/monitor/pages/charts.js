// Line charts by uPlot, in the colours of the page: bands, marks, values under the cursor, zoom.

import { h, clock, number, NONE } from "./dom.js";

let loading = null;

// uPlot is no module: it is loaded when the first chart is drawn.
function library() {
  loading ??= new Promise((resolve, reject) => {
    document.head.append(h("link", { rel: "stylesheet", href: "vendor/uPlot.css" }));
    document.head.append(h("script", { src: "vendor/uPlot.js", onload: () => resolve(window.uPlot), onerror: () =>
      reject(new Error("uPlot is not installed beside the pages: install Toolpoint anew")) }));
  });
  return loading;
}

const probe = h("i", { hidden: true });

// The colour of a name of the style sheet, as light or dark as the page is.
function css(name) {
  if (!probe.isConnected) document.body.append(probe);
  probe.style.color = `var(${name})`;
  return getComputedStyle(probe).color;
}

const fontFamily = () => getComputedStyle(document.body).fontFamily;
const every = new Set();
const PAPER = 700;
let printed = false;

// A chart is drawn as wide as a sheet is; the style sheet fits it into its place there.
addEventListener("beforeprint", () => { printed = true; }, { capture: true });
addEventListener("afterprint", () => { printed = false; }, { capture: true });

addEventListener("theme", () => { for (const chart of every) chart.build(); });

export class Chart {
  // options: {title, unit, x: "time" | {label}, series: [{label, colour, width, dash, points, hidden}],
  //           bands: [{upper, lower, colour}], fills: [{series, colour}], marks: [{x, words, y, below}], height, zoom, log, floor}
  constructor(options) {
    this.options = options;
    this.data = null;
    this.plot = null;
    this.values = [];
    this.place = h("div", { class: "plot", role: "img", "aria-label": options.title });
    this.legend = h("div", { class: "legend" });
    this.note = h("p", { class: "dim note" });
    this.element = h("figure", { class: "chart" },
      options.caption && h("figcaption", {}, options.caption), this.legend, this.place, this.note);
    this.watcher = new ResizeObserver(() => this.size());
    this.watcher.observe(this.place);
    every.add(this);
  }

  remove() {
    every.delete(this);
    this.watcher.disconnect();
    this.plot?.destroy();
  }

  // data: uPlot's [x, y1, y2, ...]; options that changed (series, bands, marks, unit) may come along.
  async set(data, changes = {}) {
    const rebuild = this.plot === null || changes.series !== undefined || changes.bands !== undefined
      || (changes.unit !== undefined && changes.unit !== this.options.unit);
    Object.assign(this.options, changes);
    this.data = data;
    await library();
    if (rebuild) this.build();
    else {
      this.plot.setData(data);
      this.follow(this.plot.cursor.idx);
    }
  }

  size() {
    const width = this.place.clientWidth;
    if (this.plot && !printed && width > 0 && Math.abs(width - this.plot.width) > 1) this.plot.setSize({ width, height: this.height });
  }

  get height() {
    const base = parseFloat(getComputedStyle(document.documentElement).fontSize);
    const tall = innerWidth > 120 * base && innerHeight > 60 * base ? 1.6 : 1; // a large screen is used
    return Math.round((this.options.height ?? 16) * base * tall);
  }

  build() {
    if (this.data === null || !window.uPlot || !this.element.isConnected) return;
    this.plot?.destroy();
    const { options } = this;
    const base = parseFloat(getComputedStyle(document.documentElement).fontSize);
    const font = `${Math.round(base * 0.8)}px ${fontFamily()}`;
    const time = options.x === undefined || options.x === "time";
    const axis = (label, size) => ({
      stroke: css("--dim"), font, labelFont: font, label, size, labelSize: base * 1.3, labelGap: 0, gap: 4,
      grid: { stroke: css("--grid"), width: 1 }, ticks: { stroke: css("--grid"), width: 1, size: 5 },
    });
    const range = { y: { range: this.floor(), distr: options.log ? 3 : 1 } };
    this.values = options.series.map(() => h("b", {}));
    this.legend.replaceChildren(...options.series.flatMap((one, index) => (one.hidden ? [] : [h("span", { class: "key" },
      this.swatch(one), one.label, " ", this.values[index])])));
    this.plot = new window.uPlot({
      width: Math.max(printed ? Math.min(this.place.clientWidth, PAPER) : this.place.clientWidth, 50), height: this.height, padding: [base * 0.6, base * (time ? 1 : 1.6), 0, 0],
      legend: { show: false }, focus: { alpha: 1 },
      cursor: { drag: { x: options.zoom !== undefined || !time, y: false }, points: { size: 6 } },
      scales: { x: { time, range: time ? LEAST_SPAN : undefined }, ...range },
      axes: [{ ...axis(time ? null : options.x.label, time ? base * 2.4 : base * 1.8), space: base * (time ? 5 : 4),
        values: time ? TIMES : ticks },
        { ...axis(options.unit, base * 3.4), values: options.log ? undefined : ticks }],
      series: [{}, ...options.series.map((one) => this.line(one))],
      bands: (options.bands ?? []).map((band) => ({ series: [band.upper, band.lower], fill: css(band.colour) })),
      hooks: {
        draw: [(plot) => this.marks(plot)],
        setCursor: [(plot) => this.follow(plot.cursor.idx)],
        setSelect: options.zoom ? [(plot) => this.chosen(plot)] : [],
      },
    }, this.data, this.place);
    this.follow(null);
    this.speak();
  }

  floor() {
    const { floor, ceiling } = this.options;
    if (this.options.log) return (plot, low, high) => (low === null ? [0.001, 1] : [low / 1.5, high * 1.5]);
    if (floor === undefined && ceiling === undefined) {
      return (plot, low, high) => {
        if (low === null) return [0, 1];
        const margin = Math.max((high - low) * 0.08, this.options.least ?? 0.05);
        return [low - margin, high + margin];
      };
    }
    return (plot, low, high) => [floor ?? low, ceiling ?? (high === null ? 1 : high * 1.08)];
  }

  line(one) {
    return {
      stroke: css(one.colour), width: one.hidden ? 0 : (one.width ?? 1.8), dash: one.dash,
      points: { show: one.points ?? false, size: 7, fill: css(one.colour) },
      paths: one.points ? () => null : undefined, spanGaps: one.spanGaps ?? false,
      fill: one.fill ? css(one.fill) : undefined, fillTo: one.fillTo,
    };
  }

  swatch(one) {
    const swatch = h("i", { class: `swatch${one.dash ? " dashed" : ""}${one.points ? " dot" : ""}` });
    swatch.style.color = css(one.colour);
    return swatch;
  }

  follow(index) {
    const { options } = this;
    const time = options.x === undefined || options.x === "time";
    const ends = index === null || index === undefined;
    if (ends) index = time ? this.last() : null;
    options.series.forEach((one, place) => {
      const values = this.data[place + 1] ?? [];
      const value = !ends ? values[index] : time ? values.findLast((one) => typeof one === "number") : undefined; // the end counts in time alone
      const shown = ends && !time ? "" : typeof value === "number" ? `${number(value, options.digits ?? 1)} ${options.unit_short ?? options.unit ?? ""}` : NONE;
      this.values[place].textContent = shown;
    });
    const at = this.data[0]?.[index];
    this.note.textContent = at === undefined ? (options.note ?? "") :
      `${time ? `at ${clock(at, { date: true })}` : `at ${number(at, options.x.digits ?? 0)} ${options.x.unit ?? ""}`}${options.note ? ` · ${options.note}` : ""}`;
  }

  last() {
    for (let index = this.data[0].length - 1; index >= 0; index--) {
      if (this.data.slice(1).some((values) => typeof values[index] === "number")) return index;
    }
    return null;
  }

  // What a person who does not see the chart is told.
  speak() {
    const ends = this.options.series.flatMap((one, place) => {
      if (one.hidden) return [];
      const values = this.data[place + 1].filter((value) => typeof value === "number");
      if (!values.length) return [];
      const low = values.reduce((a, b) => Math.min(a, b)), high = values.reduce((a, b) => Math.max(a, b));
      return [`${one.label}: from ${number(low)} to ${number(high)}`];
    });
    this.place.setAttribute("aria-label", `${this.options.title} in ${this.options.unit_short ?? this.options.unit}. ${ends.join("; ") || "No values."}`);
  }

  marks(plot) {
    const base = parseFloat(getComputedStyle(document.documentElement).fontSize) * devicePixelRatio;
    const { ctx, bbox } = plot;
    ctx.save();
    let written = -Infinity;
    for (const mark of this.options.marks ?? []) {
      const x = plot.valToPos(mark.x, "x", true);
      if (x < bbox.left || x > bbox.left + bbox.width) continue;
      ctx.strokeStyle = ctx.fillStyle = css(mark.colour ?? "--mark");
      ctx.lineWidth = devicePixelRatio * 1.2;
      if (mark.y === undefined) {
        ctx.setLineDash([4 * devicePixelRatio, 4 * devicePixelRatio]);
        ctx.beginPath();
        ctx.moveTo(x, bbox.top);
        ctx.lineTo(x, bbox.top + bbox.height);
        ctx.stroke();
        ctx.setLineDash([]);
      } else {
        ctx.beginPath();
        ctx.arc(x, plot.valToPos(mark.y, "y", true), base * 0.35, 0, 7);
        ctx.fill();
      }
      ctx.font = `${base * 0.75}px ${fontFamily()}`;
      const room = bbox.left + bbox.width - x - base * 0.4;
      const words = ctx.measureText(mark.words).width > Math.max(room, x - bbox.left) ? mark.words.split(",")[0] : mark.words;
      const right = ctx.measureText(words).width > room; // the words stand on the other side, then
      ctx.textAlign = right ? "right" : "left";
      const y = mark.y === undefined ? bbox.top + base * 0.8 : plot.valToPos(mark.y, "y", true) + base * (mark.below ? 1.2 : -0.6);
      const wide = ctx.measureText(words).width + base * 0.4, begins = right ? x - wide : x;
      if (mark.y === undefined && begins < written) continue; // one of the lines beside it has its words there
      if (mark.y === undefined) written = begins + wide;
      ctx.fillText(words, x + (right ? -1 : 1) * base * 0.4, Math.max(y, bbox.top + base * 0.8));
    }
    ctx.restore();
  }

  chosen(plot) {
    const { left, width } = plot.select;
    if (width < 8) return;
    const from = plot.posToVal(left, "x"), to = plot.posToVal(left + width, "x");
    plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    this.options.zoom(from, to);
  }
}

// A single instant is shown within ten minutes: uPlot would show it within years.
const LEAST_SPAN = (plot, low, high) => (plot.data[0].length === 1 ? [plot.data[0][0] - 300, plot.data[0][0] + 300] : [low, high]);

// Numbers at an axis, as many digits as they differ by, with a minus that is one.
function ticks(plot, values) {
  const known = values.filter((value) => value !== null);
  let digits = 0;
  while (digits < 4 && known.some((value) => Math.abs(value * 10 ** digits - Math.round(value * 10 ** digits)) > 1e-6)) digits += 1;
  return values.map((value) => (value === null ? null : number(value, digits)));
}

// Axis words of times, 24 hours: [step, words, _, _, words at midnight, ...].
const TIMES = [
  [31536000, "{YYYY}", null, null, null, null, null, null, 1],
  [2419200, "{YYYY}-{MM}", null, null, null, null, null, null, 1],
  [86400, "{DD} {MMM}", "\n{YYYY}", null, null, null, null, null, 1],
  [3600, "{HH}:{mm}", "\n{DD} {MMM}", null, "\n{DD} {MMM}", null, null, null, 1],
  [60, "{HH}:{mm}", "\n{DD} {MMM}", null, "\n{DD} {MMM}", null, null, null, 1],
  [1, "{HH}:{mm}:{ss}", "\n{DD} {MMM}", null, "\n{DD} {MMM}", null, null, null, 1],
];


// Overview: is it working, and how do I know.

import { h, s, put, prose, card, choice, clock, number, signed, um, per, unit, seconds, duration, NONE } from "../dom.js";
import { STATES, TERMS } from "../words.js";
import { Chart } from "../charts.js";
import { ask, act, newest, series } from "../api.js";
import { remedies } from "../messages.js";
import { aligned, at, begun, beside, each, held, since } from "../series.js";

const SHIFT_S = 8 * 3600;
const AGAIN_MS = 60000;

export async function page(place, context) {
  const parts = {};
  for (const name of ["state", "problems", "checks", "axes", "speed", "links", "latency"]) parts[name] = h("div", {});
  const error = new ErrorOverShift(context.live);
  const actions = h("div", { class: "actions" });
  place.append(
    h("h1", { class: "hidden" }, "Overview"),
    h("div", { class: "grid" },
      h("div", { class: "wide" }, parts.state, parts.problems),
      h("section", { class: "card third" }, h("h2", {}, "How do I know"), parts.checks),
      h("section", { class: "card" },
        h("div", { class: "between" }, h("h2", {}, "Compensation by axis [µm]"), actions), parts.axes),
      error.element,
      h("div", { class: "third" }, parts.speed),
      h("div", { class: "third" }, parts.links),
      h("div", { class: "third" }, parts.latency)));
  return {
    status(status) {
      put(parts.state, state(status));
      put(parts.problems, problems(status));
      put(parts.checks, checks(status));
      put(parts.axes, axes(status));
      put(parts.speed, speed(status));
      put(parts.links, links(status));
      put(parts.latency, latency(status));
      offer(actions, status, context);
      error.status(status);
    },
    leave() { error.leave(); },
  };
}

// --- state -------------------------------------------------------------------------------

function state(status) {
  const known = STATES[gone_back(status) ? "BACK" : status.state] ?? { mark: "?", words: status.state };
  const axes = Object.entries(status.axes).filter(([, axis]) => axis.enabled && !axis.unit);
  const without = axes.map(([name, axis]) => `${name.toUpperCase()} ${um(axis.estimated_um)}`).join(", ");
  const left = axes.map(([name, axis]) => `${name.toUpperCase()} ${um(axis.remaining_um)}`).join(", ");
  return h("section", { class: `card state tone-${status.state}`, "aria-label": "State of the output" },
    h("span", { class: "mark", "aria-hidden": "true" }, known.mark),
    h("div", { class: "word", id: "state" }, status.state, " ", h("small", {}, known.words.replace(/^\w+: /, ""))),
    h("p", { class: "reason", id: "reason" }, status.reason ? prose(sentence(status.reason)) : known.words),
    status.state !== "ACTIVE" && remedy(status.alarm || status.reason),
    h("div", { class: "more" },
      axes.length > 0 && h("p", {}, "Estimated error without compensation: ", h("b", {}, without), "; with: ", h("b", {}, left), "."),
      h("p", { class: "dim" }, prose(reference(status)), status.since_s !== null ? ` In this state for ${duration(status.since_s)}. ` : " ", h("a", { href: "#/history" }, "What happened before")),
    ));
}

// Switched off, and back where it was at the reference: nothing moves until that ends.
function gone_back({ state: now, reference: set, axes: found }) {
  return now === "RETREAT" && set && Object.values(found).every((axis) => [axis.written_um, axis.applied_um].every((value) => value !== null && Math.abs(value - (axis.baseline_um ?? 0)) < 0.05));
}

// What a person should do about a reason, as the manual says.
function remedy(reason) {
  const found = remedies(reason);
  return h("p", { class: "todo" }, found.length > 0 && [h("b", {}, "What to do: "), prose(found.join("; ")), ". "], h("a", { href: "#/messages" }, "All messages"));
}

const FOLDERS = /(?:\/[^\s/:]+){2,}\//g;

// What a person should look at: whole in a fault, else its beginning, and the rest on demand.
function problems({ problems: found, reason, state: now }) {
  return found.filter((problem) => problem !== reason && !(now === "FAULT" && problem.startsWith(`FAULT: ${reason};`))).map((problem) => {
    if (now === "FAULT" || problem.length < 110) return h("p", { class: "attention" }, prose(problem), " ", todo(problem));
    return h("details", { class: "attention" }, h("summary", {}, h("span", {}, prose(problem.replace(FOLDERS, "…/")))), h("div", {}, prose(problem)), todo(problem));
  });
}

const todo = (problem) => { const found = remedies(problem); return found.length > 0 && h("small", {}, "What to do: ", prose(found.join("; ")), "."); };

const sentence = (words) => `${words[0].toUpperCase()}${words.slice(1)}${/[.!?]$/.test(words) ? "" : "."}`;

function reference(status) {
  if (status.reference) {
    return `Reference set by ${status.reference.source}, ${duration(status.reference.age_s)} ago: there the thermal error is zero by definition.`;
  }
  if (status.reference_ended && status.reason.includes(status.reference_ended)) return "There is no reference.";
  return `No reference: ${status.reference_ended || "it is set after work positioning"}.`;
}

// --- evidence ----------------------------------------------------------------------------

function checks(status) {
  const found = [
    connected(status),
    sensors(status),
    model(status),
    [status.reference ? "yes" : "wait", status.reference ? "A reference is set" : "There is no reference", status.reference || status.reason.includes(status.reference_ended) ? "" : status.reference_ended],
    writes(status),
    ...applied(status),
  ];
  return h("ul", { class: "checks" }, found.map(([mark, words, small]) => h("li", { class: mark },
    h("span", {}, h("span", { class: "hidden" }, { yes: "good: ", no: "bad: ", wait: "attention: " }[mark]), words, small ? h("small", {}, prose(small)) : ""))));
}

function connected({ links: found }) {
  const down = found.filter((link) => !link.up);
  if (!down.length) return ["yes", "The CNC and every line answer", ""];
  return ["no", `${down.map((link) => link.name).join(", ")} ${down.length > 1 ? "do" : "does"} not answer`, down[0].problem];
}

function sensors({ sensors: count, age_s }) {
  const all = count.usable === count.total;
  const age = age_s === null ? "no temperature has arrived yet" : `the newest is ${duration(age_s)} old`;
  return [count.usable === 0 ? "no" : all && count.good === count.total ? "yes" : "wait", `${count.usable} of ${count.total} temperatures are usable`,
    `${age}${count.good < count.total ? `; ${count.total - count.good} not good, see Temperatures` : ""}`];
}

function model({ model: found }) {
  if (!found || (!found.model_id && !found.sha256)) return ["wait", "No thermal model is in force", found?.problem || "Train and release one."];
  return [found.problem ? "wait" : "yes", `Model ${short(found.model_id)} is in force`, found.problem || (found.released_by ? `released by ${found.released_by}` : "")];
}

const short = (name) => (name && name.length > 26 ? `${name.slice(0, 24)}…` : name ?? "");

function writes({ writes: count, state: now }) {
  if (!count.sent) return ["wait", "Nothing was written yet", ""];
  const all = count.sent === count.verified, words = `${count.verified} of ${count.sent} writes read back equal`;
  return [all ? "yes" : now === "FAULT" ? "no" : "wait", words, all ? "" : `${count.refused ? `${count.refused} were refused; ` : ""}what became of the others: History, by outcome`];
}

function applied(status) {
  const on = Object.entries(status.axes).filter(([, axis]) => axis.enabled);
  if (!on.length && Object.values(status.axes).some((axis) => axis.wanted)) return [["wait", "What is switched on waits, as the state says", ""]];
  if (!on.length) return [["wait", "No axis is enabled", "A person switches compensation on."]];
  const beyond = on.filter(([, axis]) => axis.applied_um !== null && Math.abs(axis.applied_um) > axis.bound_um + 1e-6);
  if (beyond.length) return [["no", `Axis ${beyond.map(([name]) => name.toUpperCase()).join(", ")}: applied beyond the bound`, ""]];
  const unknown = on.filter(([, axis]) => axis.applied_um === null);
  return unknown.length ? [["wait", "The guard has not said yet what it applied", ""]] : [["yes", "What the CNC applies lies within the bounds", ""]];
}

// --- axes --------------------------------------------------------------------------------

function axes(status) {
  const head = [["Axis", ""], ["Estimated", TERMS.estimated], ["Requested", TERMS.requested], ["Written", TERMS.written], ["Applied", TERMS.applied], ["Band", TERMS.band], ["Bound", TERMS.bound], ["Within the bound", "from − bound to + bound"]];
  const rows = Object.entries(status.axes).map(([name, axis]) => {
    const tag = axis.channel === null ? h("span", { class: "dim" }, "no model") : axis.enabled && axis.wanted ? h("span", { class: "tag good" }, "on")
      : h("span", { class: "tag" }, axis.wanted ? "waits" : "off");
    const cells = [h("span", {}, h("span", { class: "name" }, name.toUpperCase()), axis.unit ? ` ${per(axis)} ` : typeof axis.pivot_mm !== "number" ? " " : ` at ${number(axis.pivot_mm, 0)} mm `, tag), signed(axis.estimated_um), signed(axis.requested_um), signed(axis.written_um),
      h("span", { class: "main" }, signed(axis.applied_um)), axis.band_um === null ? NONE : `± ${number(axis.band_um)}`, `± ${number(axis.bound_um, 0)}`,
      axis.channel === null ? h("span", { class: "dim" }, "no channel of the model is named for this axis") : gauge(name, axis)];
    return h("tr", { id: `axis-${name}` }, cells.map((cell, column) => h("td", { "data-head": head[column][0] }, cell)));
  });
  return h("div", { class: "scroll whole", tabindex: "0", role: "region", "aria-label": "Compensation by axis" },
    since_reference(status),
    h("table", { class: "axes" }, h("thead", {}, h("tr", {}, head.map(([words, explanation]) => h("th", { scope: "col", title: explanation }, words)))), h("tbody", {}, rows)), key());
}

// What the marks of the drawings mean.
function key() {
  const mark = (drawn, words) => h("span", { class: "key" }, s("svg", { width: "1.5rem", height: "1rem", viewBox: "0 0 24 16", "aria-hidden": "true" }, drawn), words);
  return h("p", { class: "legend", "aria-hidden": "true" },
    mark(s("rect", { x: 0, y: 4, width: 24, height: 8, fill: "var(--with)" }), "applied"), mark(s("line", { x1: 12, x2: 12, y1: 2, y2: 14, stroke: "var(--ink)", "stroke-width": 2.5 }), "written"),
    mark(s("line", { x1: 12, x2: 12, y1: 0, y2: 16, stroke: "var(--without)", "stroke-width": 3 }), "requested"), mark(s("rect", { x: 0, y: 1, width: 24, height: 14, fill: "var(--band)" }), "band"),
    mark([s("line", { x1: 4, x2: 4, y1: 1, y2: 15, stroke: "var(--ink)", "stroke-width": 2 }), s("line", { x1: 20, x2: 20, y1: 1, y2: 15, stroke: "var(--ink)", "stroke-width": 2 })], "bound"));
}

// After a second reference the request is not minus the estimate: what was applied at the reference stays in it.
function since_reference(status) {
  const offsets = Object.entries(status.axes).filter(([, axis]) => axis.channel !== null && Math.abs(axis.baseline_um ?? 0) >= 0.05);
  if (!offsets.length) return null;
  return h("p", { class: "dim note" }, `Requested = what was applied when the reference was set (${offsets.map(([name, axis]) => `${name.toUpperCase()} ${um(axis.baseline_um, axis)}`).join(", ")}) − estimated error.`);
}

// Compensation from - bound to + bound: the ideal (minus the estimate) with its band, what is written, what is applied.
function gauge(name, axis) {
  const width = 400, middle = 20, bound = axis.bound_um;
  const x = (value) => width / 2 + (Math.min(Math.max(value / bound, -1), 1) * (width / 2 - 12));
  const ideal = axis.requested_um;
  const words = `Axis ${name.toUpperCase()}: applied ${um(axis.applied_um, axis)}, requested ${um(axis.requested_um, axis)}, bound ± ${number(bound, 0)} ${per(axis)}`;
  const drawing = s("svg", { class: "gauge", viewBox: `0 0 ${width} 40`, role: "img", "aria-label": words, preserveAspectRatio: "none" },
    s("title", {}, words),
    s("rect", { x: 12, y: middle - 5, width: width - 24, height: 10, rx: 5, fill: "var(--grid)" }),
    ideal !== null && axis.band_um !== null && s("rect", { x: x(ideal - axis.band_um), y: middle - 11, width: Math.max(2, x(ideal + axis.band_um) - x(ideal - axis.band_um)), height: 22, fill: "var(--band)" }),
    axis.applied_um !== null && s("rect", { x: Math.min(x(0), x(axis.applied_um)), y: middle - 5, width: Math.abs(x(axis.applied_um) - x(0)), height: 10, fill: "var(--with)" }),
    s("line", { x1: x(0), x2: x(0), y1: 6, y2: 34, stroke: "var(--dim)", "stroke-width": 1.5 }),
    [-1, 1].map((side) => s("line", { x1: x(side * bound), x2: x(side * bound), y1: 8, y2: 32, stroke: "var(--ink)", "stroke-width": 2 })),
    ideal !== null && s("line", { x1: x(ideal), x2: x(ideal), y1: 5, y2: 35, stroke: "var(--without)", "stroke-width": 3 }),
    axis.written_um !== null && s("line", { x1: x(axis.written_um), x2: x(axis.written_um), y1: 11, y2: 29, stroke: "var(--ink)", "stroke-width": 2.5 }));
  return drawing;
}

// --- actions: only what the person may, each with a question -------------------------------

function offer(place, status, context) {
  const may = context.may("operator"), tuned = status.spindle_speed;
  const any = Object.values(status.axes).some((axis) => axis.wanted);
  const wanted = !may ? [] : [
    !any && ["enable", "Switch on", "Switch compensation on?", "Every axis with a model is switched on. The NC moves the tool by what is written, at safe points, within the bound of each axis.", false],
    any && ["disable", "Switch off", "Switch compensation off?", "The compensation goes back, at its slew rate, to what was applied when the reference was set. The axes can be switched on again at any time.", false],
    any && ["disable-zero", "Back to zero", "Take the compensation back to zero?", "Every axis moves to zero at its slew rate and is switched off.", true],
    ["reference", "Set the reference", "Set the reference now?", "The present position counts as free of thermal error: do this right after the work was positioned.", false],
    tuned.configured && !tuned.switched_on && context.may("engineer") && ["enable-speed", "Tune the spindle speed", "Tune the spindle speed?", "The NC takes a speed that the lobes allow, within the limits of the configuration, at its next safe point.", false],
    tuned.configured && tuned.switched_on && ["disable-speed", "Stop tuning the speed", "Stop tuning the spindle speed?", "The NC goes back to the programmed speed at its next safe point.", false],
    status.state === "FAULT" && ["acknowledge", "Acknowledge", `Acknowledge FAULT ${status.fault}?`, `${sentence(status.reason)} Do it when the cause is gone; a FAULT that comes later is not cleared. The output then holds what the CNC applies, and the axes that are switched on follow again by themselves when everything is good.`, true],
  ].filter(Boolean);
  const key = wanted.map(([name, , question]) => name + question).join();
  if (place.dataset.key === key) return;
  place.dataset.key = key;
  place.replaceChildren(...wanted.map(([name, words, question, explanation, danger]) => h("button", {
    type: "button", class: danger ? "danger" : "quiet", id: `do-${name}`,
    onclick: () => context.confirm({
      question, explanation, yes: words, danger,
      carry: () => act(name.split("-")[0], { "disable-zero": { zero: true }, acknowledge: { fault: status.fault }, "enable-speed": { spindle_speed: true }, "disable-speed": { spindle_speed: true } }[name]),
    }),
  }, words)));
}

// --- spindle speed, links, delay -----------------------------------------------------------

function speed({ spindle_speed: found }) {
  if (!found.configured) {
    return card("Spindle speed", h("p", { class: "big" }, unit(found.actual_rpm, "1/min", 0)), h("p", { class: "dim" }, "As programmed. ", sentence(found.why)));
  }
  return card("Spindle speed",
    h("p", { class: "big" }, unit(found.actual_rpm, "1/min", 0)),
    h("dl", { class: "facts" },
      h("dt", {}, "programmed"), h("dd", {}, unit(found.programmed_rpm, "1/min", 0)),
      h("dt", {}, "commanded"), h("dd", {}, found.written_rpm === null ? (found.actual_rpm === null ? "not known" : "none: the NC follows its program") : unit(found.written_rpm, "1/min", 0)),
      h("dt", {}, "why"), h("dd", {}, `${found.state}: ${found.why}`)));
}

function links({ links: found }) {
  return card("Links", h("ul", { class: "checks" }, found.map((link) => h("li", { class: link.up ? "yes" : "no" }, h("span", {}, link.name,
    link.up ? ": up" : ": down", (link.losses > 0 || !link.up) && h("small", {}, prose(link.up ? `lost ${link.losses === 1 ? "once" : `${link.losses} times, the last`}, ${clock(link.last_problem_time, { date: true })}: ${link.last_problem}` : link.problem || "not up yet")), !link.up && todo(link.problem))))));
}

function latency({ latency: found }) {
  const mean = found.total.mean, published = found.published_s;
  const share = (value) => `${Math.min(100, (100 * value) / Math.max(published, mean ?? 0))}%`;
  const bar = (value, colour) => s("svg", { width: "100%", height: "10", "aria-hidden": "true", class: "bar" }, s("rect", { width: share(value ?? 0), height: 10, rx: 3, fill: colour }));
  return card("Delay from a temperature to the macro",
    h("p", { class: "big" }, seconds(mean)), bar(mean, "var(--with)"),
    h("p", { class: "dim" }, `of that this computer's share (feedback): ${seconds(found.feedback.mean)}, p99 ${seconds(found.feedback.p99)}`),
    bar(published, "var(--c7)"), h("p", { class: "dim" }, `published mean of another rig, with database polling: ${seconds(published)}`));
}

// --- error with and without, over the shift ------------------------------------------------

class ErrorOverShift {
  constructor(live) {
    this.live = live;
    this.axis = null;
    this.unit = per(null);
    this.points = 480;
    this.asking = newest();
    this.asked_ms = -Infinity;
    this.tail = [];
    this.chooser = h("span", {});
    this.chart = new Chart({
      title: "Thermal error over the shift", unit: "thermal error [µm]", unit_short: "µm", height: 17, least: 1,
      caption: "Since the reference, as the model estimates it; shaded: the band in which the true error is expected.",
      series: [
        { label: "without compensation", colour: "--without", width: 2 },
        { label: "with compensation", colour: "--with", width: 2.4 },
        { label: "", colour: "--with", hidden: true }, { label: "", colour: "--with", hidden: true },
      ],
      bands: [{ upper: 3, lower: 4, colour: "--band" }],
    });
    this.element = h("section", { class: "card" },
      h("div", { class: "between" }, h("h2", {}, "Error with and without compensation, last 8 h"), this.chooser), this.chart.element);
  }

  leave() { this.chart.remove(); }

  status(status) {
    const modelled = Object.entries(status.axes).filter(([, axis]) => axis.channel !== null).map(([name]) => name);
    if (modelled.length === 0) {
      this.chart.note.textContent = "No axis has a model: name a channel of a released model for an axis (compensation.axes).";
      return;
    }
    if (this.axis === null) {
      this.axis = modelled.includes("z") ? "z" : modelled[0];
      this.chooser.replaceChildren(choice("Axis", modelled.map((name) => [name, name.toUpperCase()]), this.axis, (name) => {
        this.axis = name;
        this.tail = [];
        this.load(this.live.status);
      }));
    }
    const axis = status.axes[this.axis];
    this.unit = per(axis);
    this.where = typeof axis.pivot_mm !== "number" ? "" : `At ${number(axis.pivot_mm, 0)} mm, the pivot of the axis' slope; elsewhere the slope comes on top.`;
    if (axis.estimated_um !== null) this.tail.push([status.time, axis.estimated_um, axis.remaining_um, axis.band_um]);
    if (performance.now() - this.asked_ms > AGAIN_MS) this.load(status);
    else this.draw(status);
  }

  async load(status) {
    this.asked_ms = performance.now();
    const wanted_still = this.asking();
    const to = status.time, from = await begun(to - SHIFT_S, to), { channel, tool_um_per_k: tool } = status.axes[this.axis];
    const labels = Object.keys(tool);
    const names = [`estimated.${channel}`, `applied.${this.axis}`, `band.${channel}`, ...labels.flatMap((label) => [`label.${label}`, `label_reference.${label}`])];
    try {
      const [answers, estimate] = await Promise.all([series(names, from, to, this.points), ask("estimate", { contributions: false })]);
      if (!wanted_still()) return;
      const [t, estimated, applied, band, ...means] = aligned(answers, names.map((name) => [name, "mean"]), from, to, this.points);
      const of_cnc = held(applied);
      const marks = (estimate.references ?? []).map((reference) => reference.time).filter((time) => time >= from && time <= to);
      const baseline = since(t, marks, (mark) => (mark === null ? 0 : at(t, of_cnc, mark) ?? 0));
      // the model's channel is the nose; the tool in front of it grows by itself
      const without = labels.reduce((sum, label, place) => each(sum, each(means[2 * place], means[2 * place + 1], (now, then) => now - then),
        (value, kelvin) => value + tool[label] * kelvin), estimated);
      const remaining = without.map((value, index) => (value === null || value === undefined ? value : value + (of_cnc[index] ?? 0) - baseline[index]));
      for (const mark of marks) { // the piece of time in which the reference was set holds means of before and after
        const index = Math.floor(((mark - from) / (to - from)) * this.points);
        for (const place of [index, index + 1]) if (place < this.points) remaining[place] = undefined;
      }
      this.recorded = { t, without, remaining, band: held(band), to };
      this.chart.options.marks = marks.map((x) => ({ x, words: "reference" }));
      const last = t.findLast((time, index) => typeof estimated[index] === "number") ?? from;
      this.tail = this.tail.filter(([time]) => time > last);
      this.draw(status);
    } catch (error) {
      if (wanted_still()) this.chart.note.textContent = error.message;
    }
  }

  draw() {
    if (!this.recorded) return;
    const { t, without, remaining, band } = this.recorded;
    const tail = this.tail;
    const data = [[...t, ...tail.map((row) => row[0])], [...without, ...tail.map((row) => row[1])], [...remaining, ...tail.map((row) => row[2])]];
    const bands = [...band, ...tail.map((row) => row[3])];
    this.chart.set([...data, ...beside(data[2], bands)], { unit: `thermal error [${this.unit}]`, unit_short: this.unit, note: this.where });
  }
}

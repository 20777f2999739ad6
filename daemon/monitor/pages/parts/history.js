// History: what happened and who did it, every write of macro variables; with filter and download.

import { h, put, prose, choice, buttons, card, table, clock, seconds, signed, per, NONE } from "../dom.js";
import { RANGES } from "../words.js";
import { ask, newest } from "../api.js";

const OUTCOMES = { verified: ["good", "verified"], differs: ["bad", "differs"], failed: ["bad", "failed"], refused: ["bad", "refused"], intended: ["warn", "not settled"] };
const LIMIT = 200;
// Kinds of event that somebody should look at, and what they look like; every other kind is plain.
const GRAVE = { fault: "bad", alarm: "bad", refused: "warn", notice: "warn", "audit gap": "warn" };
const DAY_S = 86400;

export async function page(place, context) {
  const view = new History(context);
  place.append(h("h1", { class: "hidden" }, "History"), view.element);
  await view.load();
  view.timer = setInterval(() => view.follow && !view.list.querySelector("details[open]") && view.load(), 5000);
  return view;
}

class History {
  constructor({ live }) {
    this.live = live;
    this.asking = newest();
    this.range_s = DAY_S;
    this.text = "";
    this.kind = "";
    this.outcome = "";
    this.follow = true;
    const changed = (name) => (value) => { this[name] = value; this.load(); };
    for (const name of ["kinds", "events", "list"]) this[name] = h("div", { class: name });
    for (const name of ["happened", "said"]) this[name] = h("p", { class: "dim", role: "status" });
    this.downloads = h("div", { class: "actions" });
    const search = h("input", { type: "search", id: "find", placeholder: "reason or person", onchange: (event) => changed("text")(event.target.value.trim()) });
    this.element = h("div", { class: "grid" },
      h("div", { class: "between" }, h("label", { class: "choice" }, h("span", {}, "find"), search), buttons("Range", RANGES.slice(0, 6), this.range_s, changed("range_s"))),
      card("What happened", h("div", { class: "between" }, this.happened, this.kinds), this.events),
      card("Every write to the CNC", h("div", { class: "between" }, this.said,
        choice("outcome", [["", "all"], ...Object.entries(OUTCOMES).map(([name, [, words]]) => [name, words])], "", changed("outcome"))), this.list),
      card("Download", h("p", { class: "dim" }, prose("The range above. A recording is the file that `toolpoint thermal train` reads.")), this.downloads));
  }

  leave() { clearInterval(this.timer); }

  async load() {
    const { status } = this.live;
    if (!status) { setTimeout(() => this.element.isConnected && this.load(), 300); return; }
    const to = status.time, from = to - this.range_s, during = { from, to, limit: LIMIT }, wanted_still = this.asking();
    try {
      const [past, found] = await Promise.all([
        ask("past-events", { ...during, text: this.text, kind: this.kind }),
        ask("writes", { ...during, reason: this.text || undefined, outcome: this.outcome || undefined })]);
      if (!wanted_still()) return;
      this.happened.textContent = `${counted(past.events, "event", past.more)}, in the time of this computer (${zone(to)}).`;
      this.choose(past.kinds);
      this.tell(past.events);
      this.said.textContent = `${counted(found.writes, "write", found.more)}${found.more ? ": ask for less time, or download all" : ""}.`;
      this.draw(found.writes);
      this.offer(from, to);
    } catch (error) {
      if (wanted_still()) this.happened.textContent = this.said.textContent = error.message;
    }
  }

  choose(kinds) {
    const names = [...new Set([...Object.keys(kinds), ...(this.kind ? [this.kind] : [])])].sort();
    put(this.kinds, choice("kind", [["", "all"], ...names.map((name) => [name, `${name} (${kinds[name] ?? 0})`])], this.kind, (kind) => { this.kind = kind; this.load(); }));
  }

  tell(events) {
    const scroll = this.events.querySelector(".scroll")?.scrollTop ?? 0;
    put(this.events, events.length ? table(["time", "kind", "what", "who"], events.map(({ time, kind, text, person }) => [
      clock(time, { date: this.range_s > 3600 }), h("span", { class: `tag ${GRAVE[kind] ?? ""}` }, kind), text, person ?? NONE]), { caption: "Events", classes: "events" })
      : h("p", {}, "Nothing: no change of state, no request, no fault."));
    if (events.length) this.events.querySelector(".scroll").scrollTop = scroll;
  }

  draw(writes) {
    const head = ["time", "outcome", "state", "reason", "requested [µm]", "written [µm]", "applied [µm]", "macros: old → new", "model", "delay"];
    const rows = writes.map((write) => {
      const [kind, words] = OUTCOMES[write.outcome] ?? ["", write.outcome];
      return [h("span", { title: clock(write.time, { date: true }) }, clock(write.time, { date: this.range_s > DAY_S })), h("span", { class: `tag ${kind}` }, words), write.state ?? NONE,
        h("span", {}, write.reason || write.cause, write.person ? h("span", { class: "dim" }, ` (${write.person})`) : "", write.detail ? h("span", { class: "said" }, ` ${write.detail}`) : ""),
        ...[write.requested_um, write.compensation_um, write.applied_um].map((values) => vector(values, moved(write), this.live.status.axes)), macros(write), write.model_id ?? NONE, seconds(write.delay_s.verified ?? write.delay_s.read_back ?? null)];
    });
    const scroll = this.list.querySelector(".scroll")?.scrollTop ?? 0;
    this.list.replaceChildren(h("div", { class: "scroll tall", tabindex: "0", role: "region", "aria-label": "Writes" }, h("table", { class: "writes" }, h("thead", {}, h("tr", {}, head.map((word) => h("th", { scope: "col" }, word)))),
      h("tbody", {}, rows.map((row) => h("tr", {}, row.map((cell, column) => h("td", { "data-head": head[column] }, cell))))))));
    this.list.querySelector(".scroll").scrollTop = scroll;
    this.follow = scroll < 5;
  }

  offer(from, to) {
    const link = (what, format) => h("a", { class: "download", href: `/api/v1/export?what=${what}&format=${format}&from=${from.toFixed(3)}&to=${to.toFixed(3)}`, target: "_blank" }, `${what} (${format === "csv" ? "CSV" : "Parquet"})`);
    this.downloads.replaceChildren(...["events", "writes", "recording", "temperatures"].flatMap((what) => ["csv", "parquet"].map((format) => link(what, format))));
  }
}

const counted = (rows, word, more) => `${more ? "The newest " : ""}${rows.length} ${rows.length === 1 ? word : `${word}s`}`;

function zone(utc_s) {
  const minutes = -new Date(utc_s * 1000).getTimezoneOffset();
  return `UTC${minutes < 0 ? "−" : "+"}${Math.floor(Math.abs(minutes) / 60)}${minutes % 60 ? `:${Math.abs(minutes) % 60}` : ""}`;
}

// Axes of which anything is asked for, written or applied; all of them where nothing is.
function moved(write) {
  const kinds = [write.requested_um, write.compensation_um, write.applied_um].map((values) => values ?? {});
  const names = [...new Set(kinds.flatMap(Object.keys))], found = names.filter((axis) => kinds.some((values) => values[axis]));
  return found.length ? found : names;
}

const vector = (values, axes, known) => Object.entries(values ?? {}).filter(([axis, value]) => value !== null && axes.includes(axis)).map(([axis, value]) => `${axis.toUpperCase()} ${signed(value)}${known[axis]?.unit ? ` ${per(known[axis])}` : ""}`).join("  ") || NONE;

function macros(write) {
  return h("details", {}, h("summary", {}, write.macros.length === 1 ? `#${write.macros[0][0]}` : `${write.macros.length} variables`), h("ul", { class: "plain" }, write.macros.map(([number, value], index) =>
    h("li", {}, `#${number}: ${write.old?.[index] === null || write.old?.[index] === undefined ? "" : `${write.old[index]} → `}${value}${write.read_back?.[index] !== undefined && write.read_back[index] !== value ? ` (read back ${write.read_back[index]})` : ""}`))));
}

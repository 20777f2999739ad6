// History: every write of macro variables, with filter and download.

import { h, prose, choice, buttons, card, clock, seconds, signed, per, NONE } from "../dom.js";
import { RANGES } from "../words.js";
import { ask } from "../api.js";

const OUTCOMES = { verified: ["good", "verified"], differs: ["bad", "differs"], failed: ["bad", "failed"], refused: ["bad", "refused"], intended: ["warn", "not settled"] };
const LIMIT = 200;

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
    this.range_s = 3600;
    this.reason = "";
    this.outcome = "";
    this.follow = true;
    this.list = h("div", {});
    this.said = h("p", { class: "dim", role: "status" });
    this.downloads = h("div", { class: "actions" });
    const search = h("input", { type: "search", id: "reason", placeholder: "reason, cause or person", onchange: (event) => { this.reason = event.target.value.trim(); this.load(); } });
    this.element = h("div", { class: "grid" },
      card("Every write to the CNC", h("div", { class: "between" },
        h("span", { class: "actions" }, h("label", { class: "choice" }, h("span", {}, "find"), search),
          choice("outcome", [["", "all"], ...Object.entries(OUTCOMES).map(([name, [, words]]) => [name, words])], "", (outcome) => { this.outcome = outcome; this.load(); })),
        buttons("Range", RANGES.slice(0, 6), this.range_s, (range) => { this.range_s = range; this.load(); })), this.said, this.list),
      card("Download", h("p", { class: "dim" }, prose("The range above. A recording is the file that `toolpoint thermal train` reads.")), this.downloads));
  }

  leave() { clearInterval(this.timer); }

  async load() {
    const { status } = this.live;
    if (!status) { setTimeout(() => this.element.isConnected && this.load(), 300); return; }
    const to = status.time, from = to - this.range_s;
    try {
      const found = await ask("writes", { from, to, limit: LIMIT, reason: this.reason || undefined, outcome: this.outcome || undefined });
      const shown = found.writes;
      this.said.textContent = `${shown.length} ${shown.length === 1 ? "write" : "writes"}${found.more ? `, the newest ${LIMIT} of the range: ask for less time, or download all` : ""}.`;
      this.draw(shown);
      this.offer(from, to);
    } catch (error) {
      this.said.textContent = error.message;
    }
  }

  draw(writes) {
    const head = ["time", "outcome", "state", "reason", "requested [µm]", "written [µm]", "applied [µm]", "macros: old → new", "model", "delay"];
    const rows = writes.map((write) => {
      const [kind, words] = OUTCOMES[write.outcome] ?? ["", write.outcome];
      return [h("span", { title: clock(write.time, { date: true }) }, clock(write.time, { date: this.range_s > 86400 })), h("span", { class: `tag ${kind}` }, words), write.state ?? NONE,
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
    const link = (what, words, format) => h("a", { class: "download", href: `/api/v1/export?what=${what}&format=${format}&from=${from.toFixed(3)}&to=${to.toFixed(3)}`, target: "_blank" }, `${words} (${format === "csv" ? "CSV" : "Parquet"})`);
    this.downloads.replaceChildren(...[["writes", "writes"], ["recording", "recording"], ["temperatures", "temperatures"]].flatMap(([what, words]) => ["csv", "parquet"].map((format) => link(what, words, format))));
  }
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

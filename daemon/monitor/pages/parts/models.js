// Models: which are in force, what else there is, how they score. Releasing stays on the command line.

import { h, prose, card, table, clock, number, NONE } from "../dom.js";
import { ask } from "../api.js";

const NAMES = { thermal: "Thermal model in force", bearings: "Bearing model in force" };

export async function page(place) {
  const found = await ask("models");
  const grid = h("div", { class: "grid" });
  for (const [kind, words] of Object.entries(NAMES)) {
    const section = card(words, found[kind] ? facts(found[kind]) : h("p", { class: "dim" }, kind === "bearings" ? "None: the spindle speed is not tuned. See the guide Tune the spindle speed." : "None: train a model from recordings, evaluate it, and have a person release it."));
    section.classList.add("half");
    grid.append(section);
  }
  grid.append(list("Candidates", found.candidates, "No candidate lies in the folder of proposals: `toolpoint thermal train` makes one."), list("Releases", found.releases, "Nothing was released yet: `toolpoint model release` does it, under another account than the daemon's."),
    card("Releasing", h("p", {}, prose(found.note || "A model is released by a person on the command line: `toolpoint model release`. The daemon cannot release its own."))));
  place.append(h("h1", { class: "hidden" }, "Models"), grid);
  return {};
}

const KEYS = { model_id: "model", sha256: "hash", released_by: "released by", released: "released", release: "release", problem: "problem", warning: "attention" };

function facts(model) {
  const rows = Object.entries(model).filter(([, value]) => value !== null && value !== "");
  return h("dl", { class: "facts" }, rows.flatMap(([key, value]) => [h("dt", {}, words(key)), h("dd", { class: key === "problem" ? "said" : "" }, show(key, value))]));
}

const words = (key) => KEYS[key] ?? key.replace(/_um$/, " [µm]").replace(/_degc$/, " [°C]").replace(/_s$/, " [s]").replaceAll("_", " ");

function show(key, value) {
  if (value === null || value === undefined) return NONE;
  if (typeof value === "number") return /utc|time/.test(key) && value > 1e8 ? clock(value, { date: true }) : Number.isInteger(value) ? String(value) : number(value, 3);
  if (Array.isArray(value)) return value.map((one) => show(key, one)).join(", ") || NONE;
  if (typeof value === "object") return h("dl", { class: "facts" }, Object.entries(value).flatMap(([inner, one]) => [h("dt", {}, words(inner)), h("dd", {}, show(inner, one))]));
  return typeof value === "boolean" ? (value ? "yes" : "no") : key === "sha256" ? `${value.slice(0, 16)}…` : String(value);
}

function list(title, entries, empty) {
  if (!entries?.length) return card(title, h("p", { class: "dim" }, prose(empty)));
  const keys = [...new Set(entries.flatMap((entry) => Object.keys(entry)))];
  return card(title, table(keys.map(words), entries.map((entry) => keys.map((key) => show(key, entry[key]))), { caption: title }));
}

// Models: which are in force, what else there is, how they score. Releasing stays on the command line.

import { h, prose, card, table, clock, number, per, NONE } from "../dom.js";
import { ask } from "../api.js";

export async function page(place) {
  const found = await ask("models");
  const half = (section) => { section.classList.add("half"); return section; };
  place.append(h("h1", { class: "hidden" }, "Models"), h("div", { class: "grid" },
    half(card("Thermal model in force", found.thermal ? in_force(found.thermal, found.scores) : absent("None: train a model from recordings, evaluate it, and have a person release it."))),
    half(card("Bearing model in force", found.bearings ? in_force(found.bearings) : absent("None: the spindle speed is not tuned. See the guide Tune the spindle speed."))),
    card("Candidates", found.candidates.length ? candidates(found.candidates) : absent("No candidate lies in the folder of proposals: `toolpoint thermal train` makes one, and so does the retraining (compensation.retraining).")),
    card("Releases", found.releases.length ? releases(found.releases) : absent("Nothing was released yet: `toolpoint model release` does it, under another account than the daemon's.")),
    card("Releasing", h("p", {}, prose(`${found.note[0].toUpperCase()}${found.note.slice(1)}.`)))));
  return {};
}

const absent = (words) => h("p", { class: "dim" }, prose(words));
const facts = (rows) => h("dl", { class: "facts" }, rows.filter(([, value]) => value !== null && value !== "" && value !== undefined).flatMap(([words, value, classes]) => [h("dt", {}, words), h("dd", { class: classes }, value)]));
const day = (iso) => { const at = Date.parse(iso); return Number.isNaN(at) ? iso : clock(at / 1000, { date: true }); };

function in_force(model, scores = null) {
  return facts([
    ["model", model.model_id], ["hash", model.sha256 && h("span", { title: model.sha256 }, `${model.sha256.slice(0, 16)}…`)],
    ["release", model.release], ["released by", model.released_by], ["released", model.released && day(model.released)],
    ...(scores ? [["kind", scores.kind], ["made", day(scores.created)], ["trained on", trained(scores)], ["error left", left(scores)], ["bands", bands(scores)]] : []),
    ["problem", model.problem, "said"], ["attention", model.warning],
  ]);
}

function candidates(found) {
  const head = ["model", "made", "trained on", "error left, held out", "band of its limit", "verdict"];
  return table(head, found.map((one) => [one.model_id, one.scores ? [day(one.scores.created), h("small", { class: "dim" }, ` ${one.scores.kind}`)] : NONE, one.scores ? trained(one.scores) : NONE,
    one.scores ? left(one.scores, "") : NONE, one.scores ? bands(one.scores) : NONE, verdict(one)]), { caption: "Candidates", classes: "candidates" });
}

// Whether it would be released, and why not: the check that it does no harm among others.
function verdict({ against, released_as: number, file }) {
  if (number !== null) return h("span", { class: "tag good" }, `released as ${number}`);
  if (against) return h("span", {}, h("span", { class: "tag bad" }, "refused"), " ", against);
  return h("span", {}, h("span", { class: "tag good" }, "does no harm"), " ", prose(`a person may release it: \`toolpoint model release ${file}\``));
}

const trained = ({ recordings, hours }) => h("span", { title: recordings.join("\n") }, `${recordings.length} ${recordings.length === 1 ? "recording" : "recordings"}, ${number(hours, 0)} h`);

function left({ error_left: share }, of = " of the error on what was held out") {
  return share === null ? h("span", { class: "dim" }, "not in its file") : h("span", { title: "RMSE with the model / without, on what was held out of the training" }, `${number(100 * share, 0)} %${of}`);
}

function bands({ bands: found }) {
  return h("ul", { class: "plain" }, found.map(({ channel, band_um: band, widest_um: widest, unit: of }) => h("li", {}, `${channel} `,
    band === null ? "not known: nothing was held out" : h("b", { class: widest !== null && band > widest ? "said" : "" }, `± ${number(band)} ${per({ unit: of })}`), widest === null ? "" : h("span", { class: "dim" }, ` of ${number(widest, 0)}`))));
}

function releases(found) {
  return table(["release", "model", "action", "by", "when", "note", "checked"], found.map((one) => [one.release, one.model_id, one.action, one.released_by, day(one.released), one.note,
    h("details", {}, h("summary", {}, `${one.checks.length} checks`), h("ul", { class: "plain" }, one.checks.map((check) => h("li", {}, check))))]), { caption: "Releases", classes: "releases" });
}

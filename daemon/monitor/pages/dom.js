// Makes elements and writes numbers, with their units, the same on every page.

const SVG = "http://www.w3.org/2000/svg";

// h("td", {class: "number"}, "3.1 µm"): texts are never read as HTML.
export function h(tag, attributes = {}, ...children) {
  return fill(document.createElement(tag), attributes, children);
}

export function s(tag, attributes = {}, ...children) {
  return fill(document.createElementNS(SVG, tag), attributes, children);
}

function fill(element, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  element.append(...children.flat(Infinity).filter((child) => child !== null && child !== undefined && child !== false));
  return element;
}

// Replace what an element holds, unless nothing differs: what is read out, selected, opened or focused stays so.
export function put(element, ...children) {
  const fresh = h("div", {}, ...children);
  const opened = [...element.querySelectorAll("details")].map((one) => one.open);
  fresh.querySelectorAll("details").forEach((one, place) => { one.open = opened[place] ?? false; });
  if (fresh.innerHTML === element.innerHTML) return;
  const focused = element.contains(document.activeElement) ? document.activeElement.id : "";
  element.replaceChildren(...fresh.childNodes);
  if (focused) document.getElementById(focused)?.focus();
}

export const NONE = "–";
const known = (value) => typeof value === "number" && Number.isFinite(value);

export function number(value, digits = 1) {
  if (!known(value)) return NONE;
  const text = value.toFixed(digits);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−");
}

export function signed(value, digits = 1) {
  if (!known(value)) return NONE;
  const text = number(value, digits);
  return value > 0 && Number(value.toFixed(digits)) !== 0 ? `+${text}` : text;
}

// A number and its unit; the unit alone is never shown.
export function unit(value, of, digits = 1) {
  return known(value) ? `${number(value, digits)} ${of}` : NONE;
}

// What the micrometres of an axis or channel are: a slope's count at one metre from its pivot.
export const per = (one) => (one?.unit === "um/m" ? "µm/m" : "µm");
export const um = (value, of) => (known(value) ? `${signed(value)} ${per(of)}` : NONE);
export const degc = (value) => unit(value, "°C", 2);

export function seconds(value) {
  if (!known(value)) return NONE;
  if (value < 0.1) return `${number(value * 1000, 1)} ms`;
  if (value < 10) return `${number(value, 2)} s`;
  return `${number(value, 1)} s`;
}

export function duration(value) {
  if (!known(value)) return NONE;
  if (value < 90) return `${Math.round(value)} s`;
  if (value < 5400) return `${Math.round(value / 60)} min`;
  if (value < 172800) return `${number(value / 3600, 1)} h`;
  return `${Math.round(value / 86400)} days`;
}

const two = (value) => String(value).padStart(2, "0");

export function clock(utc_s, { date = false } = {}) {
  if (!known(utc_s)) return NONE;
  const at = new Date(utc_s * 1000);
  const time = `${two(at.getHours())}:${two(at.getMinutes())}:${two(at.getSeconds())}`;
  return date ? `${at.getFullYear()}-${two(at.getMonth() + 1)}-${two(at.getDate())} ${time}` : time;
}

// A sentence in which `commands` stand between backticks.
export function prose(text) {
  return text.split("`").map((piece, place) => (place % 2 ? h("code", {}, piece) : piece));
}

export function card(title, ...children) {
  return h("section", { class: "card" }, h("h2", {}, title), ...children);
}

// What a page says where its part is not configured: why it is empty, and how to get it.
export function absent(title, why, how) {
  return h("section", { class: "card absent" }, h("h2", {}, title), h("p", {}, prose(why)), h("p", {}, prose(how)));
}

export function table(head, rows, { caption = "", classes = "" } = {}) {
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": caption },
    h("table", { class: classes },
      h("caption", { class: "hidden" }, caption),
      h("thead", {}, h("tr", {}, head.map((word) => h("th", { scope: "col" }, word)))),
      h("tbody", {}, rows.map((row) => h("tr", {}, row.map((cell, column) =>
        h("td", { "data-head": head[column] }, cell)))))));
}

export function choice(name, options, chosen, onchange) {
  const select = h("select", { id: `choice-${name.replaceAll(" ", "-")}`, onchange: (event) => onchange(event.target.value) },
    options.map(([value, words]) => h("option", { value, selected: value === chosen }, words)));
  return h("label", { class: "choice" }, h("span", {}, name), select);
}

export function buttons(name, options, chosen, onchange) {
  const group = h("div", { class: "buttons", role: "group", "aria-label": name });
  group.append(...options.map(([value, words]) => h("button", {
    type: "button", "aria-pressed": String(value === chosen),
    onclick: (event) => {
      for (const other of group.children) other.setAttribute("aria-pressed", String(other === event.target));
      onchange(value);
    },
  }, words)));
  return group;
}

// The frame of every page: navigation, age, stale, theme, who is logged in, and questions before anything acts.

import { h, put, clock, duration } from "./dom.js";
import { PAGES, MESSAGES } from "./words.js";
import { live, STALE_S } from "./live.js";
import { act, who, Refused } from "./api.js";

const $ = (id) => document.getElementById(id);
const ALL = [...PAGES, MESSAGES];
const MODULES = Object.fromEntries(ALL.map(([name]) => [name, () => import(`./parts/${name}.js`)]));
const AGAIN_MS = 2000;
let shown = null;
let visits = 0;
let failed_ms = Infinity;
let person = null;

// --- pages -----------------------------------------------------------------------------

const wanted = () => {
  const name = location.hash.replace(/^#\/?/, "").split("?")[0];
  return MODULES[name] ? name : "overview";
};

function navigation() {
  const name = wanted();
  $("pages").replaceChildren(...PAGES.map(([page, words]) =>
    h("a", { href: `#/${page}`, "aria-current": page === name ? "page" : false }, words)));
  const here = $("pages").querySelector("[aria-current]");
  if (here) $("pages").scrollLeft = here.offsetLeft - $("pages").offsetLeft - ($("pages").clientWidth - here.offsetWidth) / 2; // a narrow screen scrolls them
}

async function show() {
  const name = wanted(), visit = ++visits, place = h("div", {}); // what comes when the person has gone on goes to no other page
  navigation();
  shown?.leave?.();
  shown = null;
  failed_ms = Infinity;
  $("page").replaceChildren(place);
  $("page").dataset.page = name;
  try {
    const module = await MODULES[name]().catch((cause) => { throw new Error("The daemon has not sent this page.", { cause }); });
    const made = visit === visits ? await module.page(place, context) ?? {} : {};
    if (visit !== visits) return made.leave?.();
    shown = made;
    if (live.status) shown.status?.(live.status);
  } catch (error) {
    if (visit !== visits) return;
    const refused = error instanceof Refused;
    if (refused && error.status === 401) login();
    if (!refused) failed_ms = performance.now();
    place.replaceChildren(h("section", { class: "card absent" }, h("h1", {}, "This page cannot be shown"), h("p", {}, error.message),
      !refused && h("p", {}, "It is tried again by itself as soon as the daemon answers.")));
    if (!refused) console.error(error);
  }
  title();
}

function title() {
  const words = ALL.find(([page]) => page === wanted())?.[1];
  const { status } = live;
  document.title = status ? `${live.stale ? "(old) " : ""}${status.state} · ${words} · ${status.machine}` : `${words} · Toolpoint`;
}

// --- what is live ----------------------------------------------------------------------

live.addEventListener("status", ({ detail: status }) => {
  $("machine").textContent = status.machine;
  put($("foot"), `Toolpoint ${status.version ?? ""}`,
    status.clock_speed !== 1 ? ` · a simulation, ${status.clock_speed} times as fast as the clock on the wall` : "",
    ` · the machine's time is ${clock(status.time, { date: true })} · `, h("a", { href: "#/messages" }, "messages"), " · ", h("a", { href: "/openapi.json" }, "API"), " · ", h("a", { href: "/metrics" }, "metrics"));
  if (performance.now() - failed_ms > AGAIN_MS) show();
  shown?.status?.(status);
  title();
});

live.addEventListener("cycle", ({ detail }) => shown?.cycle?.(detail));

live.addEventListener("age", () => {
  const { stale, status } = live;
  const waited_s = status === null ? performance.now() / 1000 : (performance.now() - live.heard_ms) / 1000;
  const old = stale && waited_s > STALE_S;
  if (old !== document.body.classList.contains("stale")) {
    document.body.classList.toggle("stale", old);
    title();
    who().then(rights).catch(() => {});
  }
  $("stale").hidden = !old;
  if (old) {
    put($("stale"), locked() ? "Log in to see the machine." : status === null ? "The daemon does not answer. This page tries again by itself."
      : `What you see is ${duration(waited_s)} old: the daemon has not answered since. This page tries again by itself.`);
  }
  $("age").textContent = status === null ? "connecting" : old ? `stale, ${duration(waited_s)} old` : `live, ${Math.max(waited_s, 0).toFixed(1)} s old`;
});

// --- rights, login, questions ------------------------------------------------------------

const RANK = { viewer: 1, operator: 2, engineer: 3 };
const context = {
  live,
  get person() { return person; },
  may(role) { return (RANK[person?.role] ?? 0) >= RANK[role] && Boolean(person?.name); },
  confirm,
  go(name) { location.hash = `#/${name}`; },
};

function rights(session) {
  person = session;
  const place = $("person");
  if (session.name) {
    put(place, h("span", { class: "dim" }, `${session.name}, ${session.role} `), h("button", { type: "button", class: "quiet", id: "logout" }, "Log out"));
    $("logout").addEventListener("click", async () => { await act("session", {}, "DELETE"); location.reload(); });
  } else if (session.accounts === false) {
    put(place, h("span", { class: "dim", title: "Make accounts with `toolpoint users add`." }, "view only"));
  } else {
    put(place, h("button", { type: "button", class: "quiet", id: "login" }, "Log in"));
    $("login").addEventListener("click", login);
  }
  if (shown && live.status) shown.status?.(live.status);
  if (locked()) login();
}

// Nobody may look before logging in.
const locked = () => Boolean(person?.accounts) && !person.role;

function login() {
  if ($("ask").open) return;
  const said = h("p", { class: "said", role: "alert" });
  const name = h("input", { name: "name", autocomplete: "username", required: true });
  const password = h("input", { name: "password", type: "password", autocomplete: "current-password", required: true });
  dialog("Log in", [h("label", {}, "Name", name), h("label", {}, "Password", password), said], "Log in", async () => {
    try {
      await act("session", { name: name.value, password: password.value });
      $("ask").close();
      rights(await who());
      live.connect();
      await show();
      return true;
    } catch (error) {
      said.textContent = error.message;
      return false;
    }
  });
}

// Ask before an action; `carry` is done on yes. What it refuses is said in the dialog.
function confirm({ question, explanation, yes, danger = false, carry }) {
  const said = h("p", { class: "said", role: "alert" });
  dialog(question, [h("p", {}, explanation), said], yes, async () => {
    try {
      await carry();
      return true;
    } catch (error) {
      if (error instanceof Refused && error.status === 401) { // the log-in has ended meanwhile
        $("ask").close();
        login();
        return false;
      }
      said.textContent = error.message;
      return false;
    }
  }, danger);
}

function dialog(heading, content, yes, carry, danger = false) {
  const ask = $("ask");
  const form = h("form", { method: "dialog" }, h("h2", { id: "ask-title" }, heading), ...content,
    h("div", { class: "actions" },
      h("button", { type: "button", class: "quiet", onclick: () => ask.close() }, "Cancel"),
      h("button", { type: "submit", class: danger ? "danger" : "" }, yes)));
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    if (form.ariaBusy) return; // a second click
    form.ariaBusy = "true";
    if (await carry() && form.isConnected) ask.close(); // another question may be open by now
    form.ariaBusy = null;
  });
  ask.replaceChildren(form);
  ask.showModal();
}

// --- theme -------------------------------------------------------------------------------

const dark = () => (document.documentElement.dataset.theme ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";

function themed() {
  $("theme").hidden = false;
  $("theme").textContent = dark() ? "Light" : "Dark";
  dispatchEvent(new Event("theme"));
}

$("theme").addEventListener("click", () => {
  document.documentElement.dataset.theme = dark() ? "light" : "dark";
  try { localStorage.setItem("theme", document.documentElement.dataset.theme); } catch { /* kept for this visit only */ }
  themed();
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", themed);

// On paper everything stands in the colours of light.
let on_screen = null;
addEventListener("beforeprint", () => {
  on_screen ??= document.documentElement.dataset.theme ?? "";
  document.documentElement.dataset.theme = "light";
  themed();
});
addEventListener("afterprint", () => {
  if (on_screen) document.documentElement.dataset.theme = on_screen;
  else delete document.documentElement.dataset.theme;
  on_screen = null;
  themed();
});

addEventListener("hashchange", () => { show(); $("page").focus({ preventScroll: true }); scrollTo(0, 0); });
navigation();
themed();
live.start();
who().then(rights).catch(() => {});
show().then(() => performance.mark("interactive"));

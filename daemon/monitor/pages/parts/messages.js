// Messages: every sentence that the daemon may say while it runs, its cause, and what to do.

import { h, prose, table } from "../dom.js";
import { load } from "../messages.js";

export async function page(place) {
  const entries = await load();
  const list = h("div", {});
  const search = h("input", { type: "search", id: "search", placeholder: "words of the message", oninput: () => draw() });
  const draw = () => {
    const asked = search.value.toLowerCase().split(/\s+/).filter(Boolean);
    const found = entries.filter((one) => asked.every((word) => `${one.text} ${one.cause} ${one.remedy}`.toLowerCase().includes(word)));
    const rooms = [...new Set(found.map((one) => one.room))];
    list.replaceChildren(...rooms.map((room) => h("section", { class: "card" }, h("h2", {}, room),
      table(["what it says", "cause", "what to do"], found.filter((one) => one.room === room).map((one) => [one.text, prose(one.cause), prose(one.remedy)]), { caption: room, classes: "messages" }))));
    if (!rooms.length) list.append(h("section", { class: "card" }, "No message has these words."));
  };
  draw();
  list.className = "stack";
  place.append(h("h1", { class: "hidden" }, "Messages"), h("div", { class: "stack" },
    h("section", { class: "card between" }, h("span", {}, "What the daemon may say while it runs, why, and what to do. … stands for what is filled in."),
      h("label", { class: "choice" }, h("span", {}, "find"), search)), list));
  return {};
}

// What the daemon says, and what to do about it: the table of the manual, read when a sentence needs it.

const LONGEST = 400; // of a longer sentence only the beginning is compared: the patterns try every place in it
const KEPT = 50;
let entries = null;
let loading = null;
const known = new Map();

async function rows(name) {
  const answer = await fetch(`vendor/${name}`);
  if (!answer.ok) throw new Error("The table of messages is not installed beside the pages: install Toolpoint anew.");
  let room = "";
  const found = [];
  for (const line of (await answer.text()).split("\n")) {
    if (line.startsWith("## ")) room = line.slice(3);
    if (line.startsWith("| ")) found.push([room, ...line.slice(2, -2).split(/(?<!\\) \| /).map((cell) => cell.replaceAll("\\|", "|").replaceAll("&lt;", "<"))]);
  }
  return found;
}

// Entries {room, text, cause, remedy} by the headings of the manual's page.
export async function load() {
  return (await rows("messages.md")).filter((row) => row.length === 4 && row[1] !== "what it says").map(([room, text, cause, remedy]) => ({ room, text, cause, remedy }));
}

// Of these only what has a remedy: a third of the bytes.
function loadRemedies() {
  loading ??= rows("remedies.md").then((found) => { entries = found.map(([, text, remedy]) => ({ text, remedy, pattern: pattern(text) })); });
  return loading;
}

const literal = (text) => text.replace(/…/g, "").trim().length;
const pattern = (text) => new RegExp(text.split("…").map((piece) => piece.replace(/[.*+?^${}()|[\]\\]/g, "\\$&")).join("(.+)"));

// Remedies of a sentence, of the whole first and then of what it quotes; [] while the table is not there, or none fits.
export function remedies(sentence) {
  if (!sentence) return [];
  if (entries === null) {
    loadRemedies().catch(() => {});
    return [];
  }
  const asked = sentence.slice(0, LONGEST);
  if (!known.has(asked)) {
    if (known.size >= KEPT) known.clear();
    known.set(asked, found(asked));
  }
  return known.get(asked);
}

function found(sentence) {
  const fits = entries.map((one) => [one, one.pattern.exec(sentence)]).filter(([one, match]) => match && literal(one.text) >= 10);
  const [best, match] = fits.sort(([a, x], [b, y]) => (y[0].length === sentence.length) - (x[0].length === sentence.length) || literal(b.text) - literal(a.text))[0] ?? [];
  if (!best) return [];
  const within = match.slice(1).flatMap((piece) => (piece.length < sentence.length ? remedies(piece) : []));
  return [...new Set([...(/^mend (the reason|what is named)(?!.*switch on again)/.test(best.remedy) && within.length ? [] : [best.remedy]), ...within])].slice(0, 2);
}

// What the daemon says, and what to do about it: the table of the manual, read when a sentence needs it.

const LONGEST = 400; // of a longer sentence only the beginning is compared: the patterns try every place in it
const KEPT = 50;
let entries = null;
let loading = null;
const known = new Map();

// Entries {text, cause, remedy} by the headings of the manual's page.
export function load() {
  loading ??= fetch("vendor/messages.md").then(async (answer) => {
    if (!answer.ok) throw new Error("The table of messages is not installed beside the pages: install Toolpoint anew.");
    entries = parse(await answer.text());
    return entries;
  });
  return loading;
}

function parse(markdown) {
  let room = "";
  const found = [];
  for (const line of markdown.split("\n")) {
    if (line.startsWith("## ")) room = line.slice(3);
    const cells = line.startsWith("| ") ? line.slice(2, -2).split(/(?<!\\) \| /).map((cell) => cell.replaceAll("\\|", "|").replaceAll("&lt;", "<")) : [];
    if (cells.length === 3 && cells[0] !== "what it says") found.push({ room, text: cells[0], cause: cells[1], remedy: cells[2], pattern: pattern(cells[0]) });
  }
  return found;
}

const literal = (text) => text.replace(/…/g, "").trim().length;
const pattern = (text) => new RegExp(text.split("…").map((piece) => piece.replace(/[.*+?^${}()|[\]\\]/g, "\\$&")).join("(.+)"));
const says_nothing = ({ cause, remedy }) => /^((part|name|frame|condition)( of|:)|\()/.test(cause) || /^(as it says|read the reason|see there)/.test(remedy);

// Remedies of a sentence, of the whole first and then of what it quotes; [] while the table is not there, or none fits.
export function remedies(sentence) {
  if (!sentence) return [];
  if (entries === null) {
    load().catch(() => {});
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
  const fits = entries.filter((one) => !says_nothing(one)).map((one) => [one, one.pattern.exec(sentence)]).filter(([one, match]) => match && literal(one.text) >= 10);
  const [best, match] = fits.sort(([a, x], [b, y]) => (y[0].length === sentence.length) - (x[0].length === sentence.length) || literal(b.text) - literal(a.text))[0] ?? [];
  if (!best) return [];
  const within = match.slice(1).flatMap((piece) => (piece.length < sentence.length ? remedies(piece) : []));
  return [...new Set([...(/^mend (the reason|what is named)(?!.*switch on again)/.test(best.remedy) && within.length ? [] : [best.remedy]), ...within])].slice(0, 2);
}

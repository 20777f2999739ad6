// Asks the daemon; what it refuses comes as a sentence.

export class Refused extends Error {
  constructor(status, sentence) {
    super(sentence);
    this.status = status;
  }
}

async function answer(response) {
  const type = response.headers.get("content-type") ?? "";
  const content = type.includes("json") ? await response.json() : null;
  if (!response.ok) {
    throw new Refused(response.status, content?.detail ?? content?.title ?? `The daemon answered ${response.status}.`);
  }
  return content;
}

export async function ask(path, parameters = {}) {
  const query = new URLSearchParams();
  for (const [name, value] of Object.entries(parameters)) {
    for (const one of Array.isArray(value) ? value : [value]) if (one !== undefined) query.append(name, one);
  }
  const text = query.toString();
  return answer(await fetch(`/api/v1/${path}${text ? `?${text}` : ""}`, { headers: { accept: "application/json" } }));
}

let session = null;

// Who looks, and what that person may do.
export async function who() {
  session = await ask("session");
  return session;
}

export async function act(path, content = {}, method = "POST") {
  if (!session?.csrf) await who();
  return answer(await fetch(`/api/v1/${path}`, {
    method,
    headers: { "content-type": "application/json", "x-csrf-token": session?.csrf ?? "" },
    body: method === "DELETE" ? undefined : JSON.stringify(content),
  }));
}

// A function that is called with every question; what it returns tells, when the answer is there, whether no newer one was asked.
export function newest() {
  let asked = 0;
  return () => {
    const mine = ++asked;
    return () => mine === asked;
  };
}

// Series between two instants [UTC s], decimated to `points` by the daemon.
export function series(names, from, to, points) {
  return ask("series", { name: names, from, to, points });
}

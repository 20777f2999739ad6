// Recorded series on one axis of time, and what follows from them.

import { ask } from "./api.js";

const SPAN = 4;

// The daemon decimates each name into equal pieces of time: put all names on that grid, [t, values...].
// undefined: between two samples of a slow series, the line goes on; null: nothing came, the line breaks.
export function aligned(answers, wanted, from, to, points) {
  const width = (to - from) / points;
  const t = Array.from({ length: points }, (_, index) => from + (index + 0.5) * width);
  return [t, ...wanted.map(([name, kind]) => on_grid(answers[name], kind, from, width, points))];
}

function on_grid(one, kind, from, width, points) {
  const values = new Array(points).fill(null);
  if (!one || one.t.length === 0) return values;
  const steps = [];
  let before = null;
  for (let place = 0; place < one.t.length; place++) {
    const index = Math.min(points - 1, Math.max(0, Math.floor((one.t[place] - from) / width)));
    values[index] = one[kind][place];
    if (before !== null && index > before) steps.push(index - before);
    before = index;
  }
  const usual = steps.sort((a, b) => a - b)[Math.floor(steps.length / 2)] ?? 1;
  before = null;
  for (let index = 0; index < points; index++) {
    if (values[index] === null) continue;
    if (before !== null && index - before <= SPAN * usual) values.fill(undefined, before + 1, index);
    before = index;
  }
  return values;
}

// What was written stays until something else is: hold the last value.
export function held(values) {
  let last = null;
  return values.map((value) => (last = value ?? last));
}

// Value of a held series at an instant.
export function at(t, values, instant) {
  let found = null;
  for (let index = 0; index < t.length && t[index] <= instant; index++) found = values[index] ?? found;
  return found;
}

// Per instant the value of a stepped quantity that changed at `marks` (instants), as `of(mark)` says.
export function since(t, marks, of) {
  const sorted = [...marks].sort((a, b) => a - b);
  let place = -1;
  return t.map((instant) => {
    while (place + 1 < sorted.length && sorted[place + 1] <= instant) place++;
    return place < 0 ? of(null) : of(sorted[place]);
  });
}

let begin = null;

// Where a range of time begins: not before anything was recorded.
export async function begun(from, to) {
  begin ??= (await ask("names")).first;
  return begin === null || begin >= to ? from : Math.max(from, begin - Math.min(60, (to - begin) / 20));
}

export const each = (values, others, of) => values.map((value, index) =>
  (value === null || others[index] === null ? null : value === undefined || others[index] === undefined ? undefined : of(value, others[index])));

// Between two values, a straight line: for shading, which knows no gaps of sampling.
export function bridge(values) {
  const filled = [...values];
  let before = null;
  values.forEach((value, index) => {
    if (typeof value !== "number") return;
    if (before !== null && values[before + 1] === undefined) {
      for (let place = before + 1; place < index; place++) filled[place] = values[before] + ((value - values[before]) * (place - before)) / (index - before);
    }
    before = index;
  });
  return filled;
}

// The upper and lower edge of a band around values; without a break where the line has none.
export function beside(values, half) {
  return [1, -1].map((sign) => each(bridge(values), bridge(half), (value, width) => value + sign * width));
}

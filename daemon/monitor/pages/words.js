// The words of the manual for what the numbers are; one place, so that every page says the same.

export const STATES = {
  OFF: { mark: "○", words: "Off: nothing is written." },
  ARMED: { mark: "◔", words: "Armed: switched on, and waiting for a reference." },
  ACTIVE: { mark: "●", words: "Active: the compensation follows the thermal error." },
  HOLD: { mark: "❚❚", words: "Hold: the compensation is frozen where it is." },
  RETREAT: { mark: "↩", words: "Retreat: the compensation is being taken back slowly." },
  BACK: { mark: "↩", words: "Back: the compensation is back where it was when the reference was set; it goes to zero when that ends." },
  FAULT: { mark: "✕", words: "Fault: nothing is written until a person acknowledges." },
};

export const TERMS = {
  estimated: "estimated thermal error: where the tool point has moved since the reference",
  requested: "requested compensation: before the limits",
  written: "written compensation: after the limits, in the CNC's macro variable",
  applied: "applied compensation: what the CNC has taken over, as its echo says; only this counts",
  bound: "absolute bound: the compensation never exceeds it",
  band: "band: half width of the interval in which the true error is expected",
};

export const PAGES = [
  ["overview", "Overview"],
  ["temperatures", "Temperatures"],
  ["thermal-error", "Thermal error"],
  ["dynamics", "Dynamics"],
  ["latency", "Latency"],
  ["history", "History"],
  ["models", "Models"],
];

// Not in the navigation: the state links to it.
export const MESSAGES = ["messages", "Messages"];

export const RANGES = [
  [600, "10 min"], [3600, "1 h"], [28800, "8 h"], [86400, "24 h"],
  [604800, "7 days"], [2592000, "30 days"], [31536000, "1 year"],
];

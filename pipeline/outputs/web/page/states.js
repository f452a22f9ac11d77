// The groups of fans, worst first, each with the symbol, the word and the class of its colour; how near a fan is to an
// alarm, in words.

export const GROUPS = [
  { name: "alarm", title: "in alarm", mark: "✖" },
  { name: "suspect", title: "suspect", mark: "▲" },
  { name: "learning", title: "learning", mark: "◔" },
  { name: "not_judged", title: "not judged", mark: "?" },
  { name: "silenced", title: "silenced", mark: "◌" },
  { name: "at_rest", title: "at rest", mark: "■" },
  { name: "normal", title: "normal", mark: "●" },
];
export const ABOUT = {
  alarm: "The fan differs from its twin by more than the alarm limit.",
  suspect: "The fan differs from its twin, but not yet for long enough to raise an alarm.",
  learning: "The fan's twin is being learned: until then nothing is judged.",
  not_judged: "The fan cannot be judged now: its view says why.",
  silenced: "In an alarm that an operator has shelved or taken out of service.",
  at_rest: "The command stops the fan, or it is starting.",
  normal: "The fan does what its twin does.",
};
export const groupNumber = (name) => GROUPS.findIndex((group) => group.name === name);

// Levels of fans, as pipeline/site/site_json.py makes them: 100 is the alarm limit.
export const HIGHEST_LEVEL = 250;
export const NO_LEVEL = 255;

export function levelText(level) {
  if (level === NO_LEVEL) return "";
  return level >= HIGHEST_LEVEL ? "over 2.5 times the alarm limit" : `${level} % of the alarm limit`;
}

export const bytes = (base64) => Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));

// The recordings around alarms, which can be downloaded.

import { clock, element } from "./dom.js";
import { ask, PREFIX } from "./server.js";

const key = (tray, alarm) => `${tray}/${alarm.fan}/${alarm.onset_t_ns}`;
let ofAlarms = new Map();

// Ask which there are; whether anything has changed.
export async function learnClips() {
  const { clips } = await ask("/clips");
  const found = new Map();
  for (const clip of clips) for (const alarm of clip.alarms) found.set(key(clip.tray, alarm), clip);
  const changed = found.size !== ofAlarms.size || [...found].some(([name, clip]) => ofAlarms.get(name)?.bytes !== clip.bytes);
  ofAlarms = found;
  return changed;
}

export function clipLink(alarm) {
  const clip = ofAlarms.get(key(alarm.tray, alarm));
  if (!clip) return null;
  const about = `${clock(clip.since_t_ns)} to ${clock(clip.until_t_ns)}${clip.problem ? `; ${clip.problem}` : ""}`;
  return element("a", { href: `${PREFIX}/clips/${encodeURIComponent(clip.name)}`, download: clip.name, title: about, "data-clip": clip.name },
    `Download clip (${(clip.bytes / 1e6).toFixed(1)} MB)`);
}

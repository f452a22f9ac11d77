// What fans are called, where they are, and the address of the view of each.

import { element } from "./dom.js";

let trays = new Map();

export function learnNames(site) {
  trays = new Map(site.trays.map((tray) => [tray.name, tray]));
}

export const nameOf = (tray, fan) => trays.get(tray)?.names?.[fan] ?? "";
export const placeOf = (tray, fan) => trays.get(tray)?.places?.[fan] ?? "";
export const unitOf = (tray) => trays.get(tray)?.speed_unit ?? "";
export const hashOf = (tray, fan) => `#/fan/${encodeURIComponent(tray)}/${fan}`;

export function label(tray, fan) {
  const name = nameOf(tray, fan);
  return name ? `${name} (fan ${fan})` : `fan ${fan}`;
}

// The same to be shown: between the brackets it is not broken.
export function shownLabel(tray, fan) {
  const name = nameOf(tray, fan);
  return name ? [`${name} `, element("span", { class: "number-of-fan" }, `(fan ${fan})`)] : [`fan ${fan}`];
}

export function inFull(tray, fan) {
  const name = nameOf(tray, fan);
  return name ? `${name} (${tray} fan ${fan})` : `${tray} fan ${fan}`;
}

export const where = (tray, fan) => [tray, placeOf(tray, fan)].filter(Boolean).join(" · ");
export const hasPlaces = () => new Set([...trays.values()].flatMap((tray) => tray.places ?? []).filter(Boolean)).size > 1;

// Elements and texts. What comes from outside is only ever set as text, never as markup.

// A number and its % stay on one line.
const unbroken = (text) => (typeof text === "string" ? text.replace(/(\d) %/g, "$1\u00a0%") : text);

export function element(tag, attributes = {}, ...children) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value === true) made.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) made.setAttribute(name, value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined && child !== "").map(unbroken));
  return made;
}

// A text that has not changed is not set again: that would cost a layout.
export function setText(shown, given) {
  const text = unbroken(given);
  if (shown.textContent !== text) shown.textContent = text;
}

const ms = (t_ns) => t_ns / 1e6;

const two = (number) => String(number).padStart(2, "0");
export const day = (at) => `${at.getFullYear()}-${two(at.getMonth() + 1)}-${two(at.getDate())}`;
export const time = (at) => `${two(at.getHours())}:${two(at.getMinutes())}:${two(at.getSeconds())}`;

// Local date and time; a time of 0 is none.
export function stamp(t_ns) {
  if (!t_ns) return "";
  const at = new Date(ms(t_ns));
  return `${day(at)} ${time(at)}`;
}

// Local time, with the date unless it is today.
export function clock(t_ns) {
  const at = new Date(ms(t_ns));
  return at.toDateString() === new Date().toDateString() ? time(at) : stamp(t_ns);
}

export const ageText = (t_ns) => lengthText((Date.now() - ms(t_ns)) / 1000);

export function lengthText(length_s) {
  const seconds = Math.max(0, Math.round(length_s));
  for (const [unit, size] of [["d", 86400], ["h", 3600], ["min", 60]]) {
    if (seconds >= 2 * size) return `${Math.floor(seconds / size)} ${unit}`;
  }
  return `${seconds} s`;
}

// How long ago, kept up to date as long as it is shown.
export function age(t_ns) {
  return element("time", { "data-since": t_ns }, ageText(t_ns));
}

setInterval(() => {
  for (const shown of document.querySelectorAll("time[data-since]")) {
    setText(shown, ageText(Number(shown.dataset.since)));
  }
}, 1000);

// Names and values; what has no value is left out.
export function facts(values) {
  const shown = Object.entries(values).filter(([, value]) => value !== "" && value !== null && value !== undefined);
  return element("dl", { class: "facts" }, ...shown.flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]));
}

// Draw a part of the page again; what had the focus has it afterwards, if it is still there.
export function keepFocus(root, draw) {
  const had = root.contains(document.activeElement) ? document.activeElement : null;
  const fan = had?.closest("[data-fan]")?.dataset.fan, action = had?.dataset.action;
  draw();
  if (!had || root.contains(document.activeElement)) return;
  const of = [...root.querySelectorAll("[data-fan]")].find((each) => each.dataset.fan === fan) ?? root;
  const next = [...of.querySelectorAll("[data-action]")].find((each) => each.dataset.action === action);
  (next ?? of.querySelector("a, button") ?? root.closest("[tabindex]"))?.focus();
}

export function percent(share) {
  return share === null || share === undefined ? "" : `${Math.round(share * 100)} %`;
}

let noticeTimer = 0;
export function notice(text) {
  const shown = document.getElementById("notice");
  shown.textContent = text;
  shown.hidden = false;
  clearTimeout(noticeTimer);
  noticeTimer = setTimeout(() => { shown.hidden = true; }, 8000);
}

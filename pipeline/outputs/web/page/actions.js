// What an operator does: log in, and ask a scorer something about a fan.

import { element, notice } from "./dom.js";
import { inFull } from "./names.js";
import { learnWhoIAm, me, Refused, send } from "./server.js";

export const ACTIONS = {
  acknowledge: { title: "Acknowledge", about: "I have seen this alarm." },
  shelve: { title: "Shelve", about: "Hide the fan's alarm for a while.", lasts: true },
  unshelve: { title: "Unshelve", about: "Show the fan's alarm again." },
  out_of_service: { title: "Out of service", about: "The fan is being worked on." },
  in_service: { title: "In service", about: "The fan is back in service." },
  true_alarm: { title: "True alarm", about: "Something was wrong with the fan." },
  false_alarm: { title: "False alarm", about: "Nothing was wrong with the fan. Calibration may learn from it.", needsReason: true },
  comment: { title: "Comment", about: "A comment for the history; nothing else changes.", needsReason: true },
  commission: { title: "Commission", about: "The fan was replaced or repaired: forget what was learned of it, and end its alarm." },
};
const SHELVED_FOR = [["30 minutes", 1800], ["2 hours", 7200], ["8 hours", 28800], ["1 day", 86400], ["7 days", 604800], ["until it clears", 0]];

const IN_SIGHT = 3;

// Those that make sense in the state of an alarm, what matters most first.
export function possible(alarm) {
  if (!alarm) return ["out_of_service", "commission"];
  return [
    alarm.retained && !alarm.acknowledged ? "acknowledge" : "",
    alarm.shelved_until_t_ns ? "unshelve" : "shelve",
    ...feedbackOn(alarm),
    "comment",
    alarm.out_of_service ? "in_service" : "out_of_service",
    "commission",
  ].filter(Boolean);
}

// What may still be said of an alarm: the last word counts.
export function feedbackOn(alarm) {
  return alarm.severity === "none" ? [] : ["true_alarm", "false_alarm"].filter((each) => each !== alarm.feedback);
}

export function buttons(tray, fan, alarm) {
  if (!me.may_act) return element("p", { class: "muted" }, hint());
  const button = (action) => element("button", { type: "button", class: action === "acknowledge" ? "primary" : "", title: ACTIONS[action].about,
    onclick: () => askFor(action, tray, fan, alarm), "data-action": action }, ACTIONS[action].title);
  const all = possible(alarm).map(button), inSight = alarm ? IN_SIGHT : 0;
  return element("div", { class: "actions" }, ...all.slice(0, inSight), menu(alarm ? "More" : "Service", all.slice(inSight)));
}

// Buttons that are seldom needed. It closes when another place is used.
function menu(title, choices) {
  if (!choices.length) return "";
  const root = element("details", { class: "menu", onfocusout: (event) => { if (!root.contains(event.relatedTarget)) root.open = false; },
    onclick: (event) => { if (event.target.matches("div button")) root.open = false; } },
  element("summary", { class: "button", "data-action": "menu" }, title), element("div", { class: "group" }, ...choices));
  return root;
}

// To acknowledge all alarms of a tray at once, where there are several.
export function buttonsForAll(alarms) {
  const open = new Map();
  for (const alarm of alarms.filter((each) => me.may_act && each.presented && !each.acknowledged)) {
    open.set(alarm.tray, (open.get(alarm.tray) ?? 0) + 1);
  }
  const several = [...open].filter(([, count]) => count > 1);
  return several.length === 0 ? "" : element("div", { class: "actions" }, ...several.map(([tray, count]) => element("button", {
    type: "button", onclick: () => acknowledgeAll(tray, count), "data-action": `acknowledge ${tray}` }, `Acknowledge all ${count} of ${tray}`)));
}

function acknowledgeAll(tray, count) {
  const comment = element("input", { id: "comment", maxlength: 500, autocomplete: "off" });
  dialog(`Acknowledge all alarms of ${tray}`, element("div", {}, element("p", {}, `I have seen all ${count}. Any alarm raised in the meantime is acknowledged, too.`),
    element("label", { for: "comment" }, "Reason (for the record)"), comment), "Acknowledge all", async () => {
    const { answers } = await send(`/fans/${encodeURIComponent(tray)}/all/requests`, { action: "acknowledge", comment: comment.value });
    notice(`${answers.filter((answer) => answer.transition !== "refused").length} alarms of ${tray} acknowledged.`);
  });
}

// plan: which fans move between which commands, and for how long.
export function askForSweep(tray, plan) {
  dialog(`Move the fans of ${tray}`, element("p", {}, plan), "Move the fans", async () => {
    await send(`/trays/${encodeURIComponent(tray)}/sweep`, {});
  });
}

export async function stopSweep(tray) {
  try {
    await send(`/trays/${encodeURIComponent(tray)}/sweep`, {}, "DELETE");
  } catch (failure) {
    notice(failure instanceof Refused ? failure.message : "The server cannot be reached.");
  }
}

export function hint() {
  if (me.name) return `${me.name} may view but not act.`;
  return me.has_login ? "Log in to act." : "Nobody can act from this page: it needs users ([gateway] users in the configuration).";
}

export function askFor(action, tray, fan, alarm = null) {
  const { title, about, lasts, needsReason } = ACTIONS[action];
  const duration = lasts ? element("select", { id: "duration" }, ...SHELVED_FOR.map(([text, s]) => element("option", { value: s }, text))) : null;
  const comment = element("input", { id: "comment", maxlength: 500, autocomplete: "off", required: needsReason });
  dialog(`${title}: ${inFull(tray, fan)}`, element("div", {}, element("p", {}, about),
    duration && element("label", { for: "duration" }, "How long"), duration ?? "",
    element("label", { for: "comment" }, "Reason (for the record)"), comment), title, async () => {
    const body = { action, comment: comment.value };
    if (action.endsWith("_alarm") && alarm) body.onset_t_ns = alarm.onset_t_ns;
    if (duration) body.duration_s = Number(duration.value);
    const { answers } = await send(`/fans/${encodeURIComponent(tray)}/${fan}/requests`, body);
    notice(answers.map((answer) => answer.message).join("; "));
  });
}

export function showLogin(onDone) {
  const name = element("input", { id: "name", autocomplete: "username", required: true });
  const password = element("input", { id: "password", type: "password", autocomplete: "current-password", required: true });
  dialog("Log in", element("div", {}, element("label", { for: "name" }, "Name"), name,
    element("label", { for: "password" }, "Password"), password), "Log in", async () => {
    await send("/login", { name: name.value, password: password.value });
    await learnWhoIAm();
    onDone();
  });
}

export async function logOut(onDone) {
  await send("/logout", {});
  await learnWhoIAm();
  onDone();
}

// What opened a dialog may have been drawn again meanwhile: then the next thing to do has the focus.
function focusAgain(event) {
  const has = document.activeElement;
  if (has && has !== document.body && !event.target.contains(has)) return;
  (document.querySelector("main article .actions button") ?? document.getElementById("content")).focus();
}

function dialog(title, content, button, onDone) {
  const root = document.getElementById("dialog");
  const error = element("p", { class: "error", role: "alert" });
  const form = element("form", { method: "dialog", "aria-labelledby": "dialog-title", onsubmit: async (event) => {
    event.preventDefault();
    error.textContent = "";
    try {
      await onDone();
      root.close();
    } catch (failure) {
      error.textContent = failure instanceof Refused ? failure.message : "The server cannot be reached.";
    }
  } }, element("h2", { id: "dialog-title" }, title), content, error, element("div", { class: "actions" },
    element("button", { type: "button", onclick: () => root.close() }, "Cancel"),
    element("button", { type: "submit", class: "primary" }, button)));
  root.replaceChildren(form);
  root.onclose = focusAgain;
  root.showModal();
}

// The first hour: which twins are being learned, how far that is for each fan, how long it takes, and what would help.

import { askForSweep, hint, stopSweep } from "./actions.js";
import { clock, element, keepFocus, percent } from "./dom.js";
import { label } from "./names.js";
import { me } from "./server.js";

// Of a fan on a card, in a few words.
export const learningText = (fan) => (fan ? `${percent(fan.progress)} learned` : "");

function command(text) {
  return [element("code", {}, text), " ", element("button", { type: "button", class: "small", "data-action": "copy",
    onclick: (event) => navigator.clipboard?.writeText(text).then(() => { event.target.textContent = "Copied"; }) }, "Copy")];
}

export class LearningPanel {
  constructor() {
    this.root = element("div", { hidden: true });
    this.shown = "";
    this.stages = [];
  }

  setStages(stages) {
    this.stages = stages;
  }

  // learning: of each tray without a twin. isSilent: nothing was ever heard of any fan.
  update(learning, isSilent) {
    const problems = isSilent ? this.stages.filter((stage) => stage.detail).map((stage) => `${stage.name}: ${stage.detail}`) : [];
    const trays = Object.entries(learning), shown = JSON.stringify([trays, problems, isSilent, me.name, me.may_act]);
    if (shown === this.shown) return;
    this.shown = shown;
    this.root.hidden = !trays.length && !isSilent;
    keepFocus(this.root, () => this.root.replaceChildren(...trays.map(([tray, of]) => panel(tray, of)), isSilent && !trays.length ? silence(problems) : ""));
  }
}

function panel(tray, learning) {
  const { what, until_t_ns, fans } = learning;
  const rows = fans.map((fan, number) => element("tr", {}, element("td", { "data-label": "Fan" }, label(tray, number)),
    element("td", { "data-label": "Progress" }, element("progress", { max: 1, value: fan.progress, "aria-label": `Progress of ${label(tray, number)}` }), ` ${percent(fan.progress)}`),
    element("td", { "data-label": "Still missing" }, fan.missing || "nothing but time")));
  return element("section", { class: "panel learning", "aria-label": `Learning of ${tray}` }, element("h2", {}, `◔ Learning the healthy twin of ${tray}`),
    element("p", {}, `${what}. Until the twin is there, nothing is judged and no alarm is raised.${until_t_ns ? ` It will be there at about ${clock(until_t_ns).slice(0, -3)}.` : ""}`),
    element("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": `Progress of the fans of ${tray}` }, element("table", { class: "folding" },
      element("thead", {}, element("tr", {}, ...["Fan", "Progress", "Still missing"].map((text) => element("th", { scope: "col" }, text)))), element("tbody", {}, ...rows))),
    ...movement(tray, learning));
}

// What would move the fans: a button where the learner allows it, or else what to type; and what is moving them.
function movement(tray, { helps, command: sweep_command, sweep, fans }) {
  const button = (text, name, onclick) => element("button", { type: "button", class: "primary", "data-action": `${name} ${tray}`, onclick }, text);
  if (sweep?.running) return [element("p", { role: "status" }, `The fans are moved: ${sweep.running}. `, me.may_act ? button("Stop", "stop", () => stopSweep(tray)) : "")];
  const ended = sweep?.ended ? element("p", { role: "status" }, `The last sweep: ${sweep.ended}.`) : "";
  if (!fans.some((fan) => fan.missing)) return [ended];
  if (sweep) return [element("p", {}, "What would help: move the fans over their range. ", me.may_act ? button("Move the fans", "sweep", () => askForSweep(tray, sweep.plan)) : hint()), ended];
  if (!sweep_command) return [element("p", {}, `What would help: ${helps}.`)];
  return [element("p", {}, "What would help: move the fans over their range with ", ...command(sweep_command), ". Operators can start that here if the configuration has ",
    element("code", {}, "sweep_on_request = true"), " in ", element("code", {}, "[learner]"), ".")];
}

function silence(problems) {
  return element("section", { class: "panel" }, element("h2", {}, "No sample has come from any fan yet"),
    element("p", {}, "As soon as the source sends, the fans appear here by themselves."), ...problems.map((text) => element("p", {}, text)),
    element("p", {}, "What would help: ", ...command("fantwin status"), " says which stage waits for what; ", ...command("fantwin doctor"), " checks the configuration and its devices."));
}

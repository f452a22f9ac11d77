// The first hour: which twins are being learned, how far that is for each fan, how long it takes, and what would help.

import { clock, element, percent } from "./dom.js";
import { label } from "./names.js";

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

  // learning: of the fans of each tray without a twin. isSilent: nothing was ever heard of any fan.
  update(learning, isSilent) {
    const problems = isSilent ? this.stages.filter((stage) => stage.detail).map((stage) => `${stage.name}: ${stage.detail}`) : [];
    const trays = Object.entries(learning).filter(([, fans]) => fans.some(Boolean)), shown = JSON.stringify([trays, problems, isSilent]);
    if (shown === this.shown) return;
    const had = this.root.contains(document.activeElement);
    this.shown = shown;
    this.root.hidden = !trays.length && !isSilent;
    this.root.replaceChildren(...trays.map(([tray, fans]) => panel(tray, fans)), isSilent && !trays.length ? silence(problems) : "");
    if (had) this.root.querySelector("button")?.focus();
  }
}

function panel(tray, fans) {
  const { what, until_t_ns } = fans.find(Boolean), waiting = fans.filter((fan) => fan?.missing), [first] = waiting;
  const rows = fans.map((fan, number) => fan && element("tr", {}, element("td", { "data-label": "Fan" }, label(tray, number)),
    element("td", { "data-label": "Progress" }, element("progress", { max: 1, value: fan.progress, "aria-label": `Progress of ${label(tray, number)}` }), ` ${percent(fan.progress)}`),
    element("td", { "data-label": "Still missing" }, fan.missing || "nothing but time")));
  return element("section", { class: "panel learning", "aria-label": `Learning of ${tray}` }, element("h2", {}, `◔ Learning the healthy twin of ${tray}`),
    element("p", {}, `${what}. Until the twin is there, nothing is judged and no alarm is raised.${until_t_ns ? ` It will be there at about ${clock(until_t_ns).slice(0, -3)}.` : ""}`),
    element("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": `Progress of the fans of ${tray}` }, element("table", { class: "folding" },
      element("thead", {}, element("tr", {}, ...["Fan", "Progress", "Still missing"].map((text) => element("th", { scope: "col" }, text)))), element("tbody", {}, ...rows))),
    first?.helps ? element("p", {}, "What would help: ", ...(first.command ? ["move the fans over their range with ", ...command(first.command)] : [first.helps]), ".") : "");
}

function silence(problems) {
  return element("section", { class: "panel" }, element("h2", {}, "No sample has come from any fan yet"),
    element("p", {}, "As soon as the source sends, the fans appear here by themselves."), ...problems.map((text) => element("p", {}, text)),
    element("p", {}, "What would help: ", ...command("fantwin status"), " says which stage waits for what; ", ...command("fantwin doctor"), " checks the configuration and its devices."));
}

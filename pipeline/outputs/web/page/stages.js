// The stages: what works, how fast, and what was lost.

import { element } from "./dom.js";
import { badge } from "./alarms.js";

const WELL = ["ok", "stopped"];
const HEADS = [["Stage"], ["State"], ["In, messages/s", "number"], ["Out, messages/s", "number"], ["Delay, usual", "number", "Half of the outputs were not older than this"],
  ["Delay, worst 1 %", "number", "99 % of the outputs were not older than this"], ["Lost", "number", "Messages or samples that were lost since the stage began"], ["Notes"]];

export class StagesView {
  constructor() {
    this.body = element("tbody");
    this.shown = "";
    this.root = element("div", {}, element("h2", {}, "Stages"), element("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Stages" },
      element("table", { class: "folding" }, element("thead", {}, element("tr", {}, ...HEADS.map(([text, kind, title]) =>
        element("th", { scope: "col", class: kind, title }, text)))), this.body)));
  }

  update(stages) {
    const shown = JSON.stringify(stages);
    if (shown === this.shown) return;
    this.shown = shown;
    const cell = (label, content, kind = "") => element("td", { "data-label": label, class: kind }, content);
    const latency = (each, ms) => (each.latency_p99_ms ? `${ms.toFixed(1)} ms` : "");
    const about = (each) => (each.detail || each.notes.length) && element("div", {}, each.detail ? element("p", { class: "problem" }, `▲ ${each.detail}`) : "",
      ...each.notes.map((note) => element("p", { class: "muted" }, note)));
    this.body.replaceChildren(...stages.map((each) => element("tr", {}, cell("Stage", each.name),
      cell("State", WELL.includes(each.state) ? element("span", { class: "badge good" }, `● ${each.state}`) : badge("warning", each.state)),
      cell("In, messages/s", each.in_hz.toFixed(1), "number"), cell("Out, messages/s", each.out_hz.toFixed(1), "number"),
      cell("Delay, usual", latency(each, each.latency_p50_ms), "number"), cell("Delay, worst 1 %", latency(each, each.latency_p99_ms), "number"),
      cell("Lost", each.lost ? `▲ ${each.lost}` : "0", each.lost ? "number lost" : "number"), cell("Notes", about(each) || ""))));
  }
}

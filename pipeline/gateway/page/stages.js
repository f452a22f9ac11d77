// The stages: what works, how fast, and what was lost.

import { element } from "./dom.js";
import { badge } from "./alarms.js";

const WELL = ["ok", "stopped"];
const HEADS = ["Stage", "State", "In, Hz", "Out, Hz", "Latency p50, p99", "Lost", "Problem"];

export class StagesView {
  constructor() {
    this.body = element("tbody");
    this.root = element("div", {}, element("h2", {}, "Stages"), element("div", { class: "scroll" }, element("table", { class: "folding" },
      element("thead", {}, element("tr", {}, ...HEADS.map((text) => element("th", { scope: "col" }, text)))), this.body)));
  }

  update(stages) {
    const cell = (label, content, kind = "") => element("td", { "data-label": label, class: kind }, content);
    this.body.replaceChildren(...stages.map((each) => element("tr", {}, cell("Stage", each.name),
      cell("State", WELL.includes(each.state) ? element("span", { class: "badge good" }, `● ${each.state}`) : badge("warning", each.state)),
      cell("In, Hz", each.in_hz.toFixed(1), "number"), cell("Out, Hz", each.out_hz.toFixed(1), "number"),
      cell("Latency", `${each.latency_p50_ms} ms, ${each.latency_p99_ms} ms`, "number"),
      cell("Lost", String(each.lost), each.lost ? "number lost" : "number"), cell("Problem", each.detail))));
  }
}

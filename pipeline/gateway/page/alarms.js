// The list of alarms, and the history of their transitions.

import { ACTIONS, askFor, buttons, feedbackOn } from "./actions.js";
import { age, clock, element, percent } from "./dom.js";
import { ask, me } from "./server.js";

const MARKS = { alarm: "✖", warning: "▲", none: "●" };
const PAGE = 100;
const RATE_EVERY_MS = 10000;

const name = (alarm) => `${alarm.tray}/${alarm.fan}`;
const link = (alarm) => element("a", { href: `#/fan/${encodeURIComponent(alarm.tray)}/${alarm.fan}` }, `${alarm.tray} fan ${alarm.fan}`);

export function badge(severity, text) {
  return element("span", { class: `badge ${severity}` }, `${MARKS[severity] ?? ""} ${text}`);
}

export function card(alarm) {
  const kind = alarm.presented ? alarm.severity : "silenced";
  const cause = alarm.cause ? `${alarm.cause}${alarm.probability === null ? "" : `, ${percent(alarm.probability)}`}` : "";
  const evidence = alarm.causes[0]?.evidence ?? "";
  return element("article", { class: `card ${kind}`, "data-fan": name(alarm) },
    element("p", {}, badge(alarm.active ? alarm.severity : "none", alarm.active ? alarm.severity : "over"), " ",
      element("strong", {}, link(alarm)), ` since ${clock(alarm.onset_t_ns)} (${age(alarm.onset_t_ns)})`),
    element("p", { class: "muted" }, alarm.states.join(", ") + (alarm.acknowledged_by ? ` by ${alarm.acknowledged_by}` : "")),
    cause ? element("p", {}, element("strong", {}, cause), evidence ? `: ${evidence}` : "") : null,
    evidence && alarm.message.includes(evidence) ? null : element("p", {}, alarm.message),
    buttons(alarm.tray, alarm.fan, alarm));
}

export class AlarmsView {
  constructor(alarms) {
    this.alarms = alarms;
    this.root = element("div");
    this.rate = element("p", { class: "muted", id: "alarm-rate" });
    this.rated_ms = -RATE_EVERY_MS;
    this.update();
  }

  // How many alarms really were false, beside how many are declared.
  async showRate() {
    if (performance.now() - this.rated_ms < RATE_EVERY_MS) return;
    this.rated_ms = performance.now();
    const { site } = await ask("/alarm-rate");
    if (site.since_t_ns) this.rate.textContent = `Since ${clock(site.since_t_ns)}: ${site.text}.`;
  }

  update() {
    const rank = (alarm) => (alarm.presented ? 0 : 4) + (alarm.active ? 0 : 2) + (alarm.severity === "alarm" ? 0 : 1);
    const listed = [...this.alarms.values()].filter((alarm) => alarm.listed);
    listed.sort((one, other) => rank(one) - rank(other) || other.onset_t_ns - one.onset_t_ns);
    this.root.replaceChildren(element("h2", {}, `Alarms (${listed.length})`),
      ...(listed.length ? listed.map(card) : [element("p", { class: "muted" }, "No alarms.")]), this.rate);
    this.showRate().catch(() => {});  // the page says elsewhere that the server is away
  }
}

export class HistoryView {
  constructor(fan = null) {
    this.fan = fan;
    this.body = element("tbody");
    this.more = element("button", { type: "button", onclick: () => this.load() }, "Older");
    const heads = ["Time", "Fan", "What happened", "By", "Message"].map((text) => element("th", { scope: "col" }, text));
    this.root = element("div", {}, element("h2", {}, "History of alarms"), element("div", { class: "scroll" },
      element("table", { class: "folding" }, element("thead", {}, element("tr", {}, ...heads)), this.body)), this.more);
    this.before = 0;
    this.load();
  }

  async load() {
    const of = this.fan ? `&tray=${encodeURIComponent(this.fan.tray)}&fan=${this.fan.fan}` : "";
    const { transitions } = await ask(`/alarms/history?limit=${PAGE}&before=${this.before}${of}`);
    this.body.append(...transitions.map((each) => this.row(each)));
    this.before = transitions.at(-1)?.number ?? 0;
    this.more.hidden = transitions.length < PAGE;
    if (!this.body.childElementCount) this.body.append(element("tr", {}, element("td", { colspan: 5, class: "muted" }, "No alarm so far.")));
  }

  row(each) {
    const cell = (label, ...content) => element("td", { "data-label": label }, ...content);
    const what = each.transition.replaceAll("_", " ");
    return element("tr", {}, cell("Time", clock(each.t_ns)), cell("Fan", link(each)),
      cell("What happened", badge(each.active ? each.severity : "none", what)), cell("By", each.operator_name),
      cell("Message", each.message, each.comment ? ` “${each.comment}”` : "", each.transition === "raised" ? this.feedback(each) : ""));
  }

  // What was said of an alarm, and the buttons to say it.
  feedback(each) {
    const said = each.feedback === "none" ? "" : ` (${each.feedback.replaceAll("_", " ")})`;
    if (!me.may_act) return said;
    return element("span", {}, said, element("span", { class: "actions" }, ...feedbackOn(each).map((action) => element("button", {
      type: "button", "data-action": action, onclick: () => askFor(action, each.tray, each.fan, each) }, ACTIONS[action].title))));
  }
}

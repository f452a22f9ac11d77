// The history of alarms by days: one fault is one row, and what happened in it unfolds.

import { ACTIONS, askFor, feedbackOn } from "./actions.js";
import { clipLink } from "./clips.js";
import { clock, day, element, lengthText, percent, stamp } from "./dom.js";
import { whatHappened } from "./marks.js";
import { hashOf, inFull } from "./names.js";
import { ask, learn, me } from "./server.js";

const PAGE = 100;
const SAME_NS = 1e9;  // a scorer that restarts gives an onset again to within this
const SYMBOLS = { alarm: "✖", warning: "▲", none: "●" };

export const sameAlarm = (one, other) => one.tray === other.tray && one.fan === other.fan && Math.abs(one.onset_t_ns - other.onset_t_ns) < SAME_NS;

// What happened in one alarm, oldest first. transitions: newest first.
export function courseOf(transitions) {
  return element("ol", { class: "timeline" }, ...[...transitions].reverse().map((each) => element("li", { class: each.active ? each.severity : "none" },
    element("time", {}, stamp(each.t_ns).slice(5)), element("span", {}, element("strong", {}, whatHappened(each.transition)), each.operator_name ? ` by ${each.operator_name}` : "",
      each.message ? `: ${each.message}` : "", each.comment ? ` “${each.comment}”` : "",
      each.causes.length && !each.operator_name ? ` (${each.causes.slice(0, 3).map((cause) => `${cause.cause} ${percent(cause.probability)}`).join(", ")})` : ""))));
}

export class HistoryView {
  constructor(fan = null) {
    Object.assign(this, { fan, transitions: [], isComplete: false });
    this.body = element("div");
    this.more = element("button", { type: "button", onclick: () => learn(() => this.load(this.transitions.at(-1)?.number)), hidden: true }, "Older");
    this.reach = element("p", { class: "muted" });
    this.rate = element("p", { id: "alarm-rate", hidden: true });
    this.root = element("div", { class: "history" }, element("h2", {}, fan ? "Alarms of this fan" : "History of alarms"), fan ? "" : this.rate, this.body, this.more, this.reach);
    this.begin();
  }

  begin() {
    this.transitions = [];
    return learn(() => this.load());
  }

  // The newest page, or the one before a transition.
  async load(before = null) {
    const of = this.fan ? `&tray=${encodeURIComponent(this.fan.tray)}&fan=${this.fan.fan}` : "";
    const found = await ask(`/alarms/history?limit=${PAGE}${before === null ? "" : `&before=${before}`}${of}`);
    const known = new Map([...this.transitions, ...found.transitions].map((each) => [each.number, each]));
    this.transitions = [...known.values()].sort((one, other) => other.number - one.number);
    if (before !== null || this.more.hidden) this.more.hidden = found.transitions.length < PAGE;
    this.begins_t_ns = found.begins_t_ns;
    this.draw();
    if (!this.fan) await this.showRate();
  }

  // How many alarms really were false, once there are enough hours to say something.
  async showRate() {
    const { site } = await ask("/alarm-rate");
    this.rate.hidden = !site.enough;
    if (!site.enough) return;
    const [per_day, low, high, declared] = [site.false_alarms_per_day, ...site.interval_95, site.declared_per_day].map((each) => each === null ? "" : Number(each.toPrecision(2)).toString());
    this.rate.textContent = `False alarms since ${clock(site.since_t_ns)}: ${site.false_alarms}, that is ${per_day} per fan and day (95 % interval ${low} to ${high})${
      declared && `; the alarm limits are set for ${declared}`}. ${site.unmarked ? `${site.unmarked} more nobody has marked as true or false.` : ""}`;
  }

  // A transition has come.
  update() {
    this.due ||= setTimeout(() => { this.due = 0; if (this.root.isConnected) learn(() => this.load()); }, 200);
  }

  draw() {
    const faults = [], open = new Set([...this.body.querySelectorAll("details[open]")].map((each) => each.dataset.fault));
    for (const each of this.transitions) {
      const fault = faults.find((one) => sameAlarm(one[0], each));
      if (fault) fault.push(each);
      else faults.push([each]);
    }
    faults.sort((one, other) => other[0].onset_t_ns - one[0].onset_t_ns);
    const days = new Map();
    for (const fault of faults) {
      const of = day(new Date(fault[0].onset_t_ns / 1e6));
      days.set(of, [...(days.get(of) ?? []), fault]);
    }
    this.body.replaceChildren(...[...days].map(([of, list]) => element("section", {}, element("h3", {}, of === day(new Date()) ? "Today" : of), ...list.map((fault) => this.row(fault, open)))));
    const since = this.begins_t_ns ? ` since ${clock(this.begins_t_ns)}, when this history begins` : "";
    this.reach.textContent = faults.length ? (this.begins_t_ns && this.more.hidden ? `The history reaches back to ${clock(this.begins_t_ns)}.` : "") : `● No alarm${since}.`;
  }

  // One fault. Its newest transition is first.
  row(fault, open) {
    const [last] = fault, first = fault.at(-1), key = `${last.tray}/${last.fan}/${Math.round(last.onset_t_ns / SAME_NS)}`;
    const worst = ["alarm", "warning"].find((severity) => fault.some((each) => each.severity === severity)) ?? "none";
    const cause = fault.find((each) => each.causes.length)?.causes[0], cleared = fault.find((each) => each.transition === "cleared");
    const known = fault.find((each) => each.feedback !== "none");
    const said = known ? ACTIONS[known.feedback].title.toLowerCase() : "";
    const by = [...new Set(fault.map((each) => each.operator_name).filter(Boolean))].join(", ");
    const length = cleared ? `for ${lengthText((cleared.t_ns - last.onset_t_ns) / 1e9)}` : last.active ? "still active" : "";
    return element("details", { class: "fault", "data-fault": key, open: open.has(key) },
      element("summary", {}, element("span", { class: `badge ${last.active ? worst : "plain"}` }, `${SYMBOLS[worst]} ${worst === "none" ? "event" : worst}`), element("time", {}, stamp(last.onset_t_ns).slice(11)),
        this.fan ? "" : element("span", { class: "name" }, inFull(last.tray, last.fan)), element("span", { class: "what" }, cause ? `${cause.cause}, ${percent(cause.probability)}` : first.message),
        element("span", { class: "muted" }, [length, by, said].filter(Boolean).join(" · "))),
      courseOf(fault), element("div", { class: "links" }, this.fan ? "" : element("a", { href: hashOf(last.tray, last.fan) }, "Open the fan"), clipLink(last), this.feedback(known ?? last)));
  }

  // The buttons to say whether the alarm was true.
  feedback(each) {
    if (!me.may_act) return "";
    return element("span", { class: "actions" }, ...feedbackOn(each).map((action) => element("button", {
      type: "button", "data-action": action, onclick: () => askFor(action, each.tray, each.fan, each) }, ACTIONS[action].title)));
  }
}

// The list of alarms, and the history of their transitions.

import { ACTIONS, askFor, buttons, buttonsForAll, feedbackOn } from "./actions.js";
import { age, clock, element, facts, fanLabel, keepFocus, percent, stamp } from "./dom.js";
import { clipLink } from "./clips.js";
import { ask, learn, me } from "./server.js";

const OF_FAN = ["raised", "severity", "diagnosed"];  // these have the colour of the severity: nothing else is bad
const MARKS = { alarm: "✖", warning: "▲", none: "●" };
const PAGE = 100;
const SHOWN = 100;
const RATE_EVERY_MS = 60000, RATE_AFTER_MS = 3000;

const name = (alarm) => `${alarm.tray}/${alarm.fan}`;
const link = (alarm) => element("a", { href: `#/fan/${encodeURIComponent(alarm.tray)}/${alarm.fan}` }, fanLabel(alarm));
const share = (cause) => `${cause.cause}, ${percent(cause.probability)}`;

export function badge(severity, text) {
  return element("span", { class: `badge ${severity}` }, `${MARKS[severity] ?? ""} ${text}`.trim());
}

// Rerun's viewer follows the newest sample; its address takes no time, so the text says where to look.
export function rerunLink(url, t_ns) {
  return url ? element("a", { href: url, target: "_blank", rel: "noopener" }, `Open Rerun${t_ns ? ` (${clock(t_ns)})` : ""} ↗`) : null;
}

// One alarm. viewerUrl: of Rerun's viewer; empty: none.
export function card(alarm, viewerUrl) {
  const kind = alarm.presented ? alarm.severity : "silenced";
  const by = alarm.acknowledged_by ? ` by ${alarm.acknowledged_by}` : "";
  const states = alarm.states.map((state) => (state === "acknowledged" ? state + by : state))
    .concat(alarm.now ? `now ${alarm.now}` : []).join(", ");
  return element("article", { class: `card ${kind}`, "data-fan": name(alarm), "aria-label": `Alarm of ${fanLabel(alarm)}` },
    element("p", {}, badge(alarm.active ? alarm.severity : "none", alarm.active ? alarm.severity : "over"), " ",
      element("strong", {}, link(alarm)), ` since ${clock(alarm.onset_t_ns)} (`, age(alarm.onset_t_ns), ")"),
    facts({
      "Cause": [alarm.cause_with_share, ...alarm.other_causes.map(share)].filter(Boolean).join("; or "),
      "Evidence": alarm.evidence,
      "What to do": alarm.advice,
      "Deviation": alarm.evidence && alarm.message.includes(alarm.evidence) ? "" : alarm.about,
      "State": states,
    }),
    rerunLink(viewerUrl, alarm.onset_t_ns), " ", clipLink(alarm), buttons(alarm.tray, alarm.fan, alarm));
}

// As many need attention as the header says.
function title(listed) {
  const open = listed.filter((alarm) => alarm.presented);
  const active = open.filter((alarm) => alarm.active).length, over = open.length - active, silenced = listed.length - open.length;
  const parts = [[active, "active"], [over, "cleared but not dealt with"], [silenced, "silenced"]].filter(([count]) => count);
  return `Alarms (${open.length})${parts.length ? `: ${parts.map(([count, words]) => `${count} ${words}`).join(", ")}` : ""}`;
}

export class AlarmsView {
  constructor(alarms, viewerUrl) {
    Object.assign(this, { alarms, viewerUrl, most: SHOWN, due: 0 });
    this.root = element("div");
    this.rate = element("p", { class: "muted", id: "alarm-rate" });
    this.showRate();
    this.draw();
  }

  close() {
    clearTimeout(this.timer);
  }

  // How many alarms really were false, beside how many are declared.
  showRate() {
    this.rateBy_ms = Infinity;
    this.showRateWithin(RATE_EVERY_MS);
    return learn(() => this.askRate());
  }

  // An alarm, or what was said of one, changes it.
  showRateWithin(ms) {
    const by_ms = performance.now() + ms;
    if (by_ms >= this.rateBy_ms) return;
    this.rateBy_ms = by_ms;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.showRate(), ms);
  }

  async askRate() {
    const { site } = await ask("/alarm-rate");
    if (site.since_t_ns) this.rate.textContent = `Since ${clock(site.since_t_ns)}: ${site.text}.`;
  }

  // When many come at once, they are drawn together.
  update() {
    this.due ||= requestAnimationFrame(() => this.draw());
    this.showRateWithin(RATE_AFTER_MS);
  }

  draw() {
    this.due = 0;
    const rank = (alarm) => (alarm.presented ? 0 : 4) + (alarm.active ? 0 : 2) + (alarm.severity === "alarm" ? 0 : 1);
    const listed = [...this.alarms.values()].filter((alarm) => alarm.listed);
    listed.sort((one, other) => rank(one) - rank(other) || other.onset_t_ns - one.onset_t_ns);
    const more = listed.length - this.most;
    keepFocus(this.root, () => this.root.replaceChildren(element("h2", {}, title(listed)), buttonsForAll(listed),
      ...(listed.length ? listed.slice(0, this.most).map((alarm) => card(alarm, this.viewerUrl(alarm.tray)))
        : [element("p", { class: "muted" }, "No alarms.")]),
      more > 0 ? element("button", { type: "button", onclick: () => { this.most += SHOWN; this.draw(); } }, `${more} more`) : "", this.rate));
  }
}

export class HistoryView {
  constructor(fan = null) {
    this.fan = fan;
    this.body = element("tbody");
    this.more = element("button", { type: "button", onclick: () => learn(() => this.load(this.oldest)), hidden: true }, "Older");
    this.reach = element("p", { class: "muted" });
    const heads = ["Time", ...(fan ? [] : ["Fan"]), "What happened", "By", "Message"].map((text) => element("th", { scope: "col" }, text));
    this.root = element("div", {}, element("h2", {}, fan ? "Alarm history of this fan" : "History of alarms"), this.reach,
      element("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "History of alarms" },
        element("table", { class: "folding" }, element("thead", {}, element("tr", {}, ...heads)), this.body)), this.more);
    this.begin();
  }

  // The newest page, or the one before a transition.
  async load(before = null) {
    const of = this.fan ? `&tray=${encodeURIComponent(this.fan.tray)}&fan=${this.fan.fan}` : "";
    const found = await ask(`/alarms/history?limit=${PAGE}${before === null ? "" : `&before=${before}`}${of}`);
    const { transitions } = found;
    const isNew = (each) => this.newest === null || each.number > this.newest;
    if (before === null && this.newest !== null && transitions.some((each) => isNew(each) && each.transition.startsWith("marked"))) {
      this.begin();  // what was said of an alarm is in its row
      return;
    }
    if (before === null) this.body.prepend(...transitions.filter(isNew).map((each) => this.row(each)));
    else this.body.append(...transitions.map((each) => this.row(each)));
    if (this.oldest === null || before !== null) {
      this.more.hidden = transitions.length < PAGE;
      this.oldest = transitions.at(-1)?.number ?? this.oldest;
    }
    if (before === null) this.newest = transitions[0]?.number ?? this.newest;
    const begins = found.begins_t_ns ? `Reaches back to ${clock(found.begins_t_ns)}.` : "";
    this.reach.textContent = [begins, this.oldest === null ? "No alarms so far." : ""].filter(Boolean).join(" ");
  }

  begin() {
    this.body.replaceChildren();
    this.newest = this.oldest = null;
    learn(() => this.load());
  }

  // A transition has come.
  update() {
    this.due ||= setTimeout(() => { this.due = 0; if (this.root.isConnected) learn(() => this.load()); }, 200);
  }

  row(each) {
    const cell = (label, ...content) => element("td", { "data-label": label }, ...content);
    const what = each.transition.replaceAll("_", " ");
    return element("tr", {}, cell("Time", stamp(each.t_ns)), this.fan ? "" : cell("Fan", link(each)),
      cell("What happened", badge(OF_FAN.includes(each.transition) ? each.severity : "plain", what)), cell("By", each.operator_name),
      cell("Message", each.message, each.comment ? ` “${each.comment}”` : "",
        ...(each.transition === "raised" ? [" ", clipLink(each), this.feedback(each)] : [])));
  }

  // What was said of an alarm, and the buttons to say it.
  feedback(each) {
    const said = each.feedback === "none" ? "" : ` (${each.feedback.replaceAll("_", " ")})`;
    if (!me.may_act) return said;
    return element("span", {}, said, element("span", { class: "actions" }, ...feedbackOn(each).map((action) => element("button", {
      type: "button", "data-action": action, onclick: () => askFor(action, each.tray, each.fan, each) }, ACTIONS[action].title))));
  }
}

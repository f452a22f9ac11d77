// The alarms that are there now, one card each: what, since when, why, what to do, what can be done; its course unfolds.

import { buttons, buttonsForAll } from "./actions.js";
import { age, clock, element, keepFocus, lengthText, percent } from "./dom.js";
import { clipLink } from "./clips.js";
import { courseOf, sameAlarm } from "./history.js";
import { hashOf, label, shownLabel, where } from "./names.js";
import { notifyButton } from "./notify.js";
import { ask, learn } from "./server.js";

const MARKS = { alarm: "✖", warning: "▲", none: "●" };
const SHOWN = 100;

const name = (alarm) => `${alarm.tray}/${alarm.fan}`;
const share = (cause) => `${cause.cause}, ${percent(cause.probability)}`;

export function badge(severity, text) {
  return element("span", { class: `badge ${severity}` }, `${MARKS[severity] ?? ""} ${text}`.trim());
}

// Rerun's viewer follows the newest sample; its address takes no time, so the text says where to look.
function rerunLink(url, t_ns) {
  return url ? element("a", { href: url, target: "_blank", rel: "noopener" }, `Rerun${t_ns ? ` (${clock(t_ns)})` : ""} ↗`) : null;
}

// viewerUrl: of Rerun's viewer; empty: none. isOfFan: the fan is named above it.
export function card(alarm, viewerUrl, { isOfFan = false } = {}) {
  const kind = !alarm.active ? "over" : alarm.presented ? alarm.severity : "silenced", state = alarm.active ? alarm.severity : "over";
  const said = alarm.states.map((each) => (each === "acknowledged" && alarm.acknowledged_by ? `${each} by ${alarm.acknowledged_by}` : each))
    .concat(alarm.now ? `now ${alarm.now}` : []);
  const deviation = !alarm.active || (alarm.evidence && alarm.message.includes(alarm.evidence)) ? "" : alarm.about;
  const others = alarm.other_causes.map(share).join("; ");
  const line = (term, text) => (text ? [element("dt", {}, term), element("dd", {}, text)] : []);
  return element("article", { class: `card ${kind}`, "data-fan": name(alarm), "aria-label": `Alarm of ${alarm.tray} ${label(alarm.tray, alarm.fan)}` },
    element("div", { class: "card-head" }, isOfFan && alarm.active ? "" : badge(alarm.active ? alarm.severity : "none", state),
      isOfFan ? "" : element("a", { class: "name", href: hashOf(alarm.tray, alarm.fan) }, ...shownLabel(alarm.tray, alarm.fan)), isOfFan ? "" : element("span", { class: "where" }, where(alarm.tray, alarm.fan)),
      element("strong", {}, alarm.cause_with_share), element("span", { class: "muted" }, `since ${clock(alarm.onset_t_ns)} (`, age(alarm.onset_t_ns), ")")),
    element("dl", { class: "facts" }, ...line("Deviation", deviation), ...line("Evidence", [alarm.evidence, others && `less likely: ${others}`].filter(Boolean).join("; ")),
      ...line("What to do", alarm.advice), ...line("State", said.join(", "))),
    buttons(alarm.tray, alarm.fan, alarm), element("div", { class: "links" }, course(alarm), clipLink(alarm), rerunLink(viewerUrl, alarm.onset_t_ns)));
}

// What happened to an alarm so far, asked for when it is unfolded.
const unfolded = new Set();
function course(alarm) {
  const key = `${name(alarm)}/${alarm.onset_t_ns}`, shown = element("div");
  const fill = () => learn(async () => {
    const { transitions } = await ask(`/alarms/history?limit=200&tray=${encodeURIComponent(alarm.tray)}&fan=${alarm.fan}`);
    shown.replaceChildren(courseOf(transitions.filter((each) => sameAlarm(each, alarm))));
  });
  const root = element("details", { class: "course", open: unfolded.has(key), ontoggle: () => {
    if (root.open) unfolded.add(key);
    else unfolded.delete(key);
    if (root.open && !shown.childElementCount) fill();
  } }, element("summary", { "data-action": "course" }, "Course of the alarm"), shown);
  return root;
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
    this.list = element("div");
    this.none = element("p", { class: "empty" });
    this.root = element("div", {}, element("div", { class: "title" }, this.heading = element("h2"), notifyButton()), this.list);
    this.draw();
    this.begin();
  }

  // Since when there was none.
  begin() {
    return learn(async () => {
      const { transitions, begins_t_ns } = await ask("/alarms/history?limit=1");
      const [last] = transitions, since_ns = last?.t_ns ?? begins_t_ns;
      const long = since_ns ? lengthText((Date.now() - since_ns / 1e6) / 1000) : "";
      this.none.replaceChildren(element("strong", {}, "● No alarm."), since_ns ? ` None since ${clock(since_ns)} (${long})${last ? `; the last was of ${last.tray} ${label(last.tray, last.fan)}` : ", when this history begins"}.` : "");
    });
  }

  // When many come at once, they are drawn together.
  update() {
    this.due ||= requestAnimationFrame(() => { this.draw(); this.begin(); });
  }

  draw() {
    this.due = 0;
    const rank = (alarm) => (alarm.presented ? 0 : 4) + (alarm.active ? 0 : 2) + (alarm.severity === "alarm" ? 0 : 1);
    const listed = [...this.alarms.values()].filter((alarm) => alarm.listed);
    listed.sort((one, other) => rank(one) - rank(other) || other.onset_t_ns - one.onset_t_ns);
    const more = listed.length - this.most;
    this.heading.textContent = title(listed);
    keepFocus(this.list, () => this.list.replaceChildren(buttonsForAll(listed),
      ...(listed.length ? listed.slice(0, this.most).map((alarm) => card(alarm, this.viewerUrl(alarm.tray))) : [this.none]),
      more > 0 ? element("button", { type: "button", onclick: () => { this.most += SHOWN; this.draw(); } }, `${more} more`) : ""));
  }
}

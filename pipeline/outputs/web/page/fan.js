// One fan: what it does now, its plots over any time, its alarm, its wear, its twin, and the history of its alarms.

import { card } from "./alarms.js";
import { buttons } from "./actions.js";
import { commandText, speedText } from "./card.js";
import { clock, element, facts, keepFocus, setText, stamp } from "./dom.js";
import { csvAddress, savePicture } from "./export.js";
import { HistoryView } from "./history.js";
import { Marks } from "./marks.js";
import { shownLabel, unitOf, where } from "./names.js";
import { address } from "./overview.js";
import { PlotStack } from "./plots.js";
import { plotsOf } from "./fan_plots.js";
import { ask, learn } from "./server.js";
import { bytes, GROUPS, groupNumber, levelText } from "./states.js";
import { Timeline } from "./timeline.js";
import { wearFacts } from "./wear.js";

const RANGES = [["1 min", 60], ["10 min", 600], ["1 h", 3600], ["1 day", 86400], ["7 days", 604800]];
const POINTS = 1200;
const LEAST_REDRAW_MS = 200, LEAST_ASK_S = 30;
const LEAST_ZOOM_S = 2;
const MEANINGS = {
  J: "J, inertia, command s²/rad", alpha: "α, viscous friction, command s/rad", C_D: "C_D, drag, command s²/rad²",
  lag_s: "lag of the torque behind the command, s", lowest_command: "lowest command that has an effect",
  friction: "friction, in units of the command", kick_command: "command with which the drive starts the rotor",
};
const local = (t_s) => stamp(t_s * 1e9).replace(" ", "T");

export class FanView {
  constructor(site, index, tray, fan, alarm, viewerUrl) {
    Object.assign(this, { site, index, tray, fan, viewerUrl, window_s: 600, fixed: null, class: -1, drawn_ms: 0, asked_s: 0, causes: [] });
    this.path = `/fans/${encodeURIComponent(tray)}/${fan}`;
    this.timeline = new Timeline();
    this.marks = new Marks();
    this.stack = new PlotStack({ onZoom: (from_s, to_s, isDone) => this.zoom(from_s, to_s, isDone), onLive: () => this.show(this.window_s),
      onCursor: (at_s) => setText(this.at, at_s === null ? "" : `at ${stamp(at_s * 1e9)}`), drawAlarms: (plot) => this.marks.drawAlarms(plot), drawMarks: (plot) => this.drawMarks(plot) });
    this.root = this.build();
    this.updateAlarm(alarm);
    this.recolored = () => { this.madePlots = ""; this.makePlots(); };
    this.scheme = matchMedia("(prefers-color-scheme: dark)");
    this.scheme.addEventListener("change", this.recolored);
    this.begin();
  }

  build() {
    const part = (kind) => element("span", { class: kind });
    [this.state, this.speed, this.command, this.since] = ["state", "speed", "command", "muted"].map(part);
    [this.at, this.note] = [part("at"), element("p", { class: "muted", role: "status" })];
    [this.alarm, this.wear, this.twin] = ["", "", ""].map(() => element("div"));
    this.history = new HistoryView({ tray: this.tray, fan: this.fan });
    const button = (text, onclick, more = {}) => element("button", { type: "button", onclick, ...more }, text);
    this.ranges = element("div", { class: "group", role: "group", "aria-label": "Time shown" }, ...RANGES.map(([text, s]) => button(text, () => this.show(s), { "data-range": s })));
    this.pause = button("Pause", () => (this.fixed ? this.show(this.window_s) : this.zoom(...this.shownTime())), { class: "live" });
    this.csv = element("a", { class: "button", download: "", href: "#", title: "The values of the time shown, as a table" }, "CSV");
    this.csv.addEventListener("click", () => { this.csv.href = csvAddress(this.path, ...this.shownTime()); });
    const time = (id, text) => [element("label", { for: id }, text), element("input", { id, type: "datetime-local", step: 1, required: true })];
    const [from, to] = [time("from", "From"), time("to", "to")];
    [this.from, this.to] = [from[1], to[1]];
    const chosen = element("form", { class: "group", onsubmit: (event) => this.choose(event) }, ...from, ...to, element("button", { type: "submit" }, "Show"));
    const tools = element("div", { class: "tools" }, this.ranges, this.pause, element("details", { class: "menu" }, element("summary", { class: "button" }, "From – to"), chosen),
      this.csv, button("PNG", () => savePicture(this.tray, this.fan, this.stack), { title: "The plots as a picture" }), this.at);
    return element("div", { class: "fan-view" },
      element("div", { class: "title" }, element("a", { class: "back", href: address }, "← Fans"), element("h2", {}, ...shownLabel(this.tray, this.fan)), this.state,
        element("span", { class: "values" }, this.speed, element("span", { class: "unit" }, ` ${unitOf(this.tray)}`), this.command)),
      element("p", { class: "where" }, where(this.tray, this.fan), " ", this.since),
      this.alarm, tools, this.note, this.marks.strip, this.stack.root, this.marks.root,
      element("div", { class: "columns" }, element("section", {}, element("h2", {}, "Wear"), this.wear), element("section", {}, element("h2", {}, "Twin"), this.twin)), this.history.root);
  }

  // Also after the server was away, and after events were missed; one after another.
  begin() {
    this.begun = (this.begun ?? Promise.resolve()).then(() => learn(async () => { await this.learn(); await this.load(); }));
  }

  // What does not come by itself: since when, the twin and the wear.
  async learn() {
    const now = await ask(this.path), twin = now.twin;
    this.showState(now.state);
    setText(this.since, now.alarm?.active || !now.since_t_ns ? "" : `· since ${clock(now.since_t_ns)}`);
    setText(this.speed, speedText(now.speed));
    setText(this.command, now.command === null ? "" : `command ${commandText(now.command)}`);
    this.twin.replaceChildren(twin ? facts({ "name": twin.name, "kind": twin.kind, "in force since": clock(twin.since_t_ns) || "the start",
      ...Object.fromEntries(Object.entries(twin.parameters).map(([name, value]) => [MEANINGS[name] ?? name, typeof value === "number" ? value.toPrecision(4) : String(value)])) })
      : element("p", { class: "muted" }, "There is no twin of this fan yet."));
    this.wear.replaceChildren(...wearFacts(now.wear));
  }

  // The past of the time shown, finer for a shorter one.
  async load() {
    const asked = this.asking = {}, [from_s, to_s] = this.fixed ?? [null, null];
    const now_s = to_s ?? (this.timeline.newest_s || (await ask(this.path)).newest_t_ns / 1e9 || Date.now() / 1000);
    const wanted = { from: Math.max(0, from_s ?? now_s - this.window_s).toFixed(3), points: POINTS, ...(to_s === null ? {} : { to: to_s.toFixed(3) }) };
    this.asked_s = performance.now() / 1000;
    const past = await ask(`${this.path}/series?${new URLSearchParams(wanted)}`);
    if (asked !== this.asking) return;
    this.timeline.setPast(past);
    this.marks.set(past.marks, past.causes[0]?.t_s <= past.from_s);
    this.causes = past.causes;
    setText(this.note, past.note);
    this.makePlots();
  }

  // Plots that are there already stay: somebody may be dragging over one.
  makePlots() {
    const wanted = plotsOf(this.timeline.names, this.site.channels, unitOf(this.tray), this.causeNames().names), names = JSON.stringify(wanted);
    if (names !== this.madePlots) {
      this.madePlots = names;
      this.stack.clear();
      this.drawers = wanted.map((about) => [this.stack.add(about), about]);
    }
    this.draw();
  }

  causeNames() {
    return this.timeline.causes(this.causes, Math.min(this.shownTime()[1], this.timeline.newest_s));
  }

  shownTime() {
    const to_s = this.timeline.newest_s;
    return this.fixed ?? [to_s - this.window_s, to_s];
  }

  draw() {
    this.drawn_ms = performance.now();
    if (!this.drawers || !this.root.isConnected) return;
    const [from_s, to_s] = this.shownTime(), rows = this.timeline.rows(from_s, to_s, POINTS), causes = this.causeNames();
    this.stack.window(from_s, to_s);
    for (const [plot, about] of this.drawers) plot.set(...about.data(rows, causes));
    this.stack.label();
    const isLive = !this.fixed;
    setText(this.pause, isLive ? "Pause" : "● Live");
    for (const each of this.ranges.children) each.setAttribute("aria-pressed", String(isLive && Number(each.dataset.range) === this.window_s));
    if (document.activeElement !== this.from && document.activeElement !== this.to) [this.from.value, this.to.value] = [from_s, to_s].map(local);
  }

  drawMarks(plot) {
    this.marks.draw(plot);
    if (plot === this.stack.plots[0]?.plot) this.marks.place(this.stack);
  }

  // The newest, so long.
  show(window_s) {
    Object.assign(this, { window_s, fixed: null });
    this.draw();
    learn(() => this.load());
  }

  // A time that stays while samples come. isDone: a finger does not move it any more.
  zoom(from_s, to_s, isDone = true) {
    const middle = (from_s + to_s) / 2, half = Math.max(to_s - from_s, LEAST_ZOOM_S) / 2;
    this.fixed = [middle - half, middle + half];
    this.draw();
    if (isDone) learn(() => this.load());
  }

  choose(event) {
    event.preventDefault();
    const [from_s, to_s] = [this.from, this.to].map((each) => new Date(each.value).getTime() / 1000);
    this.to.setCustomValidity(from_s < to_s ? "" : "The end is not after the beginning.");
    if (!this.to.reportValidity()) return;
    event.target.closest("details").open = false;
    this.zoom(from_s, to_s);
  }

  // Samples that have just come.
  add(samples) {
    const isNew = this.timeline.add(samples);
    const last = samples.t_s.length - 1;
    if (last >= 0) {
      setText(this.speed, speedText(samples.measured[last]));
      setText(this.command, samples.command[last] === null ? "" : `command ${commandText(samples.command[last])}`);
    }
    if (isNew && this.drawers) this.makePlots();
    const now_s = performance.now() / 1000;
    if (!this.fixed && this.drawers && this.window_s > 3600 && now_s - this.asked_s > Math.max(LEAST_ASK_S, this.window_s / 1000)) learn(() => this.load());
    if (this.fixed || this.due) return;
    const wait_ms = Math.max(LEAST_REDRAW_MS, this.window_s) - (performance.now() - this.drawn_ms);
    this.due = setTimeout(() => requestAnimationFrame(() => { this.due = 0; if (!this.fixed) this.draw(); }), Math.max(0, wait_ms));
  }

  // All fans at a glance have come: class and level of this one are among them.
  update(fleet) {
    const was = this.class;
    this.class = bytes(fleet.classes)[this.index];
    this.level = bytes(fleet.levels)[this.index];
    if (was !== this.class && was >= 0 && this.site.classes[was] !== this.site.classes[this.class]) learn(() => this.learn());
    this.showState(this.stateText);
    const isLearning = this.tray in fleet.learning;
    if (isLearning !== this.isLearning) {
      this.isLearning = isLearning;
      this.showAlarm();
    }
  }

  showState(text) {
    this.stateText = text;
    const group = GROUPS[groupNumber(this.site.groups[this.class])];
    if (!group || text === undefined) return;
    const isNear = ["normal", "suspect"].includes(group.name) && levelText(this.level);
    this.state.className = `state badge ${group.name}`;
    const isAlarm = group.name === "alarm" && !text.startsWith("alarm");
    setText(this.state, `${group.mark} ${isAlarm ? "alarm, now " : ""}${text.replace("unknown", "not judged")}${isNear ? `, ${isNear}` : ""}`);
  }

  // Without a twin no scorer answers an operator.
  showAlarm() {
    const alarm = this.shownAlarm;
    keepFocus(this.alarm, () => this.alarm.replaceChildren(alarm?.listed ? card(alarm, this.viewerUrl, { isOfFan: true })
      : this.isLearning ? element("p", { class: "muted" }, "Its twin is being learned: until then nothing judges this fan.") : buttons(this.tray, this.fan, null)));
  }

  // isNew: a transition has come.
  updateAlarm(alarm, isNew = true) {
    this.shownAlarm = alarm;
    this.showAlarm();
    if (this.known && isNew && alarm) {
      this.history.update();
      this.dueMarks ||= setTimeout(() => { this.dueMarks = 0; if (this.root.isConnected) learn(() => this.load()); }, 300);
    }
    this.known = true;
  }

  close() {
    this.scheme.removeEventListener("change", this.recolored);
    clearTimeout(this.due);
    clearTimeout(this.dueMarks);
    this.stack.close();
  }
}

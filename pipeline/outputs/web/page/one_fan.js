// One fan: its state and alarm, speed with its twin and band, torque balance and score, its twin, its wear, its history.

import { HistoryView, card, rerunLink } from "./alarms.js";
import { buttons } from "./actions.js";
import { address, bytes, levelText, NO_LEVEL } from "./overview.js";
import { Plot } from "./plot.js";
import { clock, element, facts, fanLabel, fanPlace, keepFocus } from "./dom.js";
import { ask, learn } from "./server.js";
import { wearTable } from "./wear.js";

const KEPT_S = 3600;
const MISSED_S = 2;  // without samples for longer, some were missed
const HOLE_S = 12;  // without samples for longer, there is a hole in the plots
const COLUMNS = ["t_s", "measured", "predicted", "half_width", "torque_balance_command", "score", "command"];
const WINDOWS = [["1 min", 60], ["10 min", 600], ["1 hour", KEPT_S]];
const POINTS = 1200;
const MEANINGS = {
  J: "J, inertia, command s²/rad", alpha: "α, viscous friction, command s/rad", C_D: "C_D, drag, command s²/rad²",
  lag_s: "lag of the torque behind the command, s", lowest_command: "lowest command that has an effect",
  friction: "friction, in units of the command", kick_command: "command with which the drive starts the rotor",
};

export class FanView {
  constructor(site, index, tray, fan, alarm, viewerUrl) {
    Object.assign(this, { site, index, tray, fan, viewerUrl, window_s: 600, plots: [], class: -1 });
    this.path = `/fans/${encodeURIComponent(tray)}/${fan}`;
    this.names = [...COLUMNS];
    this.columns = Object.fromEntries(COLUMNS.map((name) => [name, []]));
    this.state = element("span");
    this.score = element("span");
    this.alarm = element("div");
    this.charts = element("div");
    this.twin = element("div");
    this.wear = element("div");
    this.history = new HistoryView({ tray, fan });
    this.windows = element("div", { class: "actions", role: "group", "aria-label": "Time shown" }, ...WINDOWS.map(([text, s]) =>
      element("button", { type: "button", "aria-pressed": String(s === this.window_s), onclick: (event) => this.show(s, event.target) }, text)));
    this.root = element("div", {}, element("div", { class: "title" }, element("h2", {}, fanLabel(this)),
      element("a", { href: address }, "← all fans (Esc)")), element("p", {}, fanPlace(this) && `${fanPlace(this)}: `, this.state, this.score, " ", rerunLink(viewerUrl, 0)),
      this.alarm, this.windows, this.charts, element("h2", {}, "Wear"), this.wear, element("h2", {}, "Twin"), this.twin,
      this.history.root);
    this.updateAlarm(alarm);
    this.resized = () => this.plots.forEach((plot) => plot.resize());
    this.recolored = () => this.draw();
    this.scheme = matchMedia("(prefers-color-scheme: dark)");
    this.scheme.addEventListener("change", this.recolored);
    window.addEventListener("resize", this.resized);
    this.begin();
  }

  // Also after the server was away, and after events were missed; one after another.
  begin() {
    this.begun = (this.begun ?? Promise.resolve()).then(() => learn(() => this.start()));
  }

  async start() {
    const past = await ask(`${this.path}/curves?seconds=${KEPT_S}`);
    await this.learn();
    this.speedUnit = past.speed_unit;
    if (this.plots.length) {
      this.columns = this.filled(this.columns, past);
      this.refresh();
      return;
    }
    const live = this.columns;
    this.names = [...COLUMNS, ...this.channelsOf(past)];
    this.columns = Object.fromEntries(this.names.map((name) => [name, past[name] ?? past.t_s.map(() => null)]));
    this.draw();
    this.add(live);
  }

  // The samples of the page, and those of the server where the page has none for a while.
  filled(had, past) {
    const rows = [], t_s = had.t_s;
    let at = 0;
    past.t_s.forEach((t, i) => {
      while (t_s[at] < t) rows.push([had, at++]);
      if (t_s[at] !== t && (t_s[at] ?? Infinity) - (t_s[at - 1] ?? -Infinity) > MISSED_S) rows.push([past, i]);
    });
    while (at < t_s.length) rows.push([had, at++]);
    return Object.fromEntries(this.names.map((name) => [name, rows.map(([of, i]) => of[name]?.[i] ?? null)]));
  }

  // What does not come by itself: since when, the twin and the wear.
  async learn() {
    const now = await ask(this.path);
    const since = now.alarm?.active ? "" : ` since ${clock(now.since_t_ns)}`;  // the alarm says its own time
    this.state.textContent = `${now.state}${since}; `;
    const twin = now.twin;
    this.twin.replaceChildren(twin ? facts({ "name": twin.name, "kind": twin.kind, "in force since": clock(twin.since_t_ns) || "the start",
      ...Object.fromEntries(Object.entries(twin.parameters).map(([name, value]) =>
        [MEANINGS[name] ?? name, typeof value === "number" ? value.toPrecision(4) : String(value)])) })
      : element("p", { class: "muted" }, "The twin of this fan is not known yet."));
    this.wear.replaceChildren(wearTable(now.wear));
  }

  // All fans at a glance have come: class and score of this one are among them.
  update(fleet) {
    const level = bytes(fleet.levels)[this.index], was = this.class;
    this.class = bytes(fleet.classes)[this.index];
    const now = this.site.now[this.class];
    this.score.textContent = level === NO_LEVEL ? (now ? `no twin, torque balance or score while the fan is ${now}.` : "not judged.") : `score ${levelText(level)} of the limit.`;
    if (was !== this.class && was >= 0 && this.site.classes[was] !== this.site.classes[this.class]) learn(() => this.learn());
  }

  // isNew: a transition has come.
  updateAlarm(alarm, isNew = true) {
    keepFocus(this.alarm, () => this.alarm.replaceChildren(
      alarm?.listed ? card(alarm, this.viewerUrl) : buttons(this.tray, this.fan, null)));
    if (this.known && isNew && alarm) this.history.update();
    this.known = true;
  }

  // What is measured beside command and speed, of samples.
  channelsOf(samples) {
    return this.site.channels.map((each) => each.name).filter((name) => samples[name]);
  }

  // Samples that have just come.
  add(samples) {
    const added = this.channelsOf(samples).filter((name) => !this.columns[name]);
    added.forEach((name) => { this.names.push(name); this.columns[name] = this.columns.t_s.map(() => null); });
    if (added.length && this.plots.length) this.draw();
    samples = Object.fromEntries(this.names.map((name) => [name, samples[name] ?? samples.t_s.map(() => null)]));
    const mine = this.columns, newest = mine.t_s.at(-1) ?? -Infinity;
    const first = samples.t_s.findIndex((t_s) => t_s > newest);
    if (samples.t_s.length && samples.t_s.at(-1) < newest - 10) this.names.forEach((name) => { mine[name] = samples[name]; });
    else if (first >= 0) {
      if (newest > 0 && samples.t_s[first] - newest > HOLE_S) this.names.forEach((name) => mine[name].push(name === "t_s" ? newest + HOLE_S / 2 : null));
      this.names.forEach((name) => mine[name].push(...samples[name].slice(first)));
    } else return;
    const old = mine.t_s.findIndex((t_s) => t_s > mine.t_s.at(-1) - KEPT_S);
    if (old > 2000) this.names.forEach((name) => mine[name].splice(0, old));
    this.refresh();
  }

  draw() {
    this.plots.forEach((plot) => plot.destroy());
    this.charts.replaceChildren();
    const add = (...settings) => { const plot = new Plot(this.charts, ...settings); this.plots.push(plot); return plot; };
    this.plots = [];
    this.speedPlot = add("Speed", this.speedUnit, [{ label: "measured", color: "measured" },
      { label: "twin", color: "twin", dash: [6, 4] }, { label: "band of a healthy fan, twin ± 2σ", color: "band", isBand: true }]);
    this.commandPlot = add("Command", "command", [{ label: "command", color: "measured" }]);
    this.balancePlot = add("Torque balance: command in excess of what a healthy fan needs", "command", [{ label: "torque balance", color: "measured" }]);
    this.scorePlot = add("Score: an alarm is raised at 1", "of the limit", [{ label: "score", color: "measured" },
      { label: "limit", color: "limit", dash: [2, 4] }], [0, 1.2]);
    this.channelPlots = this.site.channels.filter((each) => this.names.includes(each.name)).map((each) =>
      [each.name, add(each.title[0].toUpperCase() + each.title.slice(1), each.unit, [{ label: each.title, color: "measured" }])]);
    this.refresh();
  }

  refresh() {
    if (!this.plots.length || this.due) return;
    this.due = requestAnimationFrame(() => {
      this.due = 0;
      const shown = this.shown();
      const side = (sign) => shown.predicted.map((value, i) => (value === null || shown.half_width[i] === null ? null : value + sign * shown.half_width[i]));
      this.speedPlot.set(shown.t_s, [shown.measured, shown.predicted, side(-1), side(1)]);
      this.commandPlot.set(shown.t_s, [shown.command]);
      this.balancePlot.set(shown.t_s, [shown.torque_balance_command]);
      this.scorePlot.set(shown.t_s, [shown.score, shown.t_s.map(() => 1)]);
      this.channelPlots.forEach(([name, plot]) => plot.set(shown.t_s, [shown[name]]));
    });
  }

  // Of the time shown, not much more samples than a screen has pixels.
  shown() {
    const all = this.columns, { t_s } = all, since_s = (t_s.at(-1) ?? 0) - this.window_s;
    const step_s = this.window_s > 60 ? this.window_s / POINTS : 0;
    const indexes = [];
    let next_s = since_s;
    for (let i = Math.max(0, t_s.findIndex((each) => each >= since_s)); i < t_s.length; i++) {
      if (t_s[i] < next_s) continue;
      indexes.push(i);
      next_s = t_s[i] + step_s;
    }
    return Object.fromEntries(this.names.map((name) => [name, indexes.map((i) => all[name][i])]));
  }

  show(window_s, button) {
    this.window_s = window_s;
    for (const each of this.windows.children) each.setAttribute("aria-pressed", String(each === button));
    this.refresh();
  }

  close() {
    this.scheme.removeEventListener("change", this.recolored);
    window.removeEventListener("resize", this.resized);
    this.plots.forEach((plot) => plot.destroy());
  }
}

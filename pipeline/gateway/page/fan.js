// One fan: its state and alarm, speed with its twin and band, torque balance and score, and its twin's parameters.

import { HistoryView, card } from "./alarms.js";
import { buttons } from "./actions.js";
import { clock, element } from "./dom.js";
import { ask } from "./server.js";

const KEPT_S = 3600;
const COLUMNS = ["t_s", "measured", "predicted", "half_width", "torque_balance_command", "score"];
const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const WINDOWS = [["1 min", 60], ["10 min", 600], ["1 hour", KEPT_S]];

export class FanView {
  constructor(tray, fan, alarm, viewerUrl) {
    Object.assign(this, { tray, fan, viewerUrl, window_s: 600, plots: [] });
    this.path = `/fans/${encodeURIComponent(tray)}/${fan}`;
    this.columns = Object.fromEntries(COLUMNS.map((name) => [name, []]));
    this.facts = element("dl", { class: "facts" });
    this.state = element("p", {});
    this.alarm = element("div");
    this.charts = element("div");
    const windows = element("div", { class: "actions", role: "group", "aria-label": "Time shown" }, ...WINDOWS.map(([text, s]) =>
      element("button", { type: "button", "aria-pressed": s === this.window_s, onclick: (event) => this.show(s, event.target) }, text)));
    this.windows = windows;
    this.root = element("div", {}, element("h2", {}, `${tray} fan ${fan}`), this.state, this.alarm, windows, this.charts,
      element("h2", {}, "Twin"), this.facts, new HistoryView({ tray, fan }).root);
    this.updateAlarm(alarm);
    this.resized = () => this.plots.forEach((plot) => plot.setSize(this.size()));
    window.addEventListener("resize", this.resized);
    this.start();
  }

  async start() {
    const [now, past] = await Promise.all([ask(this.path), ask(`${this.path}/curves?seconds=${KEPT_S}`)]);
    this.speedUnit = past.speed_unit;
    this.showFan(now);
    const live = this.columns;
    this.columns = Object.fromEntries(COLUMNS.map((name) => [name, past[name]]));
    this.draw();
    this.add(live);
  }

  showFan(now) {
    const score = now.score === null ? "not judged" : `${Math.round(now.score * 100)} % of the limit`;
    this.state.replaceChildren(`${now.state} since ${clock(now.since_t_ns)}; score ${score}. `,
      this.viewerUrl ? element("a", { href: this.viewerUrl, target: "_blank", rel: "noopener" }, "Open in Rerun") : "");
    const facts = now.twin ? { "name": now.twin.name, "kind": now.twin.kind, "in force since": clock(now.twin.since_t_ns) || "the start",
      ...Object.fromEntries(Object.entries(now.twin.parameters).map(([name, value]) =>
        [name, typeof value === "number" ? value.toPrecision(4) : String(value)])) } : { "twin": "not heard yet" };
    this.facts.replaceChildren(...Object.entries(facts).flatMap(([name, value]) => [element("dt", {}, name), element("dd", {}, value)]));
  }

  updateAlarm(alarm) {
    this.alarm.replaceChildren(alarm && alarm.listed ? card(alarm) : buttons(this.tray, this.fan, alarm && null));
  }

  // Samples that have just come.
  add(samples) {
    const mine = this.columns, newest = mine.t_s.at(-1) ?? -Infinity;
    const first = samples.t_s.findIndex((t_s) => t_s > newest);
    if (samples.t_s.length && samples.t_s.at(-1) < newest - 10) COLUMNS.forEach((name) => { mine[name] = samples[name]; });
    else if (first >= 0) COLUMNS.forEach((name) => mine[name].push(...samples[name].slice(first)));
    else return;
    const old = mine.t_s.findIndex((t_s) => t_s > mine.t_s.at(-1) - KEPT_S);
    if (old > 2000) COLUMNS.forEach((name) => mine[name].splice(0, old));
    this.refresh();
  }

  draw() {
    const axis = (label) => ({ label, stroke: color("text"), grid: { stroke: color("line") }, ticks: { stroke: color("line") }, size: 64 });
    const time = { ...axis(""), size: 40 };
    const line = (label, stroke, more = {}) => ({ label, stroke: color(stroke), width: 1.5, points: { show: false }, ...more });
    const chart = (title, series, label, more = {}) => {
      const parent = element("div", { class: "plot" }, element("h3", {}, title));
      this.charts.append(parent);
      const plot = new uPlot({ ...this.size(), series: [{}, ...series], axes: [time, axis(label)], cursor: { sync: { key: "fan" } },
        scales: { x: { time: true } }, ...more }, series.map(() => []).concat([[]]), parent);
      this.plots.push(plot);
      return plot;
    };
    this.speed = chart("Speed, its twin and the band", [line("band, low", "band"), line("band, high", "band"),
      line("twin", "twin", { dash: [6, 4] }), line("measured", "measured")], this.speedUnit,
      { bands: [{ series: [2, 1], fill: color("band") }] });
    this.balance = chart("Torque balance", [line("torque balance", "measured")], "command");
    this.score = chart("Score and its limit", [line("limit", "limit", { dash: [6, 4] }), line("score", "measured")], "of the limit",
      { scales: { x: { time: true }, y: { range: (_plot, low, high) => [Math.min(0, low ?? 0), Math.max(1.2, high ?? 0)] } } });
    this.refresh();
  }

  refresh() {
    if (!this.plots.length || this.due) return;
    this.due = requestAnimationFrame(() => {
      this.due = 0;
      const all = this.columns, since_s = (all.t_s.at(-1) ?? 0) - this.window_s;
      const first = Math.max(0, all.t_s.findIndex((t_s) => t_s >= since_s));
      const c = Object.fromEntries(COLUMNS.map((name) => [name, all[name].slice(first)]));
      const side = (sign) => c.predicted.map((value, i) => (value === null || c.half_width[i] === null ? null : value + sign * c.half_width[i]));
      this.speed.setData([c.t_s, side(-1), side(1), c.predicted, c.measured]);
      this.balance.setData([c.t_s, c.torque_balance_command]);
      this.score.setData([c.t_s, c.t_s.map(() => 1), c.score]);
    });
  }

  show(window_s, button) {
    this.window_s = window_s;
    for (const each of this.windows.children) each.setAttribute("aria-pressed", each === button);
    this.refresh();
  }

  size() {
    return { width: Math.max(280, Math.min(1300, this.charts.clientWidth - 12)), height: window.innerWidth < 640 ? 190 : 240 };
  }

  close() {
    window.removeEventListener("resize", this.resized);
    this.plots.forEach((plot) => plot.destroy());
  }
}

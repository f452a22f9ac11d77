// Plots one below the other with one axis of time and one cursor, whose values and time are in their legends. To drag
// over one chooses a time, a double click goes back to the newest; a finger moves the time, two widen or narrow it.

import { element, setText, stamp } from "./dom.js";

const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const signed = (value) => value.toLocaleString("en").replace("-", "−");
const number = (value) => (value === null || value === undefined ? "–" : signed(Number(value.toPrecision(4))));
const DAY_S = 86400;
const AXIS = 62;  // width of the values beside a plot
const LEAST_MOVE_PX = 8;  // less is a tap

function timesText(splits, step_s) {
  let day = "";
  return splits.map((t_s) => {
    const text = stamp(t_s * 1e9), date = text.slice(5, 10), clock = text.slice(11, step_s < 60 ? 19 : 16);
    const isOther = date !== day;
    day = date;
    if (step_s >= DAY_S) return date;
    return isOther && (splits.at(-1) - splits[0] > DAY_S / 2) ? `${date} ${clock}` : clock;
  });
}

export class Plot {
  // about: title, help, unit, height, lines (label, color, dash, isStepped), areas ([upper, lower, color] by index of
  // lines; a line without a label is only the edge of an area, a plain one has no value), range that is always
  // shown.
  constructor(stack, about) {
    Object.assign(this, { stack, about });
    this.values = about.lines.map(() => element("span", { class: "value" }));
    const legend = element("ul", { class: "key" }, ...about.lines.map((line, i) => line.label && element("li", {},
      element("span", { class: `swatch ${line.isArea ? "area" : line.dash ? "dashed" : ""} ${line.color}`, "aria-hidden": "true" }), line.label, this.values[i])));
    this.canvas = element("div", { "aria-hidden": "true" });
    this.root = element("section", { class: "plot", "aria-label": about.title },
      element("div", { class: "plot-head" }, element("h3", { title: about.help }, about.title, about.unit && element("span", { class: "unit" }, `, ${about.unit}`)), legend),
      about.help ? element("p", { class: "help" }, about.help) : "", this.canvas);
    stack.root.append(this.root);
    this.make();
  }

  make() {
    const { about, stack } = this;
    const axis = { stroke: color("muted"), grid: { stroke: color("line"), width: 1 }, ticks: { show: false }, font: "12px system-ui, sans-serif" };
    this.plot = new uPlot({
      ...this.size(), legend: { show: false }, padding: [8, 12, 0, 0],
      cursor: { sync: { key: "fan", setSeries: false }, y: false, points: { size: 5 }, drag: { x: true, y: false, setScale: false },
        bind: { dblclick: () => () => { stack.onLive(); return null; } } },
      series: [{}, ...about.lines.map((line) => ({ stroke: line.isEdge ? "transparent" : color(line.color), width: line.isEdge ? 0 : 1.5, dash: line.dash, points: { show: false },
        spanGaps: Boolean(line.spans), ...(line.isStepped && { paths: uPlot.paths.stepped({ align: 1 }) }) }))],
      bands: (about.areas ?? []).map(([upper, lower, fill]) => ({ series: [upper + 1, lower + 1], fill: color(fill) })),
      axes: [{ ...axis, values: (_plot, splits, _axis, _space, step_s) => timesText(splits, step_s), space: 80, size: 26 }, { ...axis, size: AXIS, values: (_plot, splits) => splits.map(signed) }],
      scales: { x: { time: true, range: () => [stack.from_s, stack.to_s] }, y: { range: (_plot, low, high) => reach(about, low, high) } },
      hooks: { setCursor: [() => stack.label()], setSelect: [(plot) => this.selected(plot)], drawClear: [(plot) => stack.drawAlarms(plot)],
        draw: [(plot) => stack.drawMarks(plot)] },
    }, [[], ...about.lines.map(() => [])], this.canvas);
    this.listenToFingers(this.plot.over);
  }

  // What is under a finger stays under it.
  listenToFingers(over) {
    const { stack } = this;
    let held = null, hasMoved = false;
    const places = (event) => [...event.touches].slice(0, 2).map((touch) => (touch.clientX - over.getBoundingClientRect().left) / over.clientWidth).sort((one, other) => one - other);
    const hold = (event) => { held = { at: places(event), from_s: stack.from_s, length_s: stack.to_s - stack.from_s }; };
    const release = (event) => {
      hold(event);
      if (event.touches.length || !hasMoved) return;
      hasMoved = false;
      stack.onZoom(stack.from_s, stack.to_s, true);
    };
    over.addEventListener("touchstart", hold, { passive: true });
    over.addEventListener("touchmove", (event) => {
      const [left, right] = held.at, [nowLeft, nowRight] = places(event);
      if (!hasMoved && right === undefined && Math.abs(nowLeft - left) * over.clientWidth < LEAST_MOVE_PX) return;
      hasMoved = true;
      const length_s = held.length_s * (right === undefined || nowRight - nowLeft < 0.02 ? 1 : (right - left) / (nowRight - nowLeft));
      const from_s = held.from_s + held.length_s * left - length_s * nowLeft;
      stack.onZoom(from_s, from_s + length_s, false);
    }, { passive: true });
    over.addEventListener("touchend", release);
    over.addEventListener("touchcancel", release);
  }

  selected(plot) {
    if (plot.select.width < 4) return;
    const [from_s, to_s] = [plot.select.left, plot.select.left + plot.select.width].map((px) => plot.posToVal(px, "x"));
    plot.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
    this.stack.onZoom(from_s, to_s, true);
  }

  set(t_s, columns) {
    this.plot.setData([t_s, ...columns], false);
    this.plot.setScale("x", { min: this.stack.from_s, max: this.stack.to_s });
  }

  // at_s: under the cursor; null: the newest.
  label(at_s) {
    const [t_s, ...columns] = this.plot.data;
    const at = at_s === null ? t_s.length - 1 : nearest(t_s, at_s, this.about.lines.some((line) => line.isStepped));
    this.about.lines.forEach((line, i) => {
      if (!line.label || line.isPlain) return;
      const value = columns[i][at];
      const text = line.isArea && value !== null && value !== undefined ? line.between.map((each) => number(columns[each][at])).join(" to ") : number(value);
      setText(this.values[i], ` ${text}${value === null || value === undefined || !this.about.unit ? "" : ` ${this.about.unit}`}`);
    });
  }

  size() {
    const narrow = window.innerWidth < 640;
    return { width: Math.max(240, this.canvas.clientWidth || this.stack.root.clientWidth - 2), height: narrow ? Math.min(170, this.about.height) : this.about.height };
  }

  resize() {
    this.plot.setSize(this.size());
  }

  destroy() {
    this.plot.destroy();
    this.root.remove();
  }
}

// The range of values of a plot: not so small that noise looks like a fault.
function reach(about, low, high) {
  const [least, most] = about.range ?? [null, null];
  const ends = [low, high, least, most].filter((each) => each !== null && each !== undefined);
  if (!ends.length) return [0, 1];
  const [from, to] = [Math.min(...ends), Math.max(...ends)], middle = (from + to) / 2;
  const half = Math.max((to - from) / 2, (about.leastReach ?? 0) * Math.abs(middle), 1e-6) * 1.06;
  return [Math.max(middle - half, about.lowest ?? -Infinity), middle + half];
}

// The row at a time; of steps, the last one before it.
function nearest(t_s, at_s, isStepped) {
  let low = 0, high = t_s.length - 1;
  while (low < high) {
    const middle = (low + high + 1) >> 1;
    if (t_s[middle] <= at_s) low = middle;
    else high = middle - 1;
  }
  return !isStepped && low + 1 < t_s.length && t_s[low + 1] - at_s < at_s - t_s[low] ? low + 1 : low;
}

export class PlotStack {
  // onZoom: a time was chosen, and whether a finger still moves it. onLive: the newest is wanted again. onCursor: the time under the cursor, or null.
  constructor({ onZoom, onLive, onCursor, drawAlarms, drawMarks }) {
    Object.assign(this, { onZoom, onLive, onCursor, drawAlarms, drawMarks, plots: [], from_s: 0, to_s: 1 });
    this.root = element("div", { class: "plots" });
    this.observer = new ResizeObserver(() => requestAnimationFrame(() => this.plots.forEach((plot) => plot.resize())));
    this.observer.observe(this.root);
  }

  add(about) {
    const plot = new Plot(this, about);
    this.plots.push(plot);
    return plot;
  }

  window(from_s, to_s) {
    Object.assign(this, { from_s, to_s });
  }

  label() {
    const first = this.plots[0]?.plot;
    if (!first) return;
    const left = first.cursor.left;
    const at_s = left === undefined || left < 0 ? null : first.posToVal(left, "x");
    this.plots.forEach((plot) => plot.label(at_s));
    this.onCursor(at_s);
  }

  // Where a time is, in pixels from the left of the plots.
  position(t_s) {
    const plot = this.plots[0]?.plot;
    return plot ? plot.valToPos(t_s, "x") + plot.bbox.left / devicePixelRatio + 1 : 0;
  }

  clear() {
    this.plots.forEach((plot) => plot.destroy());
    this.plots = [];
  }

  close() {
    this.observer.disconnect();
    this.clear();
  }
}

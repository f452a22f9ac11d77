// One plot over time, with a legend that says what each line is and its newest value, or that under the cursor.

import { element, time } from "./dom.js";

const color = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
const number = (value) => (value === null || value === undefined ? "none" : Number(value.toPrecision(4)).toLocaleString("en"));

export class Plot {
  // lines: label, name of a color, dash. The values of a band are two columns, and it is the last line. range: that is
  // always shown.
  constructor(parent, title, unit, lines, range = null) {
    Object.assign(this, { parent, unit, lines });
    this.values = lines.map(() => element("span", { class: "value" }));
    const legend = element("ul", { class: "key" }, ...lines.map((line, i) => element("li", {},
      element("span", { class: `swatch ${line.isBand ? "area" : line.dash ? "dashed" : ""} ${line.color}`, "aria-hidden": "true" }), line.label,
      this.values[i])));
    const canvas = element("div", { "aria-hidden": "true" });
    this.root = element("div", { class: "plot" }, element("h3", {}, title), legend, canvas);
    parent.append(this.root);
    const axis = { stroke: color("text"), grid: { stroke: color("line"), width: 1 }, ticks: { stroke: color("line") } };
    const clocks = (_plot, splits, _axis, _space, step_s) => splits.map((t_s) => time(new Date(t_s * 1000)).slice(0, step_s < 60 ? 8 : 5));
    const drawn = lines.flatMap((line) => {
      const each = { stroke: line.isBand ? "transparent" : color(line.color), width: line.isBand ? 0 : 1.5, dash: line.dash, points: { show: false } };
      return line.isBand ? [each, each] : [each];
    });
    const band = lines.findIndex((line) => line.isBand);
    this.plot = new uPlot({
      ...this.size(), legend: { show: false }, series: [{}, ...drawn], cursor: { sync: { key: "fan" }, y: false },
      axes: [{ ...axis, values: clocks, space: 70, size: 34 }, { ...axis, label: unit, labelSize: 22, size: 58 }],
      bands: band < 0 ? [] : [{ series: [band + 2, band + 1], fill: color("band") }],
      scales: { x: { time: true }, y: range ? { range: (_plot, low, high) => [Math.min(range[0], low ?? 0), Math.max(range[1], high ?? 0)] } : {} },
      hooks: { setCursor: [() => this.label()], setData: [() => this.label()] },
    }, [[], ...drawn.map(() => [])], canvas);
  }

  set(t_s, columns) {
    this.plot.setData([t_s, ...columns]);
  }

  label() {
    const { data, cursor } = this.plot ?? {};
    if (!data) return;
    const at = cursor.idx ?? data[0].length - 1;
    this.lines.forEach((line, i) => {
      const text = line.isBand ? (data[i + 1][at] ?? null) === null ? "none" : `${number(data[i + 1][at])} to ${number(data[i + 2][at])}` : number(data[i + 1][at]);
      this.values[i].textContent = ` ${text}${text === "none" || line.label === this.unit ? "" : ` ${this.unit}`}`;
    });
  }

  size() {
    return { width: Math.max(260, Math.min(1300, this.parent.clientWidth - 14)), height: window.innerWidth < 640 ? 170 : 220 };
  }

  resize() {
    this.plot.setSize(this.size());
  }

  destroy() {
    this.plot.destroy();
    this.root.remove();
  }
}

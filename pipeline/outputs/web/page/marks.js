// When an alarm was raised, diagnosed and cleared and what operators did, as lines in the plots: each with a symbol above
// them that says on hover and focus what it was, and all as a list.

import { element, stamp } from "./dom.js";

const SYMBOLS = { raised: "✖", severity: "▲", diagnosed: "?", cleared: "✓", acknowledged: "☑", shelved: "◌", unshelved: "◍", out_of_service: "⚒", in_service: "⚒",
  commissioning: "⚒", marked_true: "☑", marked_false: "☑", commented: "✎", data_lost: "…", data_restored: "…" };
const SHOWN = Object.keys(SYMBOLS);
const APART_PX = 22;

export const whatHappened = (transition) => ({ severity: "severity changed", commissioning: "commissioned again", marked_true: "marked as a true alarm",
  marked_false: "marked as a false alarm" })[transition] ?? transition.replaceAll("_", " ");
const words = (mark) => `${stamp(mark.t_s * 1e9).slice(5)} ${whatHappened(mark.transition)}${mark.operator_name ? ` by ${mark.operator_name}` : ""}: ${mark.message}${mark.comment ? ` “${mark.comment}”` : ""}`;

export class Marks {
  constructor() {
    Object.assign(this, { marks: [], active: [] });
    this.strip = element("div", { class: "marks" });
    this.list = element("ul", {});
    this.root = element("details", { class: "mark-list", hidden: true }, element("summary", {}, "What happened in this time"), this.list);
  }

  // isActive: there was an alarm already when the time asked for began.
  set(marks, isActive) {
    this.active = [];  // from when to when there was an alarm, s
    let since_s = isActive ? -Infinity : null;
    for (const mark of marks) {
      if (mark.active) since_s ??= mark.transition === "raised" ? mark.t_s : -Infinity;
      else if (since_s !== null) { this.active.push([since_s, mark.t_s]); since_s = null; }
    }
    if (since_s !== null) this.active.push([since_s, Infinity]);
    this.marks = marks.filter((mark) => SHOWN.includes(mark.transition));
  }

  // stack: the plots, with the time that they show.
  place(stack) {
    const shown = this.marks.filter((mark) => mark.t_s >= stack.from_s && mark.t_s <= stack.to_s);
    const groups = [];
    for (const mark of shown) {
      const x = stack.position(mark.t_s), last = groups.at(-1);
      if (last && x - last.x < APART_PX) last.marks.push(mark);
      else groups.push({ x, marks: [mark] });
    }
    const now = JSON.stringify(groups.map((group) => group.marks.map((mark) => mark.t_s)));
    if (now !== this.now) {
      this.now = now;
      this.buttons = groups.map((group) => {
        const [first] = group.marks, text = group.marks.map(words).join("\n");
        return element("button", { type: "button", class: `mark ${first.severity}`, "aria-label": text.replaceAll("\n", "; ") },
          `${SYMBOLS[first.transition]}${group.marks.length > 1 ? `+${group.marks.length - 1}` : ""}`, element("span", { class: "tip", "aria-hidden": "true" }, text));
      });
      this.strip.replaceChildren(...this.buttons);
      this.list.replaceChildren(...shown.map((mark) => element("li", {}, `${SYMBOLS[mark.transition]} ${words(mark)}`)));
    }
    groups.forEach((group, i) => {
      this.buttons[i].style.left = `${group.x}px`;
      this.buttons[i].classList.toggle("late", group.x > this.strip.clientWidth / 2);
    });
    this.strip.hidden = this.root.hidden = !shown.length;
  }

  // Into one plot, below its lines.
  drawAlarms(plot) {
    const { ctx, bbox } = plot, inside = (t_s) => Math.min(Math.max(plot.valToPos(t_s, "x", true), bbox.left), bbox.left + bbox.width);
    ctx.fillStyle = getComputedStyle(document.documentElement).getPropertyValue("--in-alarm").trim();
    for (const [from_s, to_s] of this.active) {
      const from = inside(from_s);
      ctx.fillRect(from, bbox.top, inside(to_s) - from, bbox.height);
    }
  }

  // Into one plot, above its lines.
  draw(plot) {
    const { ctx, bbox } = plot, style = getComputedStyle(document.documentElement);
    ctx.save();
    ctx.lineWidth = devicePixelRatio;
    ctx.setLineDash([3 * devicePixelRatio, 3 * devicePixelRatio]);
    for (const mark of this.marks) {
      const x = plot.valToPos(mark.t_s, "x", true);
      if (x < bbox.left || x > bbox.left + bbox.width) continue;
      ctx.strokeStyle = style.getPropertyValue({ raised: "--alarm", severity: "--alarm", cleared: "--normal" }[mark.transition] ?? "--muted").trim();
      ctx.beginPath();
      ctx.moveTo(x, bbox.top);
      ctx.lineTo(x, bbox.top + bbox.height);
      ctx.stroke();
    }
    ctx.restore();
  }
}

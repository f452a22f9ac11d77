// Every fan of the site as a cell, in groups, the worst group first. A cell moves only when its group changes, so that
// thousands of fans cost nothing while they are well.

import { element } from "./dom.js";

const GROUPS = [
  { name: "alarm", title: "In alarm", mark: "✖" },
  { name: "suspect", title: "Suspect", mark: "▲" },
  { name: "unjudged", title: "Not judged", mark: "?" },
  { name: "rest", title: "Stopped or starting", mark: "■" },
  { name: "normal", title: "Normal", mark: "●" },
];
const LARGE_UP_TO = 64;
const NO_LEVEL = 255;
const REST = ["stopped", "starting"];

function groupOf(words) {
  if (words === "alarm" || words === "returning") return 0;
  if (words === "suspect") return 1;
  if (REST.includes(words)) return 3;
  if (words.startsWith("normal")) return 4;
  return 2;
}

const bytes = (base64) => Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));

export class FansView {
  constructor(site) {
    this.site = site;
    this.fans = site.trays.flatMap((tray) => Array.from({ length: tray.fans }, (_, fan) => ({ tray: tray.name, fan })));
    this.groupOfClass = site.classes.map(groupOf);
    this.cells = [];
    this.root = this.build();
  }

  build() {
    const large = this.fans.length <= LARGE_UP_TO ? " large" : "";
    this.tray = element("select", { id: "tray", onchange: () => this.filter() }, element("option", { value: "" }, "all trays"),
      ...this.site.trays.map((tray) => element("option", { value: tray.name }, tray.name)));
    this.state = element("select", { id: "state", onchange: () => this.filter() }, element("option", { value: "" }, "all states"),
      ...GROUPS.map((group) => element("option", { value: group.name }, group.title.toLowerCase())));
    this.sections = GROUPS.map((group, number) => {
      const count = element("span");
      const cells = element("div", { class: `cells${large}`, role: "group", "aria-label": group.title,
        onclick: (event) => this.chosen(event), onkeydown: (event) => this.moved(event) });
      const root = element("section", { hidden: true }, element("h2", {}, `${group.mark} ${group.title} `, count), cells);
      return { root, cells, count, number };
    });
    this.cells = this.fans.map((fan, index) => this.cell(fan, index));
    const legend = element("ul", { class: "legend" }, ...GROUPS.map((group) => element("li", {}, `${group.mark} ${group.title.toLowerCase()}`)),
      element("li", {}, "bar: score relative to its limit"));
    const form = element("form", { class: "filters", onsubmit: (event) => event.preventDefault() },
      element("label", { for: "tray" }, "Tray"), this.tray, element("label", { for: "state" }, "State"), this.state);
    return element("div", {}, form, legend, ...this.sections.map((section) => section.root));
  }

  cell(fan, index) {
    const mark = element("span", { class: "mark", "aria-hidden": "true" });
    const words = element("span", { class: "words" });
    const level = element("span", { class: "level", "aria-hidden": "true" });
    const root = element("button", { class: "cell", type: "button", tabindex: "-1" }, mark,
      element("span", { class: "name" }, `${fan.tray} ${fan.fan}`), words, level);
    root.dataset.index = index;
    return { root, mark, words, level, group: -1, class: -1, percent: -1 };
  }

  update(fleet) {
    const classes = bytes(fleet.classes), levels = bytes(fleet.levels);
    const came = new Map();
    for (let index = 0; index < this.cells.length; index++) {
      const cell = this.cells[index];
      const isOther = classes[index] !== cell.class;
      if (isOther) {
        cell.class = classes[index];
        const group = this.groupOfClass[cell.class];
        if (group !== cell.group) {
          cell.group = group;
          if (!came.has(group)) came.set(group, []);
          came.get(group).push(index);
        }
      }
      const percent = levels[index] === NO_LEVEL ? 0 : Math.min(100, 5 * Math.round(levels[index] / 5));
      if (isOther || percent !== cell.percent) this.label(cell, index, percent);
    }
    for (const [group, indexes] of came) this.place(group, indexes);
    if (came.size) this.count();
  }

  label(cell, index, percent) {
    const group = GROUPS[cell.group], fan = this.fans[index];
    const words = cell.group === 4 ? "normal" : this.site.classes[cell.class];
    if (percent !== cell.percent) {
      cell.percent = percent;
      cell.level.style.width = `${percent}%`;
    }
    const text = `${fan.tray} fan ${fan.fan}: ${words}${percent ? `, ${percent} % of the limit` : ""}`;
    if (cell.root.title !== text) {
      cell.root.title = text;
      cell.root.setAttribute("aria-label", text);
      cell.mark.textContent = group.mark;
      cell.words.textContent = percent ? `${words}, ${percent} % of limit` : words;
      cell.root.className = `cell ${group.name}`;
    }
  }

  place(group, indexes) {
    const parent = this.sections[group].cells;
    if (parent.childElementCount === 0 || indexes.length > 200) {
      const all = this.cells.map((cell, index) => [cell, index]).filter(([cell]) => cell.group === group);
      parent.append(...all.map(([cell]) => cell.root));
      return;
    }
    for (const index of indexes) {
      const next = [...parent.children].find((child) => Number(child.dataset.index) > index);
      parent.insertBefore(this.cells[index].root, next ?? null);
    }
  }

  count() {
    const counts = GROUPS.map(() => 0);
    for (const cell of this.cells) if (cell.group >= 0) counts[cell.group] += 1;
    const wanted = this.state.value;
    this.sections.forEach((section, number) => {
      section.count.textContent = `(${counts[number]})`;
      section.root.hidden = counts[number] === 0 || (wanted !== "" && wanted !== GROUPS[number].name);
    });
    const first = this.root.querySelector("section:not([hidden]) .cell:not([hidden])");
    if (first && !this.root.querySelector('.cell[tabindex="0"]')) first.tabIndex = 0;
  }

  filter() {
    this.cells.forEach((cell, index) => {
      cell.root.hidden = this.tray.value !== "" && this.fans[index].tray !== this.tray.value;
    });
    this.count();
  }

  chosen(event) {
    const cell = event.target.closest(".cell");
    if (!cell) return;
    const fan = this.fans[Number(cell.dataset.index)];
    location.hash = `#/fan/${encodeURIComponent(fan.tray)}/${fan.fan}`;
  }

  moved(event) {
    const steps = { ArrowRight: 1, ArrowLeft: -1, ArrowDown: 0, ArrowUp: 0 };
    if (!(event.key in steps)) return;
    const all = [...this.root.querySelectorAll("section:not([hidden]) .cell:not([hidden])")];
    const at = all.indexOf(event.target.closest(".cell"));
    let to = at + steps[event.key];
    if (steps[event.key] === 0) {
      const columns = getComputedStyle(event.currentTarget).gridTemplateColumns.split(" ").length;
      to = at + (event.key === "ArrowDown" ? columns : -columns);
    }
    const next = all[Math.max(0, Math.min(all.length - 1, to))];
    if (at < 0 || !next) return;
    event.preventDefault();
    all[at].tabIndex = -1;
    next.tabIndex = 0;
    next.focus();
  }
}

// Every fan of the site as a cell, in groups, the worst group first. A cell moves only when its group changes, so that
// thousands of fans cost nothing while they are well.

import { element, fanLabel } from "./dom.js";

const GROUPS = [
  { name: "alarm", title: "In alarm", mark: "✖" },
  { name: "suspect", title: "Suspect", mark: "▲" },
  { name: "not_judged", title: "Not judged", mark: "?" },
  { name: "silenced", title: "In a silenced alarm", mark: "◌" },
  { name: "at_rest", title: "Stopped or starting", mark: "■" },
  { name: "normal", title: "Normal", mark: "●" },
];
const LARGE_UP_TO = 64;
const LARGE_GROUPS = 2;
const SLICE = 1250;
// levels of cells, as pipeline/site/site_json.py makes them
export const HIGHEST_LEVEL = 250;
export const NO_LEVEL = 255;
const NORMAL = GROUPS.length - 1;

// Of the view as it was chosen last: its address has the filters.
export let address = "#/fans";

// A level, which ends at HIGHEST_LEVEL.
export const levelText = (level) => `${level >= HIGHEST_LEVEL ? "≥ " : ""}${level} %`;

export const bytes = (base64) => Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));

export class Overview {
  // filters: of the address.
  constructor(site, filters) {
    this.site = site;
    this.fans = site.trays.flatMap((tray) => Array.from({ length: tray.fans }, (_, fan) => ({ tray: tray.name, fan })));
    this.groupOfClass = site.groups.map((name) => GROUPS.findIndex((group) => group.name === name));
    Object.assign(this, { cells: [], classes: null, levels: null, next: 0, waiting: 0, frame: 0 });
    this.step = this.fans.length <= LARGE_UP_TO ? 5 : 10;  // of the score shown, in per cent of its limit
    this.root = this.build();
    for (const [name, choice] of [["tray", this.tray], ["state", this.state]]) {
      if ([...choice.options].some((option) => option.value === filters.get(name))) choice.value = filters.get(name);
    }
    this.filter();
  }

  build() {
    this.tray = element("select", { id: "tray", onchange: () => this.choose() }, element("option", { value: "" }, "all trays"),
      ...this.site.trays.map((tray) => element("option", { value: tray.name }, tray.name)));
    this.state = element("select", { id: "state", onchange: () => this.choose() }, element("option", { value: "" }, "all states"),
      ...GROUPS.map((group) => element("option", { value: group.name }, group.title.toLowerCase())));
    this.sections = GROUPS.map((group, number) => {
      const count = element("span");
      const cells = element("div", { class: "cells", role: "group", "aria-label": group.title,
        onclick: (event) => this.chosen(event), onkeydown: (event) => this.moved(event) });
      const root = element("section", { hidden: true }, element("h2", {}, `${group.mark} ${group.title} `, count), cells);
      return { root, cells, count, number, isLarge: false };
    });
    this.cells = this.fans.map((fan, index) => this.cell(fan, index));
    const legend = element("ul", { class: "legend" }, ...GROUPS.map((group) => element("li", {}, `${group.mark} ${group.title.toLowerCase()}`)),
      element("li", {}, "bar: score relative to its limit"));
    const keys = element("p", { class: "muted keys" }, "Arrow keys move between fans, Enter opens one, Esc goes back.");
    const form = element("form", { class: "filters", onsubmit: (event) => event.preventDefault() },
      element("label", { for: "tray" }, "Tray"), this.tray, element("label", { for: "state" }, "State"), this.state);
    this.nothing = element("p", { class: "muted", hidden: true }, "No fan matches this selection.");
    return element("div", {}, form, legend, keys, this.nothing, ...this.sections.map((section) => section.root));
  }

  cell(fan, index) {
    const mark = element("span", { class: "mark", "aria-hidden": "true" });
    const words = element("span", { class: "words" });
    const root = element("button", { class: "cell", type: "button", tabindex: "-1" }, mark,
      element("span", { class: "name" }, fanLabel(fan)), words);
    root.index = index;
    return { root, mark, words, text: "", group: -1, class: -1, percent: -1 };
  }

  // All fans at a glance have come. The first time all cells are drawn; then some in each frame, so that none takes long.
  update(fleet) {
    const isFirst = !this.classes;
    this.classes = bytes(fleet.classes);
    this.levels = bytes(fleet.levels);
    this.waiting = this.cells.length;
    if (isFirst) this.draw(this.waiting);
    else this.frame ||= requestAnimationFrame(() => this.draw(SLICE));
  }

  draw(most) {
    this.frame = 0;
    const came = new Map();
    for (let drawn = 0; drawn < most && this.waiting > 0; drawn++, this.waiting--) {
      const index = this.next;
      this.next = (index + 1) % this.cells.length;
      const group = this.drawCell(index);
      if (group === null) continue;
      if (!came.has(group)) came.set(group, []);
      came.get(group).push(index);
    }
    for (const [group, indexes] of came) this.place(group, indexes);
    if (came.size) this.count();
    if (this.waiting > 0) this.frame = requestAnimationFrame(() => this.draw(SLICE));
  }

  // Returns the group of a fan if it is another one than before, else null.
  drawCell(index) {
    const cell = this.cells[index], level = this.levels[index], before = cell.group;
    const isOther = this.classes[index] !== cell.class;
    if (isOther) {
      cell.class = this.classes[index];
      cell.group = this.groupOfClass[cell.class];
    }
    const percent = level === NO_LEVEL ? 0 : this.step * Math.round(level / this.step);
    const hasMoved = percent !== cell.percent && Math.abs(level - cell.percent) >= this.step;
    if (isOther || hasMoved) this.label(cell, index, percent);
    return cell.group === before ? null : cell.group;
  }

  // An alarm was raised; what the fan's next sample says comes up to a second later. Many that come at once are shown
  // together.
  raise(index) {
    const cell = this.cells[index];
    if (!cell || cell.group === 0) return;
    Object.assign(cell, { class: this.site.classes.indexOf("alarm"), group: 0 });
    this.label(cell, index, Math.max(0, cell.percent));
    this.raised ??= [];
    this.raised.push(index);
    this.due ||= requestAnimationFrame(() => {
      this.place(0, this.raised.filter((each) => this.cells[each].group === 0));
      this.count();
      this.due = this.raised = null;
    });
  }

  label(cell, index, percent) {
    const group = GROUPS[cell.group], fan = this.fans[index];
    const words = cell.group === NORMAL ? "normal" : this.site.classes[cell.class];
    if (percent !== cell.percent) {
      cell.percent = percent;
      cell.root.style.backgroundSize = `${Math.min(100, percent)}% .25rem`;
    }
    const share = percent ? `, ${levelText(percent)}` : "";
    const text = `${fanLabel(fan)} ${words}${share}${share && " of the limit"}`;
    if (cell.text !== text) {
      cell.text = text;
      cell.root.title = text;
      if (this.sections[cell.group].isLarge) cell.root.removeAttribute("aria-label");
      else cell.root.setAttribute("aria-label", text);
      if (cell.mark.textContent !== group.mark) cell.mark.textContent = group.mark;
      if (this.sections[cell.group].isLarge) cell.words.textContent = `${words}${share}`;
      const kind = `cell ${group.name}`;
      if (cell.root.className !== kind) cell.root.className = kind;
    }
  }

  place(group, indexes) {
    const parent = this.sections[group].cells, had = document.activeElement;
    if (parent.childElementCount === 0 || indexes.length > 20) {
      parent.append(...this.cells.filter((cell) => cell.group === group).map((cell) => cell.root));
    } else {
      for (const index of indexes) parent.insertBefore(this.cells[index].root, firstAfter(parent.children, index));
    }
    if (had !== document.activeElement && this.root.contains(had)) had.focus();
  }

  count() {
    const counts = GROUPS.map(() => 0), shown = GROUPS.map(() => 0);
    for (const cell of this.cells) {
      if (cell.group < 0) continue;
      counts[cell.group] += 1;
      if (!cell.root.hidden) shown[cell.group] += 1;
    }
    const wanted = this.state.value;
    this.sections.forEach((section, number) => {
      section.count.textContent = shown[number] === counts[number] ? `(${counts[number]})` : `(${shown[number]} of ${counts[number]})`;
      this.enlarge(section, counts[number] <= LARGE_UP_TO && (number < LARGE_GROUPS || this.fans.length <= LARGE_UP_TO));
      section.root.hidden = shown[number] === 0 || (wanted !== "" && wanted !== GROUPS[number].name);
    });
    this.nothing.hidden = this.sections.some((section) => !section.root.hidden);
    this.offer(this.root.querySelector("section:not([hidden]) .cell:not([hidden])"));
  }

  // Cells with names and words, where they are few.
  enlarge(section, isLarge) {
    if (section.isLarge === isLarge) return;
    section.isLarge = isLarge;
    section.cells.classList.toggle("large", isLarge);
    this.cells.forEach((cell, index) => {
      if (cell.group === section.number) this.label(Object.assign(cell, { text: "" }), index, cell.percent);
    });
  }

  // One cell is reached by Tab: the one that had the focus last, as long as it is shown.
  offer(cell) {
    const now = this.offered;
    if (!cell || (now && !now.hidden && now.closest("section:not([hidden])"))) return;
    if (now) now.tabIndex = -1;
    cell.tabIndex = 0;
    this.offered = cell;
  }

  // Focus a fan by its name; returns whether it is there.
  focus(name) {
    const index = this.fans.findIndex((fan) => `${fan.tray}/${fan.fan}` === name);
    const cell = this.cells[index]?.root;
    if (!cell?.isConnected || cell.hidden) return false;
    this.moveTo(cell);
    return true;
  }

  moveTo(cell) {
    if (this.offered) this.offered.tabIndex = -1;
    cell.tabIndex = 0;
    this.offered = cell;
    cell.focus();
  }

  choose() {
    this.filter();
    history.replaceState(null, "", address);
  }

  filter() {
    this.cells.forEach((cell, index) => {
      const isHidden = this.tray.value !== "" && this.fans[index].tray !== this.tray.value;
      if (cell.root.hidden !== isHidden) cell.root.hidden = isHidden;
    });
    this.count();
    const chosen = [["tray", this.tray.value], ["state", this.state.value]].filter(([, value]) => value);
    address = `#/fans${chosen.length ? `?${new URLSearchParams(chosen)}` : ""}`;
  }

  chosen(event) {
    const cell = event.target.closest(".cell");
    if (!cell) return;
    const fan = this.fans[cell.index];
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
    this.moveTo(next);
  }
}

// The first of the cells, which are in order, that comes after an index; null: none.
function firstAfter(cells, index) {
  let low = 0, high = cells.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (cells[middle].index > index) high = middle;
    else low = middle + 1;
  }
  return cells[low] ?? null;
}

// One fan of many as a tile: its state by symbol and colour, and how near it is to its limit as a bar. It costs nothing
// while the fan is well: its words are made when somebody looks at it.

import { element } from "./dom.js";
import { inFull } from "./names.js";
import { GROUPS, levelText, NO_LEVEL } from "./states.js";

const STEP = 10;

export class FanTile {
  constructor(tray, fan, index) {
    Object.assign(this, { tray, fan, group: -1, class: -1, level: NO_LEVEL, percent: -1, words: "" });
    this.root = element("button", { class: "tile cell", type: "button", tabindex: "-1" });
    this.root.index = index;
  }

  show(shownClass, group, level, words) {
    const changed = group !== this.group, isOther = shownClass !== this.class;
    Object.assign(this, { class: shownClass, group, level, words });
    const percent = level === NO_LEVEL ? 0 : STEP * Math.round(level / STEP);
    if (percent !== this.percent && (isOther || Math.abs(level - this.percent) >= STEP)) {
      this.percent = percent;
      this.root.style.backgroundSize = `${Math.min(100, percent)}% .25rem`;
    }
    if (changed) {
      this.root.className = `tile cell ${GROUPS[group].name}`;
      this.root.textContent = GROUPS[group].mark;
      this.root.setAttribute("aria-label", `${inFull(this.tray, this.fan)} ${GROUPS[group].title}`);
    }
    return changed;
  }

  // Somebody points at it.
  explain() {
    const shown = levelText(this.level);
    this.root.title = `${inFull(this.tray, this.fan)}: ${this.words.replace(/, score.*/, "")}${shown && `, ${shown}`}`;
  }
}

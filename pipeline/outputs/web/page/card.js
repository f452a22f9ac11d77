// One fan as a card: what it is called, its speed and command, its last minute, its state, and the cause of its alarm.

import { element, setText } from "./dom.js";
import { hashOf, label, unitOf } from "./names.js";
import { Spark } from "./spark.js";
import { GROUPS, groupNumber, levelText } from "./states.js";

const ALARM = groupNumber("alarm"), LEARNING = groupNumber("learning"), NORMAL = groupNumber("normal"), SUSPECT = groupNumber("suspect"),
  SILENCED = groupNumber("silenced");

export const commandText = (command) => (command === null || command === undefined ? "" : Number(command.toPrecision(3)).toLocaleString("en"));
export const speedText = (speed) => (speed === null || speed === undefined ? "–" : Math.round(speed).toLocaleString("en"));

export class FanCard {
  constructor(tray, fan, index) {
    Object.assign(this, { tray, fan, group: -1, class: -1, level: -1, state: "" });
    const made = (tag, kind, ...content) => element(tag, { class: kind }, ...content);
    this.mark = made("span", "state");
    this.speed = made("span", "speed");
    this.command = made("span", "command");
    this.why = made("span", "why");
    this.spark = new Spark();
    this.root = element("a", { class: "fan cell", href: hashOf(tray, fan), tabindex: "-1", "data-fan": `${tray}/${fan}` },
      made("span", "name", label(tray, fan)), this.mark, this.where = made("span", "where"),
      made("span", "values", this.speed, made("span", "unit", ` ${unitOf(tray)}`), this.command), this.spark.root, this.why);
    this.root.index = index;
  }

  // words: of the class of the fan. level: 100 is the limit.
  show(shownClass, group, level, words) {
    const changed = group !== this.group;
    Object.assign(this, { class: shownClass, group, level, words });
    if (changed) {
      this.root.className = `fan cell ${GROUPS[group].name}`;
      setText(this.mark, `${GROUPS[group].mark} ${GROUPS[group].title}`);
    }
    setText(this.why, this.whyText());
    return changed;
  }

  showValues(t_s, speed, command, twin, half) {
    setText(this.speed, speedText(speed));
    setText(this.command, command === null ? "" : `command ${commandText(command)}`);
    this.spark.add(t_s, speed, twin, half);
    this.spark.draw();
  }

  explain(alarm, learning) {
    if (alarm === this.alarm && learning === this.learning) return;
    Object.assign(this, { alarm, learning });
    if (this.group >= 0) setText(this.why, this.whyText());
  }

  whyText() {
    if (this.group === LEARNING) return this.learning || "its twin is being learned";
    if (this.group === ALARM || this.group === SILENCED) {
      const now = this.words.replace(/^alarm(, )?/, "").replace(" (silenced)", ""), cause = this.alarm?.active && this.alarm.cause_with_share;
      return [cause, now, cause || now ? "" : levelText(this.level)].filter(Boolean).join("; ");
    }
    return this.group === NORMAL || this.group === SUSPECT ? levelText(this.level) : this.words;
  }
}

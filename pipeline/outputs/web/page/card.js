// One fan as a card: what it is called, its speed and command, its last minute, its state, and the cause of its alarm.

import { ageText, element, setText } from "./dom.js";
import { hashOf, shownLabel, unitOf } from "./names.js";
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
    this.mark = made("span", "state", this.symbol = made("span", ""), this.title = made("span", ""));
    this.speed = made("span", "speed");
    this.command = made("span", "command");
    this.why = made("span", "why");
    this.spark = new Spark();
    this.root = element("a", { class: "fan cell", href: hashOf(tray, fan), tabindex: "-1", "data-fan": `${tray}/${fan}` },
      made("span", "name", ...shownLabel(tray, fan)), this.mark, this.where = made("span", "where"),
      made("span", "values", this.speed, this.unit = made("span", "unit"), this.command), this.spark.root, this.why);
    this.root.index = index;
  }

  // words: of the class of the fan. level: 100 is the limit.
  show(shownClass, group, level, words) {
    const changed = group !== this.group;
    Object.assign(this, { class: shownClass, group, level, words });
    if (changed) {
      this.root.className = `fan cell ${GROUPS[group].name}`;
      setText(this.symbol, GROUPS[group].mark);
      setText(this.title, ` ${GROUPS[group].title}`);
      this.title.className = group === NORMAL ? "unseen" : "";
    }
    setText(this.why, this.whyText());
    return changed;
  }

  showValues(t_s, speed, command, twin, half) {
    setText(this.speed, speedText(speed));
    setText(this.unit, speed === null ? "" : ` ${unitOf(this.tray)}`);
    setText(this.command, command === null ? "" : `command ${commandText(command)}`);
    this.spark.add(t_s, speed, twin, half);
    this.spark.draw();
  }

  // silent_t_ns: when the last sample came, of a fan that sends none now; 0: never.
  explain(alarm, learning, silent_t_ns) {
    if (alarm === this.alarm && learning === this.learning && silent_t_ns === undefined && this.silent_t_ns === undefined) return;
    Object.assign(this, { alarm, learning, silent_t_ns });
    if (this.group >= 0) setText(this.why, this.whyText());
  }

  whyText() {
    if (this.group === LEARNING) return this.learning || "its twin is being learned";
    const said = (this.alarm?.states ?? []).filter((state) => /^(shelved|out of service)/.test(state)).join(", ");
    if (this.group === ALARM || this.group === SILENCED) {
      const now = this.plain(this.words.replace(/^alarm(, )?/, "").replace(" (silenced)", "")), cause = this.alarm?.active && this.alarm.cause_with_share;
      return [cause, now, said, cause || now ? "" : levelText(this.level)].filter(Boolean).join("; ");
    }
    return [said, this.group === NORMAL || this.group === SUSPECT ? levelText(this.level) : this.plain(this.words)].filter(Boolean).join("; ");
  }

  // Why nothing is judged: beside a mark that says so already.
  plain(words) {
    if (words !== "silent") return words.replace(/^unknown: /, "");
    return this.silent_t_ns ? `no sample for ${ageText(this.silent_t_ns)}` : "no sample yet";
  }
}

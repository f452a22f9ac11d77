// Every fan of the site: as cards, by tray or by place, the worst first; or, where there are many, as tiles in one row a
// tray, which never move, with those in alarm as cards above them.

import { FanCard } from "./card.js";
import { element, setText } from "./dom.js";
import { LearningPanel, learningText } from "./learning.js";
import { hashOf, hasPlaces, placeOf, where } from "./names.js";
import { ABOUT, bytes, GROUPS, groupNumber } from "./states.js";
import { FanTile } from "./tile.js";
import { ask, learn } from "./server.js";

const CARDS_UP_TO = 150;
const SLICE = 1250;  // tiles that are drawn in a frame
const LEAST_SPARK = 44, MOST_SPARK = 440, SPARE = 18, LEAST_CARD = 240, LEAST_TILE = 23, MOST_TILE = 64;  // pixels
const FLAT = 0.5;  // the largest height of a picture, as a share of the width of its card
const GROUPED_FROM = 9;  // fans, from which on it helps to group them otherwise
const RANK = { alarm: 0, suspect: 1, learning: 2, not_judged: 2 };  // of a card within its section
const ALARM = groupNumber("alarm"), NOT_JUDGED = groupNumber("not_judged"), LEARNING = groupNumber("learning");

// Of the view as it was chosen last: its address has the filters.
export let address = "#/fans";

export class Overview {
  // filters: of the address. alarms: those that the page knows, by name.
  constructor(site, filters, alarms) {
    Object.assign(this, { site, alarms, classes: null, levels: null, next: 0, waiting: 0, frame: 0, learning: {}, above: new Map() });
    this.fans = site.trays.flatMap((tray) => Array.from({ length: tray.fans }, (_, fan) => ({ tray: tray.name, fan })));
    this.isDense = this.fans.length > CARDS_UP_TO;
    this.groupOfClass = site.groups.map(groupNumber);
    this.state = filters.get("state") ?? "";
    this.root = this.build(filters);
    this.filter();
    this.begin();
    this.resized = () => this.fit();
    window.addEventListener("resize", this.resized);
  }

  close() {
    window.removeEventListener("resize", this.resized);
  }

  build(filters) {
    const choice = (id, text, options) => {
      const select = element("select", { id, onchange: () => this.choose() }, ...options.map(([value, words]) => element("option", { value }, words)));
      if (options.some(([value]) => value === filters.get(id))) select.value = filters.get(id);
      return [element("span", { class: "choice" }, element("label", { for: id }, text), select), select];
    };
    const trays = choice("tray", "Tray", [["", "all trays"], ...this.site.trays.map((tray) => [tray.name, tray.name])]);
    const by = choice("by", "Grouped by", [["tray", "tray"], ["place", "place"]]);
    [this.tray, this.by] = [trays[1], by[1]];
    this.chips = GROUPS.map((group) => element("button", { type: "button", class: `chip ${group.name}`, "aria-pressed": "false", title: ABOUT[group.name],
      hidden: true, onclick: () => { this.state = this.state === group.name ? "" : group.name; this.choose(); } }));
    const bar = element("form", { class: "bar", onsubmit: (event) => event.preventDefault() },
      element("div", { class: "chips", role: "group", "aria-label": "Fans by state; press one to see only these" }, ...this.chips),
      this.site.trays.length > 1 ? trays[0] : "", hasPlaces() && !this.isDense && this.fans.length >= GROUPED_FROM ? by[0] : "");
    this.panel = new LearningPanel();
    this.nothing = element("p", { class: "muted", hidden: true }, "No fan matches this selection.");
    this.cells = this.fans.map((fan, index) => new (this.isDense ? FanTile : FanCard)(fan.tray, fan.fan, index));
    this.attention = element("div", { class: "cards above", role: "group", "aria-label": "In alarm", onkeydown: (event) => this.moved(event) });
    this.main = element("div");
    this.arrange();
    return element("div", { class: "overview" }, bar, this.panel.root, this.nothing, this.isDense ? this.attention : "", this.main);
  }

  // The sections, in the order of the configuration.
  arrange() {
    const keyOf = (fan) => (this.by.value === "place" && !this.isDense && placeOf(fan.tray, fan.fan)) || fan.tray;
    const found = new Map();
    this.fans.forEach((fan, index) => found.set(keyOf(fan), [...(found.get(keyOf(fan)) ?? []), index]));
    this.sections = [...found].map(([key, indexes]) => {
      const cells = element("div", { class: this.isDense ? "tiles" : "cards", role: "group", "aria-label": key,
        onkeydown: (event) => this.moved(event), ...(this.isDense && { onclick: (event) => this.open(event), onpointerover: (event) => this.explain(event),
          onfocusin: (event) => this.explain(event) }) }, ...indexes.map((index) => this.cells[index].root));
      return { indexes, cells, root: element("section", { class: this.isDense ? "row" : "" }, found.size > 1 ? element("h2", {}, key) : "", cells) };
    });
    this.main.replaceChildren(...this.sections.map((section) => section.root));
    for (const { where: shown, tray, fan } of this.isDense ? [] : this.cells) shown.textContent = this.by.value === "place" ? tray : placeOf(tray, fan);
  }

  // What is shown fills the screen where fans are few.
  fit() {
    if (!this.root.isConnected) return;
    if (this.isDense) { this.fitTiles(); return; }
    const cards = this.cells.map((cell) => cell.root).filter((root) => !root.hidden);
    if (!cards.length) return;
    const spark = cards[0].querySelector(".spark").clientHeight, width = this.main.clientWidth;
    const counts = this.sections.map(({ indexes }) => indexes.filter((index) => !this.cells[index].root.hidden).length);
    // as many columns as fill every row, and not so many that the pictures are higher than wide
    const columns = (count, most) => Math.ceil(count / Math.ceil(count / most)) || 1;
    const isGood = (most) => {
      const lines = counts.reduce((sum, count) => sum + Math.ceil(count / columns(count, most)), 0);
      return (innerHeight - this.main.offsetTop) / lines - (cards[0].offsetHeight - spark) <= FLAT * width / most && counts.every((count) => count > 4 || count % columns(count, most) === 0);
    };
    let most = Math.max(1, Math.floor(width / LEAST_CARD));
    while (spark && most > 1 && !isGood(most)) most -= 1;
    this.sections.forEach(({ cells }, i) => cells.style.setProperty("--columns", columns(counts[i], most)));
    const rows = new Set(cards.map((root) => root.offsetTop)).size;
    const others = this.root.getBoundingClientRect().bottom + scrollY - rows * spark;
    const height = Math.max(LEAST_SPARK, Math.min(MOST_SPARK, (innerHeight - others - SPARE) / rows));
    if (Math.abs(height - spark) > 4) this.root.style.setProperty("--spark", `${Math.floor(height)}px`);
  }

  // Also after events were missed: the last minute of the fans that have a picture.
  begin() {
    return learn(async () => {
      const { fans } = await ask("/sparks"), now_s = performance.now() / 1000;
      for (const spark of fans) {
        const card = this.cardOf(spark.tray, spark.fan);
        if (!card?.spark) continue;
        card.spark.rows = [];
        spark.t_s.forEach((t_s, i) => card.spark.add(now_s + t_s - spark.t_s.at(-1), spark.measured[i], spark.predicted[i], spark.half_width[i]));
        card.spark.draw();
      }
    });
  }

  fitTiles() {
    const inLine = Math.max(1, Math.floor(this.main.clientWidth / LEAST_TILE)), lines = this.sections.reduce((sum, { indexes }) => sum + Math.ceil(indexes.length / inLine), 0);
    const height = (innerHeight - this.main.offsetTop - SPARE) / lines - 6;
    this.root.style.setProperty("--tile", `${Math.max(LEAST_TILE, Math.min(MOST_TILE, Math.floor(height)))}px`);
  }

  cardOf(tray, fan) {
    const index = this.fans.findIndex((each) => each.tray === tray && each.fan === fan);
    return this.isDense ? this.above.get(index) : this.cells[index];
  }

  // All fans at a glance have come. The first time all are drawn; then tiles some in each frame, so that none takes long.
  update(fleet) {
    const isFirst = !this.classes;
    this.classes = bytes(fleet.classes);
    this.levels = bytes(fleet.levels);
    this.values = fleet.values;
    this.learning = fleet.learning;
    this.silent_since_t_ns = fleet.silent_since_t_ns;
    this.waiting = this.cells.length;
    if (this.isDense) this.attend();
    if (isFirst || !this.isDense) this.draw(this.waiting);
    else this.frame ||= requestAnimationFrame(() => this.draw(SLICE));
    const now_s = performance.now() / 1000, { fans, speed, command, twin, half_width } = fleet.values;
    fans.forEach((index, i) => (this.isDense ? this.above.get(index) : this.cells[index])?.showValues(now_s, speed[i], command[i], twin[i], half_width[i]));
    if (this.isDense) {
      this.panel.update(this.learning, false);
      if (isFirst || this.fitted !== this.above.size) this.fit();
      this.fitted = this.above.size;
      return;
    }
    this.cells.forEach((cell) => this.explainCard(cell));
    const isUnheard = this.cells.every((cell) => this.site.classes[cell.class] === "silent" && cell.spark.rows.every((row) => row[1] === null));
    this.panel.update(this.learning, isUnheard);
    this.root.classList.toggle("unheard", isUnheard);
    this.fit();
  }

  draw(most) {
    this.frame = 0;
    let changed = false;
    for (let drawn = 0; drawn < most && this.waiting > 0; drawn++, this.waiting--) {
      const index = this.next;
      this.next = (index + 1) % this.cells.length;
      changed = this.show(this.cells[index], index) || changed;
    }
    if (changed) this.changed();
    if (this.waiting > 0) this.frame = requestAnimationFrame(() => this.draw(SLICE));
  }

  // Returns whether it is in another group than before.
  show(cell, index) {
    const shownClass = this.classes[index], level = this.levels[index], bare = this.groupOfClass[shownClass];
    const of = bare === NOT_JUDGED && this.learning[cell.tray] ? LEARNING : bare;
    if (cell.class === shownClass && cell.level === level && (cell.group === LEARNING) === (of === LEARNING)) return false;
    return cell.show(shownClass, of, level, this.site.classes[shownClass]);
  }

  changed() {
    if (!this.isDense) this.sort();
    this.count();
  }

  // An alarm was raised; what the fan's next sample says comes up to a second later. Many that come at once are shown
  // together.
  raise(index, alarm) {
    const cell = this.cells[index];
    if (!cell || !this.classes || cell.group === ALARM) return;
    cell.show(this.site.classes.indexOf("alarm"), ALARM, this.levels[index], "alarm");
    if (this.isDense) this.addAbove(index, alarm);
    this.due ||= requestAnimationFrame(() => { this.due = 0; this.changed(); });
  }

  showAlarm(alarm) {
    const card = this.cardOf(alarm.tray, alarm.fan);
    if (card) this.explainCard(card);
  }

  explainCard(card) {
    if (card instanceof FanCard) card.explain(this.alarms.get(`${card.tray}/${card.fan}`), learningText(this.learning[card.tray]?.fans[card.fan]), this.silent_since_t_ns?.[card.tray]);
  }

  // Cards of the fans in alarm of a large site, of those whose speeds come.
  attend() {
    const wanted = new Set(this.values.fans);
    for (const [index, card] of this.above) {
      if (!wanted.has(index) && this.groupOfClass[this.classes[index]] !== ALARM) { card.root.remove(); this.above.delete(index); }
    }
    const isNew = this.values.fans.filter((index) => !this.above.has(index)).map((index) => this.addAbove(index)).length;
    for (const [index, card] of this.above) this.show(card, index);
    if (isNew && !this.hasAsked) { this.hasAsked = true; this.begin(); }
  }

  addAbove(index, alarm = null) {
    if (this.above.has(index)) return;
    const { tray, fan } = this.fans[index], card = new FanCard(tray, fan, index);
    this.above.set(index, card);
    card.where.textContent = where(tray, fan);
    card.show(this.classes[index], ALARM, this.levels[index], "alarm");
    card.explain(alarm ?? this.alarms.get(`${tray}/${fan}`), null);
    this.attention.append(card.root);
  }

  // The worst first; what has not moved stays where it is.
  sort() {
    const rank = (index) => RANK[GROUPS[this.cells[index].group]?.name] ?? 3;
    const had = document.activeElement;
    for (const section of this.sections) {
      const order = [...section.indexes].sort((one, other) => rank(one) - rank(other) || one - other);
      section.worst = rank(order[0]);
      if (order.some((index, i) => section.cells.children[i] !== this.cells[index].root)) section.cells.append(...order.map((index) => this.cells[index].root));
    }
    const sections = [...this.sections].sort((one, other) => one.worst - other.worst || one.indexes[0] - other.indexes[0]);
    if (sections.some((section, i) => this.main.children[i] !== section.root)) this.main.append(...sections.map((section) => section.root));
    if (had !== document.activeElement && this.root.contains(had)) had.focus();
  }

  count() {
    const counts = GROUPS.map(() => 0);
    for (const cell of this.cells) {
      if (cell.group >= 0) counts[cell.group] += 1;
      const isHidden = (this.tray.value !== "" && cell.tray !== this.tray.value) || (this.state !== "" && GROUPS[cell.group]?.name !== this.state);
      if (cell.root.hidden !== isHidden) cell.root.hidden = isHidden;
    }
    GROUPS.forEach((group, number) => {
      const chip = this.chips[number], isPressed = this.state === group.name;
      setText(chip, `${group.mark} ${counts[number]} ${group.title}`);
      chip.hidden = counts[number] === 0 && !isPressed;
      chip.setAttribute("aria-pressed", String(isPressed));
    });
    for (const { root, indexes } of this.sections) {
      const isHidden = indexes.every((index) => this.cells[index].root.hidden);
      if (root.hidden !== isHidden) root.hidden = isHidden;
    }
    this.attention.hidden = !["", "alarm"].includes(this.state);
    this.nothing.hidden = !this.classes || this.sections.some((section) => !section.root.hidden);
    this.offer(this.root.querySelector(".cell:not([hidden])"));
  }

  // One cell is reached by Tab: the first, or that to which somebody moved, as long as it is shown.
  offer(cell) {
    const now = this.offered;
    if (!cell || (this.hasMoved && now.isConnected && !now.hidden)) return;
    if (now) now.tabIndex = -1;
    cell.tabIndex = 0;
    this.offered = cell;
  }

  // Focus a fan by its name; returns whether it is there.
  focus(name) {
    const index = this.fans.findIndex((fan) => `${fan.tray}/${fan.fan}` === name);
    const cell = (this.above.get(index) ?? this.cells[index])?.root;
    if (!cell?.isConnected || cell.hidden) return false;
    this.moveTo(cell);
    return true;
  }

  moveTo(cell) {
    if (this.offered) this.offered.tabIndex = -1;
    cell.tabIndex = 0;
    this.offered = cell;
    this.hasMoved = true;
    cell.focus();
  }

  choose() {
    if (!this.isDense && this.by.value !== this.arrangedBy) { this.arrange(); this.sort(); }
    this.filter();
    history.replaceState(null, "", address);
  }

  filter() {
    this.arrangedBy = this.by.value;
    this.count();
    const chosen = [["tray", this.tray.value], ["state", this.state], ["by", this.by.value === "tray" ? "" : this.by.value]].filter(([, value]) => value);
    address = `#/fans${chosen.length ? `?${new URLSearchParams(chosen)}` : ""}`;
  }

  open(event) {
    const cell = event.target.closest(".tile");
    if (cell) location.hash = hashOf(this.fans[cell.index].tray, this.fans[cell.index].fan);
  }

  explain(event) {
    const cell = event.target.closest(".tile");
    if (cell) this.cells[cell.index].explain();
  }

  moved(event) {
    const steps = { ArrowRight: 1, ArrowLeft: -1, ArrowDown: 0, ArrowUp: 0 };
    if (!(event.key in steps)) return;
    const all = [...this.root.querySelectorAll(".cell:not([hidden])")];
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

// The page: which view is shown, and what reaches it.

import { AlarmsView } from "./alarms.js";
import { logOut, showLogin } from "./actions.js";
import { learnClips } from "./clips.js";
import { element, notice } from "./dom.js";
import { FanView } from "./fan.js";
import { HistoryView } from "./history.js";
import { learnNames } from "./names.js";
import { notifyOf } from "./notify.js";
import { address, Overview } from "./overview.js";
import { StagesView } from "./stages.js";
import { bytes } from "./states.js";
import { ask, Events, learnWhoIAm, me, Refused } from "./server.js";

const content = document.getElementById("content");
const alarms = new Map();
const news = new Map();  // alarms that have come since the state was asked for, which its answer may not have
const CLIPS_MS = 20000;
let site = null, view = null, fleet = null, stages = [], shownHash = null, alarmsDue = 0, lastFan = "", userShown = "";

const events = new Events({
  connected: (isThere) => showConnection(isThere),
  refused: () => start(),
  fleet: (data) => {
    fleet = data;
    showSummary();
    if (view instanceof Overview || view instanceof FanView) view.update(fleet);
    showWhatFansDo();
  },
  alarm: (alarm) => {
    const name = `${alarm.tray}/${alarm.fan}`;
    const isRaised = alarm.active && alarm.presented && !alarms.get(name)?.active;
    alarms.set(name, alarm);
    news.set(name, alarm);
    if (isRaised) notifyOf(alarm);
    if (isRaised && view instanceof Overview) view.raise(indexOf(alarm.tray, alarm.fan), alarm);
    showAlarms(alarm);
    showCount();
  },
  stages: (data) => { stages = data.stages; showStages(); },
  samples: (data) => { if (view instanceof FanView) view.add(data); },
  missed: () => { learnState(); view?.begin?.(); },
});
let wasConnected = false, wasLost = false;

function showConnection(isThere) {
  const shown = document.getElementById("connection");
  shown.textContent = isThere ? "● live" : "✖ no connection: these data are old";
  shown.className = isThere ? "muted" : "lost";
  if (isThere && !wasConnected) learnState();
  if (isThere && wasLost) view?.begin?.();
  wasLost = !isThere && view !== null;
  wasConnected = isThere;
}

async function learnState() {
  try {
    await learnWhoIAm();
    news.clear();
    const [found, now] = await Promise.all([ask("/alarms"), ask("/stages"), learnClips()]);
    alarms.clear();
    found.alarms.forEach((alarm) => alarms.set(`${alarm.tray}/${alarm.fan}`, alarm));
    news.forEach((alarm, name) => alarms.set(name, alarm));
    stages = now.stages;
    showUser();
    showAlarms(null);
    showCount();
    showStages();
  } catch (failure) {
    if (failure instanceof Refused && failure.status === 401) start();
  }
}

// A clip is there a minute or two after its alarm.
setInterval(async () => {
  if (wasConnected && alarms.size && await learnClips().catch(() => false)) showAlarms(null);
}, CLIPS_MS);

function showSummary() {
  const { in_alarm, suspect, not_judged } = fleet.counts;
  document.getElementById("summary").textContent = `${in_alarm} in alarm, ${suspect} suspect, ${not_judged} not judged`;
  document.title = in_alarm ? `(${in_alarm}) ${site.site} - fantwin` : `${site.site} - fantwin`;
}

function showStages() {
  if (view instanceof StagesView) view.update(stages);
  if (view instanceof Overview) view.panel.setStages(stages);
}

function showAlarms(changed) {
  if (view instanceof Overview) (changed ? [changed] : [...alarms.values()]).forEach((alarm) => view.showAlarm(alarm));
  if (view instanceof AlarmsView) view.update();
  if (view instanceof HistoryView) view.update();
  if (view instanceof FanView && (!changed || (changed.tray === view.tray && changed.fan === view.fan))) {
    view.updateAlarm(alarms.get(`${view.tray}/${view.fan}`));
  }
}

// What fans with an alarm do now changes without a transition.
function showWhatFansDo() {
  const classes = bytes(fleet.classes);
  for (const alarm of alarms.values()) {
    const now = site.now[classes[indexOf(alarm.tray, alarm.fan)]];
    if (now === alarm.now) continue;
    alarm.now = now;
    if (view instanceof AlarmsView) view.update();
    if (view instanceof FanView && alarm.tray === view.tray && alarm.fan === view.fan) view.updateAlarm(alarm, false);
  }
}

// When many alarms come at once, they are counted together.
function showCount() {
  alarmsDue ||= requestAnimationFrame(() => {
    alarmsDue = 0;
    const presented = [...alarms.values()].filter((alarm) => alarm.presented).length;
    document.getElementById("alarm-count").textContent = presented ? `(${presented})` : "";
  });
}

const viewerUrl = (tray) => site.trays.find((each) => each.name === tray)?.viewer_url ?? "";

// A button that is drawn again while it is pressed loses the click.
function showUser() {
  const now = JSON.stringify([me.name, me.has_login]);
  if (now === userShown) return;
  userShown = now;
  const button = (text, onclick) => element("button", { type: "button", onclick }, text);
  const shown = me.name ? [`${me.name} `, me.has_login ? button("Log out", () => logOut(start)) : ""]
    : me.has_login ? [button("Log in", () => showLogin(start))] : [];
  document.getElementById("user").replaceChildren(...shown);
}

function showView() {
  if (!site || location.hash === shownHash) return;
  shownHash = location.hash;
  const [path, filters] = location.hash.replace(/^#\//, "").split("?");
  const [kind, tray, fan] = path.split("/").map(decodeURIComponent);
  view?.close?.();
  const isFan = kind === "fan" && site.trays.some((each) => each.name === tray && /^\d+$/.test(fan) && Number(fan) < each.fans);
  const wanted = isFan ? `${tray}/${fan}` : "";
  if (events.fan !== wanted || !events.source) events.open(wanted);
  if (isFan) lastFan = wanted;
  if (isFan) view = new FanView(site, indexOf(tray, Number(fan)), tray, Number(fan), alarms.get(wanted), viewerUrl(tray));
  else if (kind === "alarms") view = new AlarmsView(alarms, viewerUrl);
  else if (kind === "history") view = new HistoryView();
  else if (kind === "stages") view = new StagesView();
  else if (kind === "fan") view = { root: element("p", {}, `There is no fan ${fan ?? ""} of ${tray ?? ""}. `, element("a", { href: address }, "All fans")) };
  else view = new Overview(site, new URLSearchParams(filters), alarms);
  content.replaceChildren(view.root);
  if ((view instanceof Overview || view instanceof FanView) && fleet) view.update(fleet);
  showStages();
  const current = isFan || !["alarms", "history", "stages"].includes(kind) ? "fans" : kind;
  for (const link of document.querySelectorAll("nav a")) {
    if (link.getAttribute("href") === `#/${current}`) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
}

// The index of a fan among all of the site.
function indexOf(tray, fan) {
  let before = 0;
  for (const each of site.trays) {
    if (each.name === tray) return before + fan;
    before += each.fans;
  }
  return -1;
}

async function start() {
  shownHash = null;
  try {
    await learnWhoIAm();
    showUser();
    if (!me.may_read) {
      events.close();
      view?.close?.();
      content.replaceChildren(element("p", {}, me.has_login ? "Log in to see the fans." : "The proxy has not passed on your user name."));
      if (me.has_login) showLogin(start);
      return;
    }
    site = await ask("/site");
    learnNames(site);
    document.getElementById("site").textContent = site.site;
    showView();
    await learnState();
  } catch (failure) {
    showConnection(false);
    if (failure instanceof Refused) notice(failure.message);
    setTimeout(start, 1000);
  }
}

window.addEventListener("hashchange", () => {
  showView();
  if (!(view instanceof Overview && view.focus(lastFan))) {
    content.focus({ preventScroll: true });  // it would scroll the first line behind the header
    scrollTo(0, 0);
  }
});
window.addEventListener("keydown", (event) => {
  const isElsewhere = document.getElementById("dialog").open || event.target.matches("input, select");
  if (event.key === "Escape" && !isElsewhere && view instanceof FanView) location.hash = address;
});
start();

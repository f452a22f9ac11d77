// Notifications of the browser when an alarm is raised: off until somebody turns them on here.

import { element, notice } from "./dom.js";
import { inFull } from "./names.js";

const KEY = "fantwin notifications";
const isOn = () => "Notification" in window && Notification.permission === "granted" && localStorage.getItem(KEY) === "on";

export function notifyButton() {
  if (!("Notification" in window)) return "";
  const button = element("button", { type: "button", title: "A notification of this browser for each alarm that is raised while the page is open", onclick: async () => {
    if (isOn()) localStorage.removeItem(KEY);
    else if (await Notification.requestPermission() === "granted") localStorage.setItem(KEY, "on");
    else notice("The browser does not allow notifications of this page.");
    show();
  } });
  const show = () => {
    button.setAttribute("aria-pressed", String(isOn()));
    button.textContent = isOn() ? "Notifications on" : "Notify me";
  };
  show();
  return button;
}

export function notifyOf(alarm) {
  if (!isOn()) return;
  let shown;
  try {
    shown = new Notification(`✖ ${inFull(alarm.tray, alarm.fan)}`, { body: alarm.cause_with_share || alarm.message, tag: `${alarm.tray}/${alarm.fan}`, icon: "/page/icon.svg" });
  } catch (failure) {  // on phones, browsers let only service workers notify
    console.info(failure.message);
    return;
  }
  shown.onclick = () => { window.focus(); location.hash = "#/alarms"; shown.close(); };
}

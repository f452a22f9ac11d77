// The wear of a fan: how its speed has changed since commissioning, how fast, and when the limit will be reached.

import { clock, element } from "./dom.js";

const DAY_NS = 86400e9;
const digits = (value) => Number(Math.abs(value).toPrecision(2));
const percent = (share) => `${share < 0 ? "−" : "+"}${digits(100 * share)} %`;
const within = (share, half) => `${percent(share)} ± ${digits(100 * half)} %`;

export function wearTable(rows) {
  if (!rows.length) return element("p", { class: "muted" }, "No data yet. The first values of a fan appear about an hour after commissioning.");
  const heads = ["Change of the speed (95 % interval)", "Fans beside it", "Change per day (95 % interval)", `${digits(100 * rows[0].limit)} % reached`];
  return element("div", {}, element("p", { class: "muted" }, `Since commissioning, as of ${clock(rows[0].t_ns)}.`),
    element("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Wear" },
      element("table", { class: "folding" },
        element("thead", {}, element("tr", {}, ...heads.map((text) => element("th", { scope: "col" }, text)))),
        element("tbody", {}, ...rows.map(row)))));
}

function row(each) {
  const cell = (label, text) => element("td", { "data-label": label }, text);
  const trend = each.per_day;
  return element("tr", {}, cell("Change", within(each.change, 1.96 * each.error)),
    cell("Fans beside it", each.beside === null ? "" : percent(each.beside)),
    cell("Change per day", trend ? within(trend.value, (trend.high - trend.low) / 2) : "no trend yet"),
    cell("Limit reached", forecast(each)));
}

function forecast(each) {
  if (!each.reached_t_ns) return each.unknown_reason;
  const [earliest, likely, latest] = ["earliest", "likely", "latest"].map((name) => (Math.max(0, each.reached_t_ns[name] - each.t_ns) / DAY_NS).toFixed(1));
  return `in ${likely} days (${earliest} to ${latest})`;
}

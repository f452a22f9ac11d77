// The wear of a fan: how it has changed since commissioning, how fast, and when a limit will be reached.

import { clock, element } from "./dom.js";

const DAY_NS = 86400e9;
const signed = (value, digits) => `${value < 0 ? "−" : "+"}${Number(Math.abs(value).toPrecision(digits))}`;

export function wearTable(rows) {
  if (!rows.length) return element("p", { class: "muted" }, "No data yet. The first values of a fan appear some time after commissioning.");
  const heads = ["Parameter", "Change (95 % interval)", "Change per day (95 % interval)", "Limit reached"].map((text) => element("th", { scope: "col" }, text));
  return element("div", {}, element("p", { class: "muted" }, `Since commissioning, as of ${clock(rows[0].t_ns)}.`),
    element("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Wear" },
      element("table", { class: "folding" }, element("thead", {}, element("tr", {}, ...heads)), element("tbody", {}, ...rows.map(row)))));
}

function row(each) {
  const cell = (label, text) => element("td", { "data-label": label }, text);
  const isShare = each.unit === "relative", unit = isShare ? "%" : `command${each.command_unit ? ` in ${each.command_unit}` : ""}`;
  const size = (value, digits = 3) => signed(isShare ? 100 * value : value, digits);
  const within = (value, half, per) => `${size(value)}${half === null ? "" : ` ± ${size(Math.abs(half), 2).slice(1)}`} ${unit}${per}`;
  const trend = each.per_day;
  return element("tr", {}, cell("Parameter", each.parameter),
    cell("Change", each.change === null ? "" : within(each.change, each.error === null ? null : 2 * each.error, "")),
    cell("Change per day", trend ? within(trend.value, (trend.high - trend.low) / 2, " per day") : "no trend yet"),
    cell("Limit reached", forecast(each)));
}

function forecast(each) {
  if (!each.reached_t_ns) return each.parameter === "balance" ? each.unknown_reason : "";
  const [earliest, likely, latest] = ["earliest", "likely", "latest"].map((name) => (Math.max(0, each.reached_t_ns[name] - each.t_ns) / DAY_NS).toFixed(1));
  return `in ${likely} days (${earliest} to ${latest})`;
}

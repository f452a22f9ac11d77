// The wear of a fan: how its speed has changed since commissioning, how fast, and when the limit will be reached.

import { clock, element, facts } from "./dom.js";

const DAY_NS = 86400e9;
const digits = (value) => Number(Math.abs(value).toPrecision(2));
const percent = (share) => `${share < 0 ? "−" : "+"}${digits(100 * share)} %`;
const within = (share, half) => `${percent(share)} ± ${digits(100 * half)} % (95 %)`;

export function wearFacts(rows) {
  if (!rows.length) return [element("p", { class: "muted" }, "No data yet. The first values of a fan appear about an hour after commissioning.")];
  return rows.map((each) => facts({
    "change of the speed": `${within(each.change, 1.96 * each.error)}, as of ${clock(each.t_ns)}`,
    "fans beside it": each.beside === null ? "" : percent(each.beside),
    "change per day": each.per_day ? within(each.per_day.value, (each.per_day.high - each.per_day.low) / 2) : "no trend yet",
    [`${digits(100 * each.limit)} % reached`]: forecast(each),
  }));
}

function forecast(each) {
  if (!each.reached_t_ns) return each.unknown_reason;
  const [earliest, likely, latest] = ["earliest", "likely", "latest"].map((name) => (Math.max(0, each.reached_t_ns[name] - each.t_ns) / DAY_NS).toFixed(1));
  return `in ${likely} days (${earliest} to ${latest})`;
}

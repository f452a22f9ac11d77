"""The page about a fleet in Markdown: how many fans are in alarm, the worst fans by name, and which are not judged."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from fantwin.pipeline.outputs.rerun.stages_page import markdown_literal
from fantwin.pipeline.recordings.dates import has_date
from fantwin.pipeline.site.fleet import Fan, FanNow, Fleet, UnscoredFans
from fantwin.schemas.units import NS_PER_S

FANS_LISTED = 24
REASONS_LISTED = 5
TRAYS_NAMED = 3


def worst_page(site: str, fleet: Fleet, place: Callable[[Fan], int | None], t_ns: int) -> str:
    """The page at the time of the newest sample.

    Args:
        site: its name.
        fleet: its fans.
        place: the number of a fan's plot; None if it has none.
        t_ns: ns since the epoch.
    """
    counts = fleet.counts()
    summary = ", ".join(f"{count:,} {name}" for name, count in counts.items() if count) or "all normal"
    worst = fleet.worst(FANS_LISTED)
    parts = [
        f"### {markdown_literal(site)}: {len(fleet.fans):,} fans, {summary}",
        _table(worst, place, t_ns) if worst else "",
        _more(counts["in alarm"] - sum(fan.is_in_alarm for fan in worst)),
        _left_out(fleet.unscored(), t_ns),
    ]
    return "\n\n".join(filter(None, parts))


def _table(worst: Sequence[FanNow], place: Callable[[Fan], int | None], t_ns: int) -> str:
    rows = ["| plot | tray/fan | state | score | since (UTC) |", "|--:|:--|:--|--:|:--|"]
    for each in worst:
        number = place(each.fan)
        name, state = markdown_literal(str(each.fan)), each.state
        columns = ("" if number is None else str(number), f"**{name}**" if each.is_in_alarm else name)
        score = f"{each.score:.2f}" if np.isfinite(each.score) else ""
        rows.append(f"| {' | '.join((*columns, state, score, clock_utc(each.since_t_ns, t_ns)))} |")
    return "\n".join(rows)


def _more(fans: int) -> str:
    return f"and {fans:,} more in alarm: `fantwin alarms` lists them" if fans > 0 else ""


def _left_out(groups: Sequence[UnscoredFans], t_ns: int) -> str:
    if not groups:
        return ""
    lines = ["### Not judged", *(_reason(group, t_ns) for group in groups[:REASONS_LISTED])]
    if groups[REASONS_LISTED:]:
        lines.append(f"- {sum(group.fans for group in groups[REASONS_LISTED:]):,} fans for other reasons")
    return "\n".join(lines)


def _reason(group: UnscoredFans, t_ns: int) -> str:
    named = ", ".join(markdown_literal(tray) for tray in group.trays[:TRAYS_NAMED])
    more = len(group.trays) - TRAYS_NAMED
    trays = f"{named} and {more:,} more trays" if more > 0 else named
    fans = "1 fan" if group.fans == 1 else f"{group.fans:,} fans"
    since = f", since {clock_utc(group.since_t_ns, t_ns)}" if group.since_t_ns else ""
    return f"- {group.reason}: {fans} of {trays}{since}"


def clock_utc(t_ns: int, now_t_ns: int) -> str:
    """A time of day in UTC, with the date unless it is that of `now_t_ns`; in seconds if the times are no dates."""
    if not has_date(t_ns):
        return f"{t_ns / NS_PER_S:.1f} s"
    day, clock = np.datetime_as_string(np.datetime64(t_ns, "ns"), unit="s").split("T")
    today = np.datetime_as_string(np.datetime64(now_t_ns, "ns"), unit="D")
    return clock if day == today else f"{day} {clock}"

"""A fan over any range of days: what the gateway has kept of the last hour, and before that the recordings.

Of each part of the range there are the least, mean and largest value; of recordings without scores, twin, deviation and
score are those of the second (topic `overview`). With it come the transitions of the fan's alarm, and how probable each
cause was when.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from io import StringIO
from typing import Any

import numpy as np

from fantwin.pipeline.recordings.time_range import Recorded, RecordedRange
from fantwin.pipeline.site.buckets import Buckets, Points
from fantwin.pipeline.site.fan_history import COLUMNS, CURVES, DEVIATION, SERIES, channels_of, in_series, values_of
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.site_json import mark_json
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.schemas.channels import BY_NAME, measured_columns
from fantwin.schemas.messages import OVERVIEW_ROW_NS, Array, Overview, Raw, Score
from fantwin.schemas.units import NS_PER_S, RAD_S_PER_UNIT
from fantwin.scoring.alarms.current_alarms import current_alarm
from fantwin.scoring.diagnosis.causes import short_name

MOST_MARKS = 1000
LONGEST_READ_S = 120.0
"""longest time for which one answer may read recordings, since others wait for their turn"""
_BEFORE = 50
"""transitions before the range that are looked at for the alarm at its beginning"""
_SPEEDS = (DEVIATION, *CURVES[:3])
_NAMES = {
    DEVIATION: "deviation",
    "measured_speed_rad_s": "measured",
    "predicted_speed_rad_s": "predicted",
    "band_half_width_rad_s": "half_width",
}
_OVERVIEW = {
    "predicted_speed_rad_s": ("predicted_speed_rad_s",) * 3,
    "band_half_width_rad_s": ("band_half_width_rad_s",) * 3,
    DEVIATION: ("lowest_residual_rad_s", "residual_rad_s", "highest_residual_rad_s"),
    "score": ("highest_score",) * 3,
}
"""of a series, the columns of an overview with its least, mean and largest value"""
_READ = (*COLUMNS, "speed_rad_s", *(name for names in _OVERVIEW.values() for name in names))


@dataclass(frozen=True)
class FanSeries:
    """What is known of one fan in a range of time, its end left out."""

    model: SiteModel
    recorded: RecordedRange | None
    """None: no recorder of this host records the site"""

    def points(self, fan: Fan, begin_ns: int, end_ns: int, points: int) -> tuple[Points, int, str]:
        """The points, the width of the parts of the range in ns, and a note about what is missing."""
        history = self.model.kept
        t_ns, low, mean, high = self.model.series(fan)
        live_ns = int(t_ns[0]) if len(t_ns) else end_ns
        uses_live = live_ns < end_ns and len(t_ns) > 0 and int(t_ns[-1]) >= begin_ns
        buckets = Buckets(begin_ns, end_ns, points, len(SERIES), history.step_ns if uses_live else 1)
        if uses_live:
            buckets.add(t_ns, mean, low, high)
        recorded_ns = min(end_ns, live_ns) if uses_live and history.is_complete else end_ns
        notes: list[str] = []
        if begin_ns < recorded_ns:
            if self.recorded is None:
                notes.append("older times are not shown: no recorder of this host records them")
            else:
                notes += self._add_recorded(self.recorded, buckets, fan, begin_ns, recorded_ns)
        return buckets.points(), buckets.width_ns, "; ".join(notes)

    def _add_recorded(
        self, recorded: RecordedRange, buckets: Buckets, fan: Fan, begin_ns: int, end_ns: int
    ) -> list[str]:
        unread: set[str] = set()
        kinds: set[type] = set()
        tray = self.model.tray(fan.tray)
        ends_s, notes = time.monotonic() + LONGEST_READ_S, list[str]()
        for block in recorded.blocks(fan.tray, begin_ns, end_ns, _READ, unread):
            if tray and block.fans == tray.fans:
                _add_block(buckets, block, fan.number, end_ns, has_samples=bool(kinds - {Overview}))
                kinds.add(type(block))
            if time.monotonic() >= ends_s:
                notes.append(
                    f"later recordings are left out, after {LONGEST_READ_S:g} s of reading: choose a shorter time"
                )
                break
        notes += [f"{name} cannot be read in full" for name in sorted(unread)]
        return [*notes, "of recorded times only what was measured: no twin judged it"] if kinds == {Raw} else notes

    def as_json(self, fan: Fan, begin_ns: int, end_ns: int, points: int) -> dict[str, Any]:
        """The points as columns by name, marks, and causes; speeds in the unit of the tray."""
        found, width_ns, note = self.points(fan, begin_ns, end_ns, points)
        scales = _scales(RAD_S_PER_UNIT[self._speed_unit(fan)])
        kinds = {"min": found.low / scales, "mean": found.mean / scales, "max": found.high / scales}
        columns = {
            _NAMES.get(name, name): {kind: _or_null(values[:, at]) for kind, values in kinds.items()}
            for at, name in _shown(found)
        }
        return {
            "tray": fan.tray,
            "fan": fan.number,
            "speed_unit": self._speed_unit(fan),
            "from_s": begin_ns / NS_PER_S,
            "to_s": end_ns / NS_PER_S,
            "bucket_s": width_ns / NS_PER_S,
            "t_s": (found.t_ns / NS_PER_S).round(3).tolist(),
            "columns": columns,
            **self._alarms(fan, begin_ns, end_ns),
            "note": note,
        }

    def as_csv(self, fan: Fan, begin_ns: int, end_ns: int, points: int) -> str:
        """The points as a table, with the unit in the name of a column of speeds."""
        found, _, _ = self.points(fan, begin_ns, end_ns, points)
        unit = self._speed_unit(fan).replace("/", "_")
        scales = _scales(RAD_S_PER_UNIT[self._speed_unit(fan)])
        shown = _shown(found)
        text = StringIO()
        rows = csv.writer(text, lineterminator="\n")
        names = [f"{_NAMES[name]}_{unit}" if name in _NAMES else name for _, name in shown]
        rows.writerow(["time", *(f"{name}_{kind}" for name in names for kind in ("min", "mean", "max"))])
        kinds = np.stack([found.low / scales, found.mean / scales, found.high / scales], axis=-1)[
            :, [at for at, _ in shown]
        ]
        for t_ns, values in zip(found.t_ns.tolist(), kinds.reshape(len(kinds), -1).tolist(), strict=True):
            at = datetime.fromtimestamp(t_ns / NS_PER_S, UTC).isoformat(timespec="milliseconds")
            rows.writerow([at, *("" if value != value else f"{value:.6g}" for value in values)])  # noqa: PLR0124  NaN
        return text.getvalue()

    def _speed_unit(self, fan: Fan) -> Any:
        tray = self.model.tray(fan.tray)
        assert tray, "only fans of the site are asked for"
        return tray.speed_unit

    def _alarms(self, fan: Fan, begin_ns: int, end_ns: int) -> dict[str, Any]:
        """Marks, and the probabilities of causes as steps: each holds until the next; none: there is no alarm.

        Raises:
            UserError: the history cannot be read.
        """
        of_fan: dict[str, Any] = {"tray": fan.tray, "fan": fan.number}
        past = self.model.past.between(0, begin_ns, _BEFORE, **of_fan, is_backwards=True)
        marks = self.model.past.between(begin_ns, end_ns, MOST_MARKS, **of_fan)
        before = current_alarm(list(reversed(past))) if past else None
        causes = [_step(begin_ns, before.causes)] if before and before.newest.active and before.causes else []
        for alarm in marks:
            if alarm.causes and alarm.active:
                causes.append(_step(alarm.t_ns, alarm.causes))
            elif not alarm.active and causes and causes[-1]["probabilities"]:
                causes.append(_step(alarm.t_ns, ()))
        return {"marks": [{"t_s": alarm.t_ns / NS_PER_S, **mark_json(alarm)} for alarm in marks], "causes": causes}


def _add_block(buckets: Buckets, block: Recorded, fan: int, end_ns: int, *, has_samples: bool) -> None:
    """Add what a recording tells of a fan before a time. has_samples: it has samples beside an overview."""
    t_ns = np.asarray(block.host_receive_t_ns if isinstance(block, Raw) else block.t_ns)
    if not isinstance(block, Overview):
        before = np.flatnonzero(t_ns < end_ns)
        buckets.add(t_ns[before], _series_of(block, fan)[before])
        return
    since_ns = t_ns // OVERVIEW_ROW_NS * OVERVIEW_ROW_NS
    before = np.flatnonzero(since_ns < end_ns)
    low, mean, high = np.full((3, len(t_ns), len(SERIES)), np.nan)
    for name, of_overview in _OVERVIEW.items():
        for values, column in zip((low, mean, high), of_overview, strict=True):
            values[:, SERIES.index(name)] = getattr(block, column)[:, fan]
    if has_samples:
        buckets.add_spans(since_ns[before], t_ns[before], mean[before], low[before], high[before])
    else:
        buckets.add(t_ns[before], mean[before], low[before], high[before])


def _series_of(block: Score | Raw, fan: int) -> Array:
    """Of one fan, (n, len(SERIES))."""
    if isinstance(block, Score):
        channels = channels_of(block)
        return in_series(values_of(block, channels, np.s_[:, fan]), channels)
    channels = measured_columns(block)
    values = np.full((len(block.host_receive_t_ns), len(CURVES) + len(channels)), np.nan, np.float32)
    measured = {"measured_speed_rad_s": block.speed_rad_s, "command": block.command}
    for name, column in measured.items():
        values[:, CURVES.index(name)] = column[:, fan]
    for at, column in enumerate(channels.values(), len(CURVES)):
        values[:, at] = column[:, fan]
    return in_series(values, tuple(channels))


def _shown(points: Points) -> list[tuple[int, str]]:
    """Number and name of each column, without channels that are not measured."""
    return [
        (at, name) for at, name in enumerate(SERIES) if name not in BY_NAME or np.isfinite(points.mean[:, at]).any()
    ]


def _scales(rad_s_per_unit: float) -> Array:
    return np.array([rad_s_per_unit if name in _SPEEDS else 1.0 for name in SERIES])


def _or_null(values: Array) -> list[float | None]:
    return [None if value != value else float(f"{value:.5g}") for value in values.tolist()]  # noqa: PLR0124  NaN


def _step(t_ns: int, causes: Sequence[Any]) -> dict[str, Any]:
    probabilities = {short_name(each.cause): each.probability for each in causes}
    return {"t_s": t_ns / NS_PER_S, "probabilities": probabilities}

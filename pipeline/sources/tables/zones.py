"""Local times of a time zone as UTC; the order of rows tells the two hours apart when summer time ends."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np

from fantwin.pipeline.errors import UsageError
from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S

_QUARTER_NS = 900 * NS_PER_S
"""offsets of zones change at quarters of an hour"""


def zone_of(name: str) -> ZoneInfo:
    """The time zone of a name. Raises UsageError."""
    try:
        return ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError, OSError) as error:
        raise UsageError(
            f"--zone {name}: no such time zone; write it as Europe/Berlin, America/New_York or UTC"
        ) from error


def as_utc(column: str, local_ns: Array, zone: ZoneInfo) -> tuple[Array, list[str]]:
    """(n,) times in ns since 1970, and notes, from local ones in the order of the file, as if they were in UTC."""
    quarters, index = np.unique(local_ns // _QUARTER_NS, return_inverse=True)
    first, second = (
        np.array([_offset_ns(int(quarter) * _QUARTER_NS, zone, fold) for quarter in quarters], np.int64)
        for fold in (0, 1)
    )
    repeats = first > second
    missing = int(np.count_nonzero((first < second)[index]))
    is_second = np.zeros(len(local_ns), np.bool_)
    notes: list[str] = []
    if repeats.any():
        rows = np.flatnonzero(repeats[index])
        for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
            is_second[run] = _is_second(local_ns, run)
        told = int(np.count_nonzero(is_second))
        notes.append(
            f"{len(rows)} times of {column!r} in an hour that {zone.key} has twice: {told} taken as the second, by the "
            "order of the rows"
        )
    if missing:
        notes.append(
            f"{missing} times of {column!r} do not exist in {zone.key}, when summer time begins: is it the zone?"
        )
    return local_ns - np.where(is_second, second[index], first[index]), notes


def _is_second(local_ns: Array, run: Array) -> Array:
    """Whether each row of a run in the repeated hour is of its second time: from where it goes back, or throughout if
    the rows before end an hour earlier and those after go on."""
    steps = np.diff(local_ns[run])
    back = np.flatnonzero(steps < -_QUARTER_NS)
    if len(back):
        return np.arange(len(run)) > back[0]
    usual = float(np.median(np.abs(steps))) if len(steps) else 0.0
    before = local_ns[run[0]] - local_ns[run[0] - 1] if run[0] else None
    after = local_ns[run[-1] + 1] - local_ns[run[-1]] if run[-1] + 1 < len(local_ns) else None
    goes_on = after is not None and after <= max(5 * usual, NS_PER_S)
    came_from = before is not None and before <= max(5 * usual, NS_PER_S)
    return np.full(len(run), goes_on and not came_from)


def _offset_ns(local_ns: int, zone: ZoneInfo, fold: int) -> int:
    local = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=local_ns // NS_PER_S)
    offset = local.replace(tzinfo=zone, fold=fold).utcoffset()
    return round(offset.total_seconds()) * NS_PER_S if offset else 0

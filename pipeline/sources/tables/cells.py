"""Cells of a measured table as numbers and times, column by column and in parts: large tables fit in memory."""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from fantwin.pipeline.errors import UserError
from fantwin.schemas.messages import FURTHEST_T_NS, Array
from fantwin.schemas.units import NS_PER_S

NS_PER_UNIT = {"s": NS_PER_S, "ms": 1_000_000, "us": 1_000, "ns": 1}
DATE_UNIT = "iso"

_UNIX_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_DATE_AND_FRACTION = re.compile(r"(\d\d:\d\d:\d\d)[:,](\d+)")  # some loggers write 17:14:08:947, or 17:14:08,947
_FINER_UNIT = {"s": "ms", "ms": "us", "us": "ns"}
_NOT_MEASURED = {"", "nan", "na", "n/a", "null", "none", "-"}


class NumberColumn:
    """A column of float64, NaN where a cell is not a finite number."""

    def __init__(self, path: Path, name: str, index: int) -> None:
        self._path, self._name, self._index = path, name, index
        self._values = array("d")
        self._first = ""

    def add(self, rows: Sequence[Sequence[str]]) -> None:
        """Append the cells of some rows."""
        self._first = self._first or next((row[self._index] for row in rows if row[self._index]), "")
        values = np.array([_number(row[self._index]) for row in rows], dtype=np.float64)
        values[np.isinf(values)] = np.nan
        self._values.frombytes(values.tobytes())

    def values(self) -> Array:
        """The column. Raises UserError if no cell is a number."""
        values = np.asarray(self._values)
        if not np.any(np.isfinite(values)):
            raise UserError(f"{self._path}: column {self._name!r} has no numbers, but for example {self._first!r}")
        return values


class TimeColumn:
    """A column of times in ns."""

    def __init__(self, path: Path, name: str, index: int, unit: str) -> None:
        """unit: one of NS_PER_UNIT, DATE_UNIT, or empty: numbers are then seconds and anything else is a date."""
        self._path, self.name, self._index, self._unit = path, name, index, unit
        self._is_given = bool(unit)
        self._first = ""
        self._t_ns = array("q")
        self._known = bytearray()

    @property
    def is_assumed(self) -> bool:
        """Return whether the unit is an assumption: numbers without one."""
        return not self._is_given and self._unit != DATE_UNIT

    @property
    def lacks_zone(self) -> bool:
        """Return whether the dates do not say of which time zone they are."""
        date = _date(self._first) if self._unit == DATE_UNIT else None
        return date is not None and date.tzinfo is None

    def add(self, rows: Sequence[Sequence[str]]) -> None:
        """Append the cells of some rows. Raises UserError for a time beyond the year 2116."""
        self._first = self._first or next((row[self._index] for row in rows if row[self._index]), "")
        if not self._unit and self._first:
            self._unit = DATE_UNIT if math.isnan(_number(self._first)) else "s"
        parse = _date_ns if self._unit in ("", DATE_UNIT) else _count_ns(NS_PER_UNIT[self._unit])
        for row in rows:
            time = parse(row[self._index])
            if time is not None and abs(time) >= FURTHEST_T_NS:
                self._refuse_furthest()
            self._t_ns.append(time or 0)
            self._known.append(time is not None)

    def values(self) -> tuple[Array, Array]:
        """(rows,) times in ns, and whether each could be read. Raises UserError if none could."""
        known = np.frombuffer(bytes(self._known), dtype=np.bool_)
        if not known.any():
            raise UserError(
                f"{self._path}: column {self.name!r} has no times in {self._unit or DATE_UNIT}, but for example "
                f"{self._first!r}; use numbers in s, ms, us or ns, or dates such as 2026-01-31 13:45:00.250"
            )
        return np.asarray(self._t_ns), known

    def _refuse_furthest(self) -> None:
        finer = _FINER_UNIT.get(self._unit)
        hint = f"is it in ms, us or ns? use --time {self.name}:{finer}" if finer else "choose another time column"
        raise UserError(f"{self._path}: column {self.name!r} in {self._unit} gives times beyond the year 2116: {hint}")


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        if cell.lower() in _NOT_MEASURED:
            return math.nan
    try:
        return float(cell.replace(",", "."))  # decimal comma; possible only where columns are not separated by commas
    except ValueError:
        return math.nan


def _count_ns(scale: int) -> Callable[[str], int | None]:
    def parse(cell: str) -> int | None:
        try:
            return int(cell) * scale  # exact: a float cannot hold ns since 1970
        except ValueError:
            value = _number(cell) * scale
            return round(value) if math.isfinite(value) else None

    return parse


def _date(cell: str) -> datetime | None:
    try:
        return datetime.fromisoformat(_DATE_AND_FRACTION.sub(r"\1.\2", cell))
    except ValueError:
        return None


def _date_ns(cell: str) -> int | None:
    date = _date(cell)
    if date is None:
        return None
    since = (date if date.tzinfo else date.replace(tzinfo=UTC)) - _UNIX_EPOCH
    return since // timedelta(microseconds=1) * 1000

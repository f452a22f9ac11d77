"""Dates and times of day of a table: ISO, day or month first, 12-hour clocks, names of zones.

Whether `06/09/2026` is in June or September is found by the whole column: a number above 12 is no month, and the rows
are in the order of time. Where neither tells, the user is asked.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import numpy as np

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.column_file import NO_TIME
from fantwin.pipeline.sources.wanted import ORDERS
from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S

ZONES = {
    **dict.fromkeys(("Z", "UTC", "GMT", "WET"), 0.0),
    **dict.fromkeys(("CET", "WEST", "MEZ"), 1.0),
    **dict.fromkeys(("CEST", "EET", "MESZ", "SAST"), 2.0),
    **dict.fromkeys(("EEST", "MSK"), 3.0),
    **{"JST": 9.0, "KST": 9.0, "HKT": 8.0, "SGT": 8.0, "AEST": 10.0, "AEDT": 11.0, "NZST": 12.0, "NZDT": 13.0},
    **{"EST": -5.0, "EDT": -4.0, "CDT": -5.0, "MST": -7.0, "MDT": -6.0, "PST": -8.0, "PDT": -7.0, "AKST": -9.0},
}
"""hours east of UTC, of names that mean one zone; CST, IST and BST mean several"""
_MONTHS = {
    name: k + 1
    for k, name in enumerate(["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"])
}
_DATE = r"(?P<a>\d{1,4})(?P<by>[./-])\s?(?P<b>\d{1,2}|[A-Za-z]{3,9})(?P=by)\s?(?P<c>\d{1,4})\.?"
_WORDY = r"(?P<month>[A-Za-z]{3,9})\.?\s+(?P<day>\d{1,2}),?\s+(?P<year>\d{4})"
_TIME = (
    r"(?P<h>\d{1,2})[:.](?P<m>\d\d|(?<=:)\d(?!\d))(?:[:.](?P<s>\d\d|(?<=:)\d(?!\d))(?:[.,:](?P<f>\d+))?)?"
    r"\s*(?P<half>[AaPp]\.?[Mm]\.?)?\s*(?P<zone>Z|[A-Za-z]{3,4}|(?:UTC|GMT)?[+-]\d\d:?\d\d)?(?:\s+[A-Z]{3,4})?"
)
_DATED = re.compile(rf"(?:[A-Za-z]{{2,9}}\.?,?\s+)?(?:{_DATE}|{_WORDY})(?:[T,\s]\s*{_TIME})?")
_TIME_FIRST = re.compile(r"(\d{1,2}:\d\S*(?:\s+[AaPp]\.?[Mm]\.?)?)[,\s]\s*(\d{1,4}[./-]\S+|[A-Za-z]{3}.+)")
_OF_DAY = re.compile(rf"(?:(?P<days>\d+)[ d.]+)?{_TIME}")
_MINUTES = re.compile(r"(?P<m>\d{1,4}):(?P<s>[0-5]\d)(?P<f>[.,]\d+)?")
_FRACTION = re.compile(r"(\d\d:\d\d:\d\d)[:,](\d+)")  # some loggers write 17:14:08:947, or 17:14:08,947
_UNIX_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_EPOCH_DAY = _UNIX_EPOCH.toordinal()
_NS_PER_DAY = 86_400 * NS_PER_S
_NO_DAY = -(1 << 31)
_LARGER_STEPS = 10.0
_TWO_DIGITS = 100
_FIRST_YEAR, _LAST_YEAR = 1900, 2116
"""of times that can be recorded"""
_FURTHEST_NS = 1 << 62
_ORDER_IN_WORDS = {"dmy": "day, month, year", "mdy": "month, day, year", "ymd": "year, month, day"}


def is_date_or_time(text: str) -> bool:
    """Whether a cell holds a date, a time of day, or both."""
    text = text.strip()
    return bool(_dated(text) or _OF_DAY.fullmatch(text) or _MINUTES.fullmatch(text) or _iso(text))


def is_time_of_day(text: str) -> bool:
    """Whether a cell holds a time of day and no date."""
    return bool(_OF_DAY.fullmatch(text.strip()) or _MINUTES.fullmatch(text.strip()))


@dataclass(frozen=True)
class _Date:
    """A date as it is written: three numbers, of which one is the year."""

    numbers: tuple[int, int, int]
    by: str
    month_is_word: bool = False


class DateColumn:
    """A column of dates, or of times of day, in ns."""

    def __init__(self, path: Path, name: str, order: str, *, has_zone: bool = False) -> None:
        """order: of the parts of a date, as the user or the writer of such files gives it; empty: found. has_zone: the
        user names the zone that a name of several stands for."""
        self._path, self._name, self._given, self._has_zone = path, name, order, has_zone
        self._t_ns = array("q")
        self._zoned = bytearray()
        self._dates: dict[_Date, int] = {}
        """those that are not ISO, numbered"""
        self._date_of = array("i")
        """the number of the date of each row that is not ISO; -1: it has none"""
        self._first_cell = ""
        self._of_day = False
        self._hours_lost = False
        self._unknown_zone = ""
        self.is_iso = False

    def add(self, cells: Sequence[str]) -> None:
        """Append some cells."""
        for text in cells:
            self._first_cell = self._first_cell or text
            t_ns = None if self._dates else _iso_ns(text)
            if t_ns is not None:
                self.is_iso = True
                self._append(*t_ns)
            else:
                self._other(text.strip())

    def _append(self, t_ns: int = NO_TIME, is_zoned: bool = False) -> None:
        self._t_ns.append(t_ns if abs(t_ns) < _FURTHEST_NS else NO_TIME)
        self._zoned.append(is_zoned)

    def _other(self, text: str) -> None:
        """A cell that is not ISO: its time of day now, its date when all are known."""
        found = _dated(text)
        if found is None:
            self._time_of_day(text)
            return
        date_of = _date_of(found)
        of_day_ns = _of_day_ns(found)
        if date_of is None or of_day_ns is None:
            self._append()
            return
        offset_ns = self._offset_ns(found["zone"])
        self._date_of.extend([-1] * (len(self._t_ns) - len(self._date_of)))
        self._date_of.append(self._dates.setdefault(date_of, len(self._dates)))
        self._append(of_day_ns - (offset_ns or 0), offset_ns is not None)

    def _time_of_day(self, text: str) -> None:
        found = _OF_DAY.fullmatch(text)
        minutes = _MINUTES.fullmatch(text)
        if minutes and (minutes["f"] or int(minutes["m"]) > 23):
            self._hours_lost = self._of_day = True
            self._append((int(minutes["m"]) * 60 + int(minutes["s"])) * NS_PER_S + _fraction_ns(minutes["f"][1:]))
            return
        of_day_ns = _of_day_ns(found) if found else None
        if found is None or of_day_ns is None:
            self._append()
            return
        self._of_day = True
        self._append(int(found["days"] or 0) * _NS_PER_DAY + of_day_ns)

    def _offset_ns(self, zone: str | None) -> int | None:
        if not zone:
            return None
        if zone.upper() in ZONES:
            return round(ZONES[zone.upper()] * 3600) * NS_PER_S
        if found := re.fullmatch(r"(?:UTC|GMT)?([+-])(\d\d):?(\d\d)", zone):
            return (int(found[2]) * 60 + int(found[3])) * (-60 if found[1] == "-" else 60) * NS_PER_S
        if not self._has_zone:
            self._unknown_zone = self._unknown_zone or zone
        return None

    @property
    def is_time_of_day(self) -> bool:
        """Whether it has times of day without a date."""
        return self._of_day and not self._dates and not self.is_iso

    def values(self) -> tuple[Array, Array, str]:
        """(rows,) times in ns since 1970, whether each has a zone, and the format in words.

        Those without a zone are as if they were in UTC.

        Raises:
            UserError: their order is open, or a zone is the name of several.
        """
        if self._unknown_zone:
            raise UserError(
                f"{self._path}: column {self._name!r}: {self._unknown_zone!r} is no zone, or the name of several: give "
                "the one that is meant, for example --zone Asia/Shanghai"
            )
        t_ns = np.asarray(self._t_ns)
        zoned = np.frombuffer(self._zoned, dtype=np.bool_)
        known = t_ns != NO_TIME
        if self.is_time_of_day:
            return _unwrapped(t_ns, known, self._hours_lost), zoned, "times of day without a date"
        if not self._dates:
            return t_ns, zoned, "dates (ISO)"
        self._date_of.extend([-1] * (len(t_ns) - len(self._date_of)))
        of_row = np.asarray(self._date_of)
        order, days = self._order(of_row[of_row >= 0])
        day = np.append(days, 0)[of_row]
        found = np.where(known & (day != _NO_DAY), t_ns + day * _NS_PER_DAY, NO_TIME)
        is_wordy = all(each.month_is_word for each in self._dates)
        return found, zoned, "dates with the name of the month" if is_wordy else f"dates as {_ORDER_IN_WORDS[order]}"

    def _order(self, of_row: Array) -> tuple[str, Array]:
        """The order of day, month and year, and the days since 1970 of the dates. of_row: numbers of the dates."""
        orders = [self._given] if self._given else _orders(next(iter(self._dates)))
        days = {order: np.array([_day(each, order) for each in self._dates], np.int64) for order in orders}
        missing = {order: int(np.count_nonzero(found == _NO_DAY)) for order, found in days.items()}
        possible = [order for order in orders if not missing[order]]
        possible = possible or [min(orders, key=missing.__getitem__)]  # some date is damaged
        if all(np.array_equal(days[order], days[possible[0]]) for order in possible):
            return possible[0], days[possible[0]]
        order = _by_order_of_rows({order: days[order][of_row] for order in possible})
        if not order:
            example = (re.search(_DATE, self._first_cell) or [self._first_cell])[0]
            either = " or ".join(f"--dates {each} ({_ORDER_IN_WORDS[each]})" for each in possible)
            raise UserError(
                f"{self._path}: column {self._name!r}: {example} can be read in {len(possible)} ways, and no row "
                f"tells: give {either}"
            )
        return order, days[order]


def _by_order_of_rows(days: Mapping[str, Array]) -> str:
    """The order with which dates follow one another; empty: none is clearly better. days: of the rows, by order."""
    steps = {order: np.diff(found) for order, found in days.items()}
    largest = {order: int(step.max()) for order, step in steps.items() if len(step) and (step >= 0).all()}
    ranked = sorted(largest, key=largest.__getitem__)
    if not ranked or (len(ranked) > 1 and largest[ranked[1]] < _LARGER_STEPS * max(1, largest[ranked[0]])):
        return ""
    return ranked[0]


def _dated(text: str) -> re.Match[str] | None:
    """The parts of a date, perhaps with a time of day behind or before it."""
    return _DATED.fullmatch(text) or _DATED.fullmatch(_TIME_FIRST.sub(r"\2 \1", text))


def _orders(written: _Date) -> Sequence[str]:
    """Orders in which a date may be written, by its form."""
    if written.numbers[0] >= _TWO_DIGITS:
        return ("ymd",)
    if written.month_is_word or written.by == ".":
        return ("dmy",)
    return ("dmy", "mdy") if written.numbers[2] >= _TWO_DIGITS else ORDERS


def _date_of(found: re.Match[str]) -> _Date | None:
    if found["month"]:
        month = _MONTHS.get(found["month"][:3].lower())
        return _Date((int(found["day"]), month, int(found["year"])), " ", month_is_word=True) if month else None
    is_word = not found["b"].isdigit()
    middle = _MONTHS.get(found["b"][:3].lower()) if is_word else int(found["b"])
    return None if middle is None else _Date((int(found["a"]), middle, int(found["c"])), found["by"], is_word)


def _day(written: _Date, order: str) -> int:
    """Days since 1970; _NO_DAY: there is no such date."""
    by_letter = dict(zip("ymd" if written.numbers[0] >= _TWO_DIGITS else order, written.numbers, strict=True))
    year = by_letter["y"] + (2000 if by_letter["y"] < _TWO_DIGITS else 0)
    try:
        day = date(year, by_letter["m"], by_letter["d"]).toordinal() - _EPOCH_DAY
    except ValueError:
        return _NO_DAY
    return day if _FIRST_YEAR <= year <= _LAST_YEAR else _NO_DAY


def _of_day_ns(found: re.Match[str]) -> int | None:
    """Time of day; midnight if there is none; None: there is no such time."""
    if found["h"] is None:
        return 0
    hour, minute, second = int(found["h"]), int(found["m"]), int(found["s"] or 0)
    if found["half"]:
        if not 1 <= hour <= 12:
            return None
        hour = hour % 12 + (12 if found["half"][0] in "pP" else 0)
    if hour > 24 or minute > 59 or second > 60:
        return None
    return (hour * 3600 + minute * 60 + second) * NS_PER_S + _fraction_ns(found["f"])


def _fraction_ns(digits: str | None) -> int:
    return int(f"{digits:0<9.9}") if digits else 0


def _unwrapped(t_ns: Array, known: Array, hours_lost: bool) -> Array:
    """Times of day that go on after midnight, or after the full hour where hours are lost."""
    period_ns = 3600 * NS_PER_S if hours_lost else _NS_PER_DAY
    found = t_ns.copy()
    steps = np.diff(t_ns[known], prepend=t_ns[known][:1])
    found[known] += np.cumsum(steps < -period_ns // 2) * period_ns
    return found


def _iso(text: str) -> datetime | None:
    try:
        return datetime.fromisoformat(_FRACTION.sub(r"\1.\2", text))
    except ValueError:
        return None


def _iso_ns(text: str) -> tuple[int, bool] | None:
    """Time in ns, and whether it has a zone."""
    found = _iso(text)
    if found is None:
        return None
    is_zoned = found.tzinfo is not None
    since = (found if is_zoned else found.replace(tzinfo=UTC)) - _UNIX_EPOCH
    return since // timedelta(microseconds=1) * 1000, is_zoned

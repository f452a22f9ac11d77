"""Long tables: a row for each value, with the name of its series beside it, as databases of time series export them.

Such a table is found by evidence: times go back or repeat from row to row, and within a series they do not. Annotated
tables of InfluxDB, which name their columns again for each result, are long tables with several heads.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.column_file import NO_TIME
from fantwin.pipeline.sources.series.series_file import Label, SeriesFile, named
from fantwin.pipeline.sources.tables.layout import Heading, Layout, all_rows_of
from fantwin.pipeline.sources.tables.rows import OddRows, rows_of
from fantwin.pipeline.sources.tables.table_file import read_cells
from fantwin.pipeline.sources.tables.times import time_names, usual_time
from fantwin.pipeline.sources.wanted import Wanted
from fantwin.schemas.messages import Array

MOST_SERIES = 10_000
_LEAST_VALUES = 2
"""of a series, on average"""
_TOO_MANY_BACK = 0.1
"""steps back within series, as a share of those from row to row"""
_MOSTLY = 0.5
_ANNOTATION = "#"
_FIELD, _VALUE, _TIME = "_field", "_value", "_time"
_ENTITY, _STATE = "entity_id", "state"
"""columns of Home Assistant"""
_NOT_TAGS = {"", "result", "table", "_start", "_stop", _TIME, _VALUE, _FIELD}
_NUMBER_TYPES = ("long", "double", "unsignedLong")
_LIKE_A_KEY = re.compile(
    r"(?i)(.*[._ ])?(fan|series|sensor|metric|field|name|id|slot|motor|esc|instance|channel|unit|device|host|tags?"
    r"|itemid)"
)


@dataclass(frozen=True)
class _Columns:
    """Which columns of a long table are what."""

    names: tuple[str, ...]
    time: str
    keys: tuple[str, ...]
    values: tuple[str, ...]


def is_annotated(layout: Layout) -> bool:
    """Whether a table has the annotations of InfluxDB, or its columns."""
    return _TIME in layout.names and (_VALUE in layout.names or "result" in layout.names)


class _TooManyError(Exception):
    """A table with more series than there are fans anywhere."""


def long_table(layout: Layout, wanted: Wanted) -> SeriesFile | None:
    """The series of a table; None: it is not long.

    Raises:
        UserError: it is one, and its times or numbers cannot be read.
    """
    columns = _of_influx(layout) if is_annotated(layout) else _of_any(layout, wanted.time)
    if columns is None:
        return None
    at = [columns.names.index(key) for key in columns.keys]
    known: dict[tuple[str, ...], int] = {}
    odd = OddRows()
    of_row = array("i")

    def rows() -> Iterator[list[str]]:
        nonlocal odd
        odd = OddRows()
        known.clear()
        del of_row[:]
        for row in _annotated_rows(layout, columns.names) if is_annotated(layout) else rows_of(layout, odd):
            of_row.append(known.setdefault(tuple(row[k] for k in at), len(known)))
            if len(known) > MOST_SERIES:
                raise _TooManyError
            yield row

    try:
        times, numbers, _ = read_cells(_with_names(layout, columns.names), columns.time, columns.values, wanted, rows)
    except _TooManyError:
        return None
    if not of_row or times is None:
        return None
    t_ns, series = times.values(), np.asarray(of_row)
    has_time = t_ns != NO_TIME
    is_keyed = all(_LIKE_A_KEY.fullmatch(key) for key in columns.keys)
    is_only = is_keyed and len(columns.values) == 1 and len(known) > 1  # a table of fans has two columns of numbers
    is_long = is_annotated(layout) or is_only
    if not is_long and not _is_long(t_ns[has_time], series[has_time], len(known), is_keyed=is_keyed):
        return None
    for problem in filter(None, (column.problem for column in numbers.values())):
        raise problem
    order = np.argsort(series, kind="stable")
    parts = np.split(order, np.cumsum(np.bincount(series))[:-1])
    by = " and ".join(map(repr, columns.keys)) or "nothing"
    texts = {name: column.texts(has_time) for name, column in numbers.items()}
    notes = [
        *times.notes,
        *odd.in_words(layout),
        *(f"{name!r}: {text}" for name, text in texts.items() if text),
    ]
    found = [
        (_label(columns, key, name), t_ns[rows][is_value], column.values[rows][is_value])
        for key, rows in zip(known, parts, strict=True)
        for name, column in numbers.items()
        if (is_value := has_time[rows] & np.isfinite(column.values[rows])).any()
    ]
    if not found:
        raise UserError(f"{layout.path}: a row a value, and none of the values is a number")
    return SeriesFile(f"long table, {len(found)} series by {by}", named(found), notes)


def _with_names(layout: Layout, names: Sequence[str]) -> Layout:
    """A layout of rows with these columns, in this order."""
    known = {each.name: each for each in layout.columns}
    columns = (replace(known.get(name, Heading(k, name)), index=k, second="") for k, name in enumerate(names))
    return replace(layout, columns=tuple(columns))


def _label(columns: _Columns, key: Sequence[str], value_column: str) -> Label:
    tags = [(name, text) for name, text in zip(columns.keys, key, strict=True) if text]
    field = next((text for name, text in tags if name == _FIELD), "")
    if field:
        return Label(field, tuple(tag for tag in tags if tag[0] != _FIELD))
    if len(columns.values) == 1:
        return Label("", tuple(tags))
    return Label(value_column, tuple(("", text) if len(tags) == 1 else (name, text) for name, text in tags))


def _is_long(t_ns: Array, series: Array, count: int, *, is_keyed: bool) -> bool:
    """Whether times go on within series, and not from row to row; or series take turns, and are named as such."""
    if count < 2 or len(t_ns) < _LEAST_VALUES * count:
        return False
    counts = np.bincount(series)
    changes = np.count_nonzero(np.diff(series))
    if is_keyed and changes > _MOSTLY * len(series) and counts.max() <= 2 * counts.min():
        return True
    back = int(np.count_nonzero(np.diff(t_ns) <= 0))
    order = np.argsort(series, kind="stable")
    within = np.diff(t_ns[order])[np.diff(series[order]) == 0]
    return back >= count - 1 and int(np.count_nonzero(within <= 0)) <= _TOO_MANY_BACK * back


def _of_any(layout: Layout, time: str | None) -> _Columns | None:
    time = time or usual_time(layout)
    of_time = time_names(layout, time)[0] if time else []
    if not time or not all(name in layout.all_names for name in of_time):
        return None
    if {_ENTITY, _STATE} <= set(layout.names):
        return _Columns(tuple(layout.names), time, (_ENTITY,), (_STATE,))
    others = [each for each in layout.columns if each.name and each.name not in of_time]
    numbers = [each for each in others if each.kind == "number"]
    likely = [each.name for each in numbers if len(numbers) > 1 and _is_number_of_fan(each)]
    keys = [*(each.name for each in others if each.kind == "text"), *likely]
    values = [each.name for each in numbers if each.name not in likely]
    return _Columns(tuple(layout.names), time, tuple(keys), tuple(values)) if values and keys else None


def _is_number_of_fan(column: Heading) -> bool:
    """Whether a column has few whole numbers in the sample, and the name of a key."""
    few = len(set(column.cells)) <= max(1, len(column.cells) // 2)
    return few and all(map(str.isdecimal, column.cells)) and bool(_LIKE_A_KEY.fullmatch(column.name))


def _of_influx(layout: Layout) -> _Columns:
    types_of = dict.fromkeys(layout.written, "")
    last: list[str] = []
    for head, types, _ in _annotated(layout):
        if head is not last:
            last = head
            types_of |= dict(zip_longest(head, types[: len(head)], fillvalue=""))
    typed = [name for name, kind in types_of.items() if kind in _NUMBER_TYPES and name not in _NOT_TAGS]
    numbers = [each.name for each in layout.columns if each.kind == "number" and each.name not in _NOT_TAGS]
    values = [_VALUE] if _VALUE in types_of else typed or numbers
    tags = (name for name in types_of if name not in _NOT_TAGS and name not in values)
    field = (_FIELD,) if _FIELD in types_of else ()
    return _Columns(tuple(types_of), _TIME, (*field, *tags), tuple(values))


def _annotated_rows(layout: Layout, names: Sequence[str]) -> Iterator[list[str]]:
    last: list[str] = []
    place: list[int] = []
    for head, _, row in _annotated(layout):
        if head is not last:
            last, place = head, [head.index(name) if name in head else len(head) for name in names]
        yield [row[k] if k < len(row) else "" for k in place]


def _annotated(layout: Layout) -> Iterator[tuple[list[str], list[str], list[str]]]:
    """Each row of an annotated table, with the names and types above it."""
    head: list[str] = []
    types: list[str] = []
    for row in all_rows_of(layout):
        if row and row[0].startswith(_ANNOTATION):
            types = row if row[0].startswith("#datatype") else types
        elif _TIME in row:
            head = row
        elif head and any(row):
            yield head, types, row

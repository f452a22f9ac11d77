"""Numbers of a table, whose decimal mark and thousands separator are found by evidence and never guessed.

`1,016` is one thousand and sixteen, or one and a bit: a cell like it says nothing, while `0,5`, `1020.5`, `1.016,5` and
`1,234,567` do. Evidence counts in this order: what the user says, other cells of the column, other columns of the file,
and that a file whose columns are separated by commas has no decimal commas. Where none is left, the cell is named.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.tables.units import known_unit
from fantwin.schemas.messages import Array

NOT_MEASURED = {
    *("", "nan", "na", "n/a", "#n/a", "null", "none", "nil", "-", "--", "---", "undefined", "inf", "-inf"),
    *("unavailable", "unknown", "offline"),
}
_NUMBER = re.compile(
    r"([-+\u2212]?)\s*((?:\d[\d.,'\u2019 \u00a0\u202f\u2009]*)?\d[.,]?|[.,]\d+)((?:[eE][-+]?\d+)?)\s*(\D.*)?"
)
_GROUPED = re.compile(r"\d{1,3}(?:(?P<by>['\u2019 \u00a0\u202f\u2009])\d{3})(?:(?P=by)\d{3})*(?P<rest>[.,]\d*)?")
_AMBIGUOUS = re.compile(r"[1-9]\d{0,2}[.,]\d{3}")
_THOUSANDS = re.compile(r"[1-9]\d{0,2}(?:([.,])\d{3})(?:\1\d{3})*|[1-9]\d?(?:,\d{2})+,\d{3}")
_SEPARATORS = re.compile("['\u2019 \u00a0\u202f\u2009]")
_TEXTS_KEPT = 100
_OTHER = {".": ",", ",": "."}
_UNSURE = {".": "?.", ",": "?,"}


@dataclass(frozen=True)
class Cell:
    """A number as it is written.

    Attributes:
        sign, digits, exponent: its parts; of the digits, only `.` and `,` remain beside them.
        unit: behind it, as the table writes it.
        mark: `.` or `,`, its decimal mark; `?.` or `?,` where that is a decimal mark or separates thousands; empty
            where it has neither.
    """

    sign: str
    digits: str
    exponent: str
    unit: str
    mark: str

    def value(self, decimal: str) -> float:
        """The number, for cells that leave it open with this decimal mark."""
        decimal = self.mark if self.mark in _OTHER else decimal or "."
        plain = self.digits.replace(_OTHER[decimal], "").replace(decimal, ".")
        sign = "-" if self.sign in ("-", "\u2212") else ""
        return float(f"{sign}{plain}{self.exponent}")


def cell_of(text: str) -> Cell | None:
    """The number in a cell; None if it is none, such as text or two numbers."""
    found = _NUMBER.fullmatch(text.strip())
    if found is None:
        return None
    sign, digits, exponent, unit = found[1], found[2], found[3], (found[4] or "").strip()
    if unit and not known_unit(unit):
        return None
    if _SEPARATORS.search(digits):
        grouped = _GROUPED.fullmatch(digits)
        if grouped is None:
            return None
        mark = grouped["rest"][0] if grouped["rest"] else ""
        return Cell(sign, _SEPARATORS.sub("", digits), exponent, unit, mark)
    mark = _mark(digits, exponent)
    return None if mark is None else Cell(sign, digits, exponent, unit, mark)


def _mark(digits: str, exponent: str) -> str | None:
    points, commas = digits.count("."), digits.count(",")
    if not points and not commas:
        return ""
    if points and commas:
        decimal = "." if digits.rindex(".") > digits.rindex(",") else ","
        whole = digits[: digits.rindex(decimal)]
        return decimal if decimal not in whole and _THOUSANDS.fullmatch(whole) else None
    mark = "." if points else ","
    if points + commas > 1:
        return _OTHER[mark] if _THOUSANDS.fullmatch(digits) else None
    return _UNSURE[mark] if _AMBIGUOUS.fullmatch(digits) and not exponent else mark


def is_number(text: str) -> bool:
    """Whether a cell holds a number, perhaps with a unit."""
    try:
        float(text)
    except ValueError:
        return cell_of(text) is not None
    return True


@dataclass
class Marks:
    """Cells of a column that show its decimal mark, the first of each kind.

    Attributes:
        point, comma: one whose decimal mark that is.
        unsure: one that leaves it open.
        ungrouped: whether a number of four digits or more has no thousands separator.
        small: whether a whole number below 1000 has no mark, as where marks separate thousands. plain: whether any has
            none.
        unit: behind the numbers, as the table writes it.
    """

    point: str = ""
    comma: str = ""
    unsure: str = ""
    ungrouped: bool = False
    small: bool = False
    plain: bool = False
    unit: str = ""

    @classmethod
    def of(cls, cells: Iterable[str]) -> Marks:
        """The marks of some cells."""
        marks = cls()
        for text in cells:
            if (cell := cell_of(text)) is not None:
                marks.add(text, cell)
        return marks

    def add(self, text: str, cell: Cell) -> None:
        """Note what a cell shows."""
        self.unit = self.unit or cell.unit
        if cell.mark == ".":
            self.point = self.point or text
        elif cell.mark == ",":
            self.comma = self.comma or text
        elif cell.mark:
            self.unsure = self.unsure or text
        self.plain = self.plain or not cell.mark
        whole = re.split("[.,]", cell.digits)[0]
        self.ungrouped = self.ungrouped or (len(whole) > 3 and whole[0] != "0")
        self.small = self.small or (not cell.mark and len(whole) <= 3 and whole.strip("0") != "")

    @property
    def decimal(self) -> str:
        """The decimal mark that the column shows; empty: none, or both."""
        if bool(self.point) != bool(self.comma):
            return "." if self.point else ","
        if self.unsure and self.ungrouped and not self.point and "." in self.unsure:
            return "."
        return ""

    @property
    def is_doubtful(self) -> bool:
        """Whether marks may be of either kind between columns with commas: all have three digits behind them, and other
        numbers are below 1000 if marks are points, or there are none if they are commas."""
        is_open = self.small if "." in self.unsure else not self.plain
        return bool(self.unsure and is_open and not (self.point or self.comma or self.ungrouped))


def file_decimal(marks: Sequence[Marks], delimiter: str) -> str:
    """The decimal mark of a file by all its columns; empty: they do not show it, or differ."""
    if delimiter == ":":
        return "."
    shown = {found for each in marks if (found := each.decimal)}
    if len(shown) == 1:
        return shown.pop()
    doubtful = any(each.is_doubtful for each in marks)
    return "." if delimiter == "," and not shown and not doubtful else ""


class OtherMarkError(Exception):
    """A column whose later cells show another decimal mark than the one it was read with."""

    def __init__(self, name: str, decimal: str) -> None:
        super().__init__(name)
        self.name, self.decimal = name, decimal


class NumberColumn:
    """A column of float64, NaN where a cell is not a finite number."""

    def __init__(self, path: Path, name: str, index: int, decimal: str = ".", *, is_final: bool = False) -> None:
        """decimal: of cells that leave it open; empty: not known. is_final: the column was read before, with another
        one that its cells contradicted."""
        self._path, self.name, self._index = path, name, index
        self._decimal, self._is_final = decimal, is_final
        self._values = array("d")
        self._marks = Marks()
        self._in_part = 0
        self._has_plain = False
        """whether a number had no unit"""
        self._texts = array("q")
        """rows of cells with text"""
        self._first_texts: list[str] = []

    def add(self, rows: Sequence[Sequence[str]]) -> None:
        """Append the cells of some rows. Raises OtherMarkError."""
        index = self._index
        cells = [row[index] for row in rows]
        try:
            if self._decimal != "." or self._is_final:
                raise ValueError
            values = np.array([float(cell) if cell else math.nan for cell in cells])
            self._has_plain = self._has_plain or bool(np.isfinite(values).any())
        except ValueError:
            values = np.empty(len(cells))
            for self._in_part, cell in enumerate(cells):
                values[self._in_part] = self.number(cell)
        values[np.isinf(values)] = np.nan
        self._values.frombytes(values.tobytes())

    @property
    def problem(self) -> UserError | None:
        """Why its numbers cannot be used: a cell could mean two."""
        marks = self._marks
        if not marks.unsure or not ((marks.point and marks.comma) or not self._decimal):
            return None
        cell = cell_of(marks.unsure)
        assert cell is not None
        whole, part = cell.value(_OTHER[cell.mark[1]]), cell.value(cell.mark[1])
        other = f", and {marks.point!r} and {marks.comma!r} differ" if marks.point else ""
        return UserError(
            f"{self._path}: column {self.name!r}: {marks.unsure!r} is {whole:g} or {part:g}{other}: give the "
            f"decimal mark of the file, --decimal {cell.mark[1]} or --decimal {_OTHER[cell.mark[1]]}"
        )

    @property
    def values(self) -> Array:
        """The column."""
        return np.asarray(self._values)

    @property
    def unit(self) -> str:
        """The unit behind its numbers; empty if none was seen."""
        return known_unit(self._marks.unit)

    def texts(self, rows: Array) -> str:
        """What was in it and is no number, `3 cells with text, first 'n/a'`; empty: nothing. rows: (rows,) those that
        count."""
        at = np.asarray(self._texts)
        counted = rows[at] if len(at) else np.zeros(0, np.bool_)
        count = int(np.count_nonzero(counted))
        if not count:
            return ""
        first = int(np.argmax(counted))
        example = f", first {self._first_texts[first]!r} in row {int(at[first]) + 1}" if first < _TEXTS_KEPT else ""
        return f"{count} {'cell' if count == 1 else 'cells'} with text that is no number{example}"

    def number(self, text: str) -> float:
        """The number in a cell; NaN if there is none."""
        text = text.strip()
        if self._decimal == "." and not self._is_final:
            try:
                value = float(text)
            except ValueError:
                pass
            else:
                self._has_plain = self._has_plain or math.isfinite(value)
                return value
        if text.lower() in NOT_MEASURED:
            return math.nan
        cell = cell_of(text)
        is_first = not self._has_plain and not self._marks.unit
        if cell is None or (cell.unit and not is_first and cell.unit.lower() != self._marks.unit.lower()):
            self._texts.append(len(self._values) + self._in_part)
            if len(self._first_texts) < _TEXTS_KEPT:
                self._first_texts.append(text)
            return math.nan
        self._has_plain = self._has_plain or not cell.unit
        self._marks.add(text, cell)
        if cell.mark in _OTHER and cell.mark != self._decimal and not self._is_final:
            self._contradicted(cell.mark)
        return cell.value(self._decimal)

    def _contradicted(self, mark: str) -> None:
        """The column shows a mark of its own: the cells before are read again with it, if they left it open."""
        if self._decimal or self._marks.unsure:
            raise OtherMarkError(self.name, mark)
        self._decimal = mark

"""How a text file holds a table, found by evidence: its encoding, what separates its columns, where its names are.

Loggers write lines of their own before the names: `sep=;`, comments, keys with values, a second line of names, a line
of units. The rows are what repeats: the names are in the line above the first of them.
"""

from __future__ import annotations

import codecs
import csv
import io
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import islice, pairwise
from pathlib import Path

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.tables.dates import is_date_or_time
from fantwin.pipeline.sources.tables.json_rows import is_json, json_rows
from fantwin.pipeline.sources.tables.numbers import Marks, file_decimal, is_number
from fantwin.pipeline.sources.tables.units import is_unit, known_unit, unit_in_name

LONGEST_LINE = 1 << 20
"""characters"""
BLANKS = " "
"""as a delimiter: runs of blanks"""
JSON = ":"
"""delimiter of a file that is no text in columns, but JSON"""
_DELIMITERS = {",": "','", ";": "';'", "\t": "tabs", "|": "'|'", BLANKS: "blanks"}
"""that are looked for"""
_SAMPLE_BYTES = 1 << 18
_SAMPLE_LINES = 400
_LEAST_ALIKE = 0.6
"""share of the cells of a row that are of the kind that its column has; a row has more"""
_LONGEST_SENTENCE = 6
"""words of a cell; a longer one is a sentence, not a name"""
_RULER = re.compile(r"[-=+:|\s,;]*[-=][-=+:|\s,;]*")
_LABVIEW = re.compile(r"\*\*\*End_of_Header\*\*\*\s*X_Value")
"""end of a head and begin of the names"""
_LABVIEW_UNITS = "Y_Unit_Label\t"
_SEP_LINE = re.compile(r"\s*\"?sep=(.)\"?\s*", re.IGNORECASE)
_BOMS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
_ENCODINGS = {"utf-8": "UTF-8", "utf-8-sig": "UTF-8", "utf-16": "UTF-16", "utf-16-le": "UTF-16"}
_AS_WINDOWS = "as-windows-1252"


def _as_windows(error: UnicodeError) -> tuple[str, int]:
    """Bytes that are no UTF-8, as Windows-1252."""
    assert isinstance(error, UnicodeDecodeError)
    return error.object[error.start : error.end].decode("cp1252", "replace"), error.end


codecs.register_error(_AS_WINDOWS, _as_windows)


@dataclass(frozen=True)
class Heading:
    """A column as the first lines of a table show it.

    Attributes:
        index: of its cells in a row.
        name: once in a table: a second `Fan` is `Fan [2]`.
        second: its name in another line of names above; empty without one.
        unit: as its name or a line of units says; empty if neither does.
        kind: `number`, `time`, `text`, or empty where the sample has no cell.
        decimal: the mark of its numbers: what they show, else those of the file; empty: neither does.
        cells: of the sample, those that are filled.
    """

    index: int
    name: str
    second: str = ""
    unit: str = ""
    kind: str = ""
    decimal: str = ""
    cells: tuple[str, ...] = ()


@dataclass(frozen=True)
class Layout:
    """Where the names and the rows of a table are.

    Attributes:
        encoding: as Python calls it; bytes that are no UTF-8 are Windows-1252.
        title: of the encoding, for people.
        head: the line of the names, counted from 1; 0: there is none.
        first_row: the line of the first row.
        written: the names as they are in the file.
        about: keys and values in the lines before the names, such as `debug_mode`.
    """

    path: Path
    encoding: str
    title: str
    delimiter: str
    head: int
    first_row: int
    columns: tuple[Heading, ...]
    written: tuple[str, ...]
    about: Mapping[str, str]

    @cached_property
    def names(self) -> list[str]:
        """The names of the columns."""
        return [each.name for each in self.columns]

    @cached_property
    def all_names(self) -> list[str]:
        """What columns can be called: names, then second names."""
        return list(filter(None, dict.fromkeys((*self.names, *(each.second for each in self.columns)))))

    def column(self, name: str) -> Heading:
        """The column of a name or a second name."""
        either = (self.names if name in self.names else [each.second for each in self.columns]).index(name)
        return self.columns[either]

    @property
    def in_words(self) -> str:
        """Words for people: encoding, delimiter, and where the names are."""
        if self.delimiter == JSON:
            return f"JSON, a row an object, {len(self.columns)} keys"
        where = f"names in line {self.head}" if self.head else "no line of names"
        return f"{self.title}, columns separated by {_DELIMITERS.get(self.delimiter, repr(self.delimiter))}, {where}"


def find_layout(path: Path) -> Layout:
    """The layout of a table.

    Raises:
        UserError: it cannot be read, or is no text file.
    """
    with path.open("rb") as file:
        start = file.read(_SAMPLE_BYTES)
    encoding = _encoding(path, start)
    text = codecs.getincrementaldecoder(encoding)(_AS_WINDOWS).decode(start)
    if is_json(text):
        return _layout(path, encoding, "", JSON, list(enumerate(islice(json_rows(path), _SAMPLE_LINES), 1)))
    lines = list(islice(io.StringIO(text, newline=""), _SAMPLE_LINES))
    if len(start) == _SAMPLE_BYTES and len(lines) > 1 and not lines[-1].endswith("\n"):
        lines.pop()  # cut by the end of the sample
    title = _ENCODINGS[encoding]
    if encoding == "utf-8" and not _is_utf_8(start):
        title = (
            "Windows-1252" if lines[0].isascii() or not _is_utf_8(start.split(b"\n")[0]) else "UTF-8 and other bytes"
        )
    separator = _SEP_LINE.fullmatch(lines[0]) if lines else None
    ends = (k + 1 for k, both in enumerate(pairwise(lines)) if _LABVIEW.match("".join(both)))
    skipped = next(ends, int(separator is not None))
    if not "".join(lines[skipped:]).strip():
        raise UserError(f"{path}: a line must name the columns, but the file is empty")
    delimiter = separator[1] if separator else _delimiter(path, lines[skipped:])
    rows = enumerate(_split(path, lines[skipped:], delimiter), 1 + skipped)
    stripped = [(number, [cell.strip() for cell in row]) for number, row in rows]
    layout = _layout(path, encoding, title, delimiter, [(number, row) for number, row in stripped if any(row)])
    units = next((line.split("\t") for line in lines[:skipped] if line.startswith(_LABVIEW_UNITS)), [])
    units += [""] * len(layout.columns)
    columns = [
        replace(each, unit=each.unit or known_unit(unit)) for each, unit in zip(layout.columns, units, strict=False)
    ]
    return replace(layout, columns=tuple(columns))


def all_rows_of(layout: Layout) -> Iterator[list[str]]:
    """All rows of the file, those before the names, too. Raises UserError."""
    if layout.delimiter == JSON:
        yield from json_rows(layout.path)
        return
    with layout.path.open(encoding=layout.encoding, errors=_AS_WINDOWS, newline="") as file:
        yield from _split(layout.path, _lines(layout.path, file), layout.delimiter)


def _lines(path: Path, file: io.TextIOWrapper) -> Iterator[str]:
    while line := file.readline(LONGEST_LINE):
        if len(line) == LONGEST_LINE:
            raise UserError(f"{path}: not a text file with columns: a line is longer than {LONGEST_LINE:,} characters")
        yield line


def _split(path: Path, lines: Iterable[str], delimiter: str) -> Iterator[list[str]]:
    if delimiter == BLANKS:
        lines = (line.strip().replace("\t", " ") for line in lines)
    try:
        yield from csv.reader(lines, delimiter=delimiter, skipinitialspace=True)
    except csv.Error as error:
        raise UserError(f"{path}: not a text file with columns: {error}") from error


def _encoding(path: Path, start: bytes) -> str:
    found = next((encoding for bom, encoding in _BOMS.items() if start.startswith(bom)), "")
    if not found and b"\0" in start:
        if start[1::2].count(0) < 0.4 * len(start) or start[0::2].count(0):
            raise UserError(f"{path}: not a text file with columns, a ULog or a ROS bag; export it as CSV")
        return "utf-16-le"
    return found or "utf-8"


def _is_utf_8(start: bytes) -> bool:
    try:
        codecs.getincrementaldecoder("utf-8")().decode(start)
    except UnicodeDecodeError:
        return False
    return True


def _delimiter(path: Path, lines: Sequence[str]) -> str:
    """The delimiter that gives the most lines one width, with cells that are numbers, dates or short words."""
    filled = [line for line in lines if line.strip() and not _RULER.fullmatch(line.strip())]
    scores = {each: _score(path, filled, each) for each in _DELIMITERS}
    best = max(scores, key=lambda each: scores[each])
    return best if scores[best] > 0 else ","


def _score(path: Path, lines: Sequence[str], delimiter: str) -> float:
    try:
        rows = [row for row in _split(path, lines, delimiter) if row]
    except UserError:
        return 0.0
    last = rows[len(rows) // 3 :]
    if not last:
        return 0.0
    width, count = Counter(map(len, last)).most_common(1)[0]
    if width < 2:
        return 0.0
    cells = [cell.strip() for row in last if len(row) == width for cell in row]
    plain = sum(_kind(cell) in ("number", "time", "") for cell in cells) / len(cells)
    if delimiter == BLANKS:
        plain *= 0.5  # blanks stand within dates and names, too
    return (count / len(last)) * (0.1 + plain)


def _kind(cell: str) -> str:
    if not cell:
        return ""
    if is_number(cell):
        return "number"
    return "time" if is_date_or_time(cell) else "text"


def _layout(path: Path, encoding: str, title: str, delimiter: str, lines: Sequence[tuple[int, list[str]]]) -> Layout:
    usual = [row for _, row in lines[len(lines) // 2 :]]
    width = Counter(map(len, usual)).most_common(1)[0][0] if usual else 0
    alike = [[_kind(cell) for cell in row] for row in usual if len(row) == width]
    kinds = [_most_common(column) for column in zip(*alike, strict=True)]
    first = next((k for k, (_, row) in enumerate(lines) if _is_row(row, kinds)), len(lines))
    first = _first_below_names(lines, first, kinds) if delimiter != JSON else 1
    if not any(kind in ("number", "time") for kind in kinds):
        first = next((k for k, (_, row) in enumerate(lines) if len(row) == width), 0) + 1
    above = [(number, row) for number, row in lines[:first] if not _is_ruler(list(filter(None, row)))]
    head, written, second, units, about = _head(above, width)
    written = written or [f"column {k + 1}" for k in range(width)]
    if delimiter == BLANKS and len(written) == width - 1 and kinds[:2] == ["time", "time"]:
        written = ["Date", *written]  # the blank within a date
    if not written:
        raise UserError(f"{path}: not a text file with columns; export it as CSV")
    cells = [tuple(row[k] for _, row in lines[first:] if k < len(row) and row[k]) for k in range(len(written))]
    marks = [Marks.of(each) for each in cells]
    decimal = file_decimal(marks, delimiter)
    names = _each_once([" ".join(name.split()) for name in written])
    columns = [
        Heading(
            index=k,
            name=name,
            second=second[k] if len(second) == len(names) else "",
            unit=(units[k] if k < len(units) else "") or unit_in_name(written[k]),
            kind=kinds[k] if k < len(kinds) else "",
            decimal=marks[k].decimal or ("" if marks[k].point and marks[k].comma else decimal),
            cells=cells[k],
        )
        for k, name in enumerate(names)
    ]
    first_row = lines[first][0] if first < len(lines) else (lines[-1][0] + 1 if lines else 1)
    return Layout(path, encoding, title, delimiter, head, first_row, tuple(columns), tuple(written), about)


def _head(
    above: Sequence[tuple[int, list[str]]], width: int
) -> tuple[int, list[str], list[str], list[str], dict[str, str]]:
    """Line of the names, names, second names, units, and what the lines before say."""
    rest = list(above)
    units: list[str] = []
    if len(rest) > 1 and _are_units(rest[-1][1]) and len(rest[-2][1]) > 1:
        units = [cell.strip("[]() ") for cell in rest.pop()[1]]
    if not rest:
        return 0, [], [], units, {}
    as_wide = [k for k, (_, row) in enumerate(rest) if width <= len(row) <= width + 1]
    rest = rest[: as_wide[-1] + 1] if as_wide else rest  # what is between the names and the rows is narrower
    head, cells = rest.pop()
    if len(cells) > width and not cells[0].strip("# \t"):
        cells = cells[1:]  # the mark of a comment
    names = [cell.strip("# \t") for cell in cells]
    second: list[str] = []
    if rest and len(rest[-1][1]) == len(names) and not rest[-1][1][0].startswith("#"):
        # a second line of names, and no key with its value
        above_names = rest[-1][1]
        if width > 2 and sum(map(bool, above_names)) > len(names) / 2:
            second = above_names
            filled = list(filter(None, second))
            if len(set(filled)) < len(names) - 1:  # names of groups of columns
                names = [f"{top} {name}".strip() for top, name in zip(_held(second), names, strict=True)]
    about = {row[0].strip("# \t"): row[1] for _, row in rest if len(row) >= 2 and row[0]}
    return head, names, second, units, about


def _first_below_names(lines: Sequence[tuple[int, list[str]]], first: int, kinds: Sequence[str]) -> int:
    """The first row, which may have a text where others have numbers: those under a line of texts that are as wide, and
    alike the others in some cell."""
    rows = [row for _, row in lines[:first]]
    alike = [any(_kind(cell) == kind != "text" for cell, kind in zip(row, kinds, strict=False) if kind) for row in rows]
    below = next((k + 1 for k in reversed(range(first)) if not alike[k]), 0)
    is_named = 0 < below < first and len(rows[below - 1]) == len(kinds) and all(rows[below - 1])
    return below if is_named and all(len(row) == len(kinds) for row in rows[below:]) else first


def _is_ruler(filled: Sequence[str]) -> bool:
    """Whether a line is one, or the title of a section between two."""
    is_title = len(filled) > 1 and all(len(each) > 1 for each in (filled[0], filled[-1]))
    return all(map(_RULER.fullmatch, (filled[0], filled[-1]) if is_title else filled))


def _are_units(cells: Sequence[str]) -> bool:
    """Whether most cells of a line are units: programs have some of their own."""
    filled = list(filter(None, cells))
    return 2 * sum(map(is_unit, filled)) > len(filled)


def _held(cells: Sequence[str]) -> list[str]:
    """Each cell, or the last one before it: groups of columns have their name over the first."""
    held: list[str] = []
    for cell in cells:
        held.append(cell or (held[-1] if held else ""))
    return held


def _is_row(row: Sequence[str], kinds: Sequence[str]) -> bool:
    """Whether a line is alike what repeats: its cells are of the kinds that the columns have."""
    pairs = [(_kind(cell), kind) for cell, kind in zip(row, kinds, strict=False) if kind in ("number", "time")]
    alike = sum(cell in (kind, "") for cell, kind in pairs)
    is_filled = any(cell == kind for cell, kind in pairs)
    wanted = sum(kind in ("number", "time") for kind in kinds)
    return is_filled and alike > _LEAST_ALIKE * wanted


def _most_common(kinds: Sequence[str]) -> str:
    filled = Counter(filter(None, kinds))
    return filled.most_common(1)[0][0] if filled else ""


def _each_once(names: Sequence[str]) -> list[str]:
    """Names, numbered where they repeat."""
    seen: Counter[str] = Counter()
    found: list[str] = []
    for name in names:
        seen[name] += 1
        found.append(name if seen[name] == 1 or not name else f"{name} [{seen[name]}]")
    return found

"""The rows of a table below its names, each at least as wide as they are."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.tables.layout import Layout, all_rows_of
from fantwin.pipeline.sources.tables.numbers import is_number


@dataclass
class OddRows:
    """Rows with another number of cells than the table has columns.

    Attributes:
        rows: of any number.
        wider: what is beyond the last name of each; they may be shifted, and are left out.
        shorter: those whose last cells are missing; without names they may be shifted, too, and are left out.
        first_shorter: the first of them.
    """

    rows: int = 0
    wider: list[str] = field(default_factory=list[str])
    shorter: int = 0
    first_shorter: str = ""

    def in_words(self, layout: Layout) -> list[str]:
        """A line for each kind that was seen; columns that most rows lack are none."""
        columns = f"the {len(layout.columns)} {'names' if layout.head else 'columns'}"
        found = (
            [f"{len(self.wider)} rows left out: more cells than {columns}, first {self.wider[0]!r}"]
            if self.wider
            else []
        )
        if self.shorter and not layout.head:
            found.append(f"{self.shorter} rows left out: fewer cells than {columns}, first {self.first_shorter!r}")
        elif 0 < 2 * self.shorter < self.rows:
            found.append(f"{self.shorter} rows with fewer cells than {columns}: the others are taken as missing")
        return found


def rows_of(layout: Layout, odd: OddRows | None = None) -> Iterator[list[str]]:
    """The rows of a table, without those that are empty or repeat its names, each at least as wide as its names.

    odd: gets those of another width.

    Raises:
        UserError: it cannot be read, names other columns further down, or most rows have more cells than names.
    """
    odd = odd or OddRows()
    width, names, first = len(layout.columns), list(layout.written), layout.written[0]
    named = max((k + 1 for k, name in enumerate(names) if name), default=0)
    for row in islice(all_rows_of(layout), layout.first_row - 1, None):
        is_short = any(row) and len(row) < named
        if is_short:
            odd.shorter += 1
            odd.first_shorter = odd.first_shorter or layout.delimiter.join(row)
        row.extend([""] * (width - len(row)))
        if len(row) > width and any(row[width:]):
            odd.wider.append(",".join(row[width:]))
        elif first and row[0] == first and not any(map(is_number, row)):
            _require_same_names(layout, names, row)
        elif any(row) and (layout.head or not is_short):
            odd.rows += 1
            yield row
    if len(odd.wider) > odd.rows:
        raise UserError(
            f"{layout.path}: rows have more cells than the {width} names of line {layout.head}: if numbers have "
            "decimal commas, export the table with another delimiter, such as ;"
        )


def _require_same_names(layout: Layout, names: Sequence[str], row: Sequence[str]) -> None:
    """Raise UserError where a line of names within the rows names other columns."""
    again = [cell.strip("# \t") for cell in row]
    while len(again) > len(names) and not again[-1]:
        again.pop()
    if again != list(names):
        other = next((name for name in again if name not in names), "none")
        raise UserError(
            f"{layout.path}: the columns change in a further line of names, which has {other!r}: cut the file there "
            "and import the parts"
        )

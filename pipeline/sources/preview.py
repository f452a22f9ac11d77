"""What a table or a log was understood to be, before anything is written: `fantwin import --preview` shows it."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from fantwin.pipeline.sources.column_file import Column
from fantwin.pipeline.sources.tables.units import SPEED_UNITS, unit_in_name


@dataclass(frozen=True)
class PreviewColumn:
    """A column of a file.

    Attributes:
        name: as `--command` and `--speed` take it.
        values: numbers in it.
        lowest, highest: of them; None without one.
        unit: as the file has it; empty if it does not say.
        rate_hz: values a second.
        note: what else is in it, such as `3 cells with text, first 'n/a'`, or what it is called beside its name.
    """

    name: str
    values: int
    lowest: float | None
    highest: float | None
    unit: str
    rate_hz: float
    note: str

    @classmethod
    def of(cls, name: str, column: Column, label: str) -> PreviewColumn:
        """A column by its numbers."""
        known = column.values[np.isfinite(column.values)]
        lowest, highest = (float(known.min()), float(known.max())) if len(known) else (None, None)
        unit = column.unit or unit_in_name(name)
        return cls(name, len(known), lowest, highest, unit, column.rate_hz, column.note or label)

    def line(self, width: int) -> str:
        """The column for people, with its name in this width."""
        span = "no numbers" if self.lowest is None else f"{self.lowest:10.6g} to {self.highest:.6g}"
        rate = f"  {self.rate_hz:8.3g} Hz" if self.rate_hz else ""
        ends = " ".join(filter(None, (span, self.unit)))
        return f"{self.name:{width}}  {self.values:7d} values{rate}  {ends}{f'  {self.note}' if self.note else ''}"


@dataclass(frozen=True)
class ProposedFan:
    """Columns that are a fan."""

    label: str
    command: str
    speed: str


@dataclass(frozen=True)
class Preview:
    """What was understood of a file.

    Attributes:
        understood: a line each: the format, and the times.
        options: of `fantwin import`, beside the file and `-o`, that import it; empty: they are not known.
        notes: what will be left out, or has to be said by the user, a line each.
        can_import: whether it has columns of numbers, and times.
    """

    path: Path
    understood: tuple[str, ...]
    columns: tuple[PreviewColumn, ...]
    fans: tuple[ProposedFan, ...] = ()
    options: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    can_import: bool = True

    @property
    def command_line(self) -> str:
        """The command line of an import, with placeholders where its columns are not known; empty: none can be."""
        if not self.can_import:
            return ""
        unit = "" if any(each.unit in SPEED_UNITS for each in self.columns) else ":UNIT"
        known = [shlex.quote(word) for word in self.options] or ["--command", "COLUMN", "--speed", f"COLUMN{unit}"]
        return " ".join(["fantwin", "import", shlex.quote(str(self.path)), *known, "-o", "REC.mcap"])

    @property
    def as_json(self) -> Mapping[str, object]:
        """The preview for machines."""
        return asdict(self) | {"path": str(self.path), "command_line": self.command_line}

    @property
    def lines(self) -> list[str]:
        """The preview for people."""
        width = max((len(each.name) for each in self.columns), default=0)
        return [
            f"{self.path}: {self.understood[0]}",
            *(f"  {line}" for line in self.understood[1:]),
            *(each.line(width) for each in self.columns),
            *(f"  {each.label}: command {each.command}, speed {each.speed}" for each in self.fans),
            *(f"  {note}" for note in self.notes),
            f"to import it: {self.command_line or 'nothing as it is, without two columns of numbers and their times'}",
        ]

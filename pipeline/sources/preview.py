"""What a table or a log was understood to be, before anything is written: `fantwin import --preview` shows it."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fantwin.pipeline.sources.column_file import Column
from fantwin.pipeline.sources.tables.units import unit_in_name


@dataclass(frozen=True)
class PreviewColumn:
    """A column of a table, or a field of a log.

    Attributes:
        name: as `--command` and `--speed` take it.
        values: numbers in it.
        lowest, highest: of them; None without one.
        unit: as the file has it; empty if it does not say.
        rate_hz: values a second, where a field has times of its own; else 0.
        note: what else is in it, such as `3 cells with text, first 'n/a'`.
    """

    name: str
    values: int
    lowest: float | None
    highest: float | None
    unit: str = ""
    rate_hz: float = 0.0
    note: str = ""


@dataclass(frozen=True)
class ProposedFan:
    """Columns that are a fan, by what is known of files of this kind. speed: with its unit, as `--speed` takes it."""

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
    """

    path: Path
    understood: tuple[str, ...]
    columns: tuple[PreviewColumn, ...]
    fans: tuple[ProposedFan, ...] = ()
    options: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def command_line(self) -> str:
        """The command line that imports the file; with placeholders where its columns are not known."""
        known = [shlex.quote(word) for word in self.options] or ["--command", "COLUMN", "--speed", "COLUMN:rpm"]
        return " ".join(["fantwin", "import", shlex.quote(str(self.path)), *known, "-o", "REC.mcap"])


def column_of(name: str, column: Column, label: str) -> PreviewColumn:
    """A column by its numbers, with what it is called beside its name."""
    known = column.values[np.isfinite(column.values)]
    lowest, highest = (float(known.min()), float(known.max())) if len(known) else (None, None)
    unit = column.unit or unit_in_name(name)
    return PreviewColumn(name, len(known), lowest, highest, unit, column.rate_hz, column.note or label)

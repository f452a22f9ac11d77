"""60 rows of one fan, in any form that a table may have: a head, and a row as a format of its values."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fantwin.schemas.messages import Array
from tests.support.fantwin_command import fantwin
from tests.support.written_recordings import raw_columns

RPM = 2 * np.pi / 60
N = 60
COMMAND = np.repeat([40, 80, 30], 20)
SPEED = np.repeat([1020, 1744, 840], 20) + np.arange(N) % 5
SECONDS = np.arange(N)
START = datetime(2026, 6, 9, 21, 59, 50, tzinfo=UTC)
EPOCH_S = START.timestamp() + SECONDS
COLUMNS = ("--command", "pwm1", "--speed", "fan1:rpm")


class Table(NamedTuple):
    """A table of the fan, and what must come of it.

    Attributes:
        head: its lines before the rows, or all of it.
        row: format of a row: t its time in s, ms with commas between thousands, d its date, epoch since 1970, s its
            speed in rpm, half of it, c its command; commas, dots, blanks, narrow, quotes: the speed with these between
            thousands.
        options: of the import.
        start, every_s: date of the first row, and from row to row.
        t_s: times; None: those of the dates, or t.
        notes: that are said.
        other: row 30, where it is damaged.
        kept: the rows that are read.
    """

    head: str
    row: str = ""
    options: tuple[str, ...] = COLUMNS
    notes: tuple[str, ...] = ()
    t_s: Array | None = None
    start: datetime = START
    every_s: float = 1.0
    other: str | None = None
    kept: Array = SECONDS
    after: str = ""
    encoding: str = "utf-8"

    @property
    def content(self) -> bytes:
        """The file."""
        lines = [self.head] if self.head else []
        for t, (s, c) in enumerate(zip(SPEED.tolist(), COMMAND.tolist(), strict=True)):
            d = self.start + timedelta(seconds=self.every_s * t)
            marks = {"commas": ",", "dots": ".", "blanks": " ", "narrow": "\u202f", "quotes": "’"}
            grouped = {name: f"{s:,}".replace(",", mark) for name, mark in marks.items()}
            row = self.other if t == 30 and self.other is not None else self.row
            values = {
                "t": t,
                "ms": f"{1000 * t:,}",
                "d": d,
                "epoch": int(d.timestamp()),
                "s": s,
                "half": s // 2,
                "c": c,
            }
            lines += [row.format(**values, **grouped)] if row else []
        return ("\n".join([*lines, self.after]) + "\n").encode(self.encoding)

    @property
    def expected_s(self) -> Array:
        """Times of the rows."""
        if self.t_s is not None:
            return self.t_s
        is_dated = any(each in self.row for each in ("{d:", "{d.", "{epoch"))
        return (self.start.timestamp() if is_dated else 0.0) + self.every_s * SECONDS


def require_imported(table: Table, folder: Path) -> None:
    """Import a table, and compare all that is recorded of its fan."""
    path, recording = folder / "table.csv", folder / "r.mcap"
    path.write_bytes(table.content)
    result = fantwin("import", path, *table.options, "-o", recording)
    assert result.exit_code == 0, result.output
    t_ns, command, speed_rad_s = raw_columns(recording)
    np.testing.assert_allclose(t_ns / 1e9, table.expected_s[table.kept], rtol=0, atol=1e-6)
    np.testing.assert_array_equal(command[:, 0], COMMAND[table.kept])
    known = np.isfinite(speed_rad_s[:, 0])
    assert known.sum() == N - (table.other is not None)
    np.testing.assert_allclose(speed_rad_s[known, 0] / RPM, SPEED[table.kept][known], rtol=1e-9)
    for note in table.notes:
        assert note in result.stdout
    assert "speeds in rad/s assumed" not in result.stdout

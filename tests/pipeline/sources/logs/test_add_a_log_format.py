"""The recipe of docs/architecture.md: a format of logs is one file with its reader and one row in a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.recordings.training_runs import read_runs
from fantwin.pipeline.sources.column_file import Column, ColumnFile
from fantwin.pipeline.sources.logs import formats
from fantwin.pipeline.sources.logs.formats import LogFormat
from fantwin.schemas.units import NS_PER_S
from tests.support.fantwin_command import fantwin

START = b"TOY LOG\n"


class ToyLog(ColumnFile):
    """A log of lines with a time in s, a duty and a speed in rpm."""

    names = ("duty", "rpm")

    def __init__(self, path: Path) -> None:
        rows = np.loadtxt(path, skiprows=1)
        t_ns = np.rint(rows[:, 0] * NS_PER_S).astype(np.int64)
        self._fields = {name: Column(t_ns, rows[:, 1 + k]) for k, name in enumerate(self.names)}

    def read(self, names: Sequence[str]) -> Mapping[str, Column]:
        return {name: self._fields[name] for name in names}


def test_a_format_with_a_row_is_recognised_listed_and_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    row = LogFormat("toy log", (START,), "", "numpy", f"{__name__}:ToyLog")
    monkeypatch.setattr(formats, "LOG_FORMATS", (*formats.LOG_FORMATS, row))
    log, recording = tmp_path / "fan.toy", tmp_path / "fan.mcap"
    lines = [f"{0.1 * k:.1f} {0.5 + 0.01 * (k % 7):.2f} {600 + k}" for k in range(50)]
    log.write_bytes(START + "\n".join(lines).encode())

    listed = fantwin("import", log, "--preview")
    assert "duty" in listed.stdout and "toy log, 2 fields" in listed.stdout
    words = ("--command", "duty", "--speed", "rpm:rpm", "-o", recording)
    imported = fantwin("import", log, *words)
    assert imported.exit_code == 0, imported.output
    (run,) = read_runs(recording).runs
    assert run.speed_rad_s[:, 0] == pytest.approx((600 + np.arange(50)) * 2 * np.pi / 60)

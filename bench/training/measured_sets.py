"""Real measured sets (docs/how-to/datasets.md) as runs to learn from and runs held out.

Each file goes the user's way: `fantwin import` into a recording, which is read as the model maker reads it. Nothing is
resampled or cleaned on the way. What is held out is chosen as an engineer would with these data in hand: whole runs
where there are several, otherwise parts of time at levels that the rest covers. Two more splits hold out a range that
training never sees, because that is what goes wrong in practice.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pandas as pd
from scipy.io import loadmat

from fantwin.pipeline.learning.training_data import Part, read_training_data
from fantwin.pipeline.recordings.raw_recordings import write_table
from fantwin.pipeline.replay.offline.healthy_runs import in_this_process
from fantwin.pipeline.sources.imported_file import read_file
from fantwin.pipeline.sources.tables.units import RAD_S_PER_TABLE_UNIT
from fantwin.pipeline.sources.wanted import Wanted
from fantwin.twin.runs import Run

FOLDER = Path(os.environ.get("FANTWIN_DATA", Path(__file__).parents[3] / "shared" / "data"))


@dataclass(frozen=True, eq=False)
class Split:
    """Runs of one set, parted. unit: of the speeds of the set."""

    name: str
    how: str
    training: list[Run]
    held_out: list[Run]
    unit: str
    covered: bool = True
    """whether training covers the levels held out"""

    @property
    def rad_s_per_unit(self) -> float:
        """One of the unit in rad/s."""
        return RAD_S_PER_TABLE_UNIT[self.unit]


def splits() -> list[Split]:
    """All splits of all sets. Ends the program with one line where a file is missing."""
    with tempfile.TemporaryDirectory() as folder:
        return [split for load in (_esc_test, _imrclab, _rosa, _undcmotor, _cigan_bldc) for split in load(Path(folder))]


def esc_test() -> list[Run]:
    """The run of esc_test with the duty as its command."""
    with tempfile.TemporaryDirectory() as folder:
        return _esc_test_runs(Path(folder), "Duty")


def _esc_test_runs(folder: Path, command: str) -> list[Run]:
    return _imported(_file("esc_test/f40_steps_5-2.csv"), folder, "Timestamp", None, [command], ["RPM:rpm"])


def _esc_test(folder: Path) -> list[Split]:
    made = []
    for name, command in (("duty", "Duty"), ("motor volts", "Motor Volts")):
        runs = _esc_test_runs(folder, command)
        # Two stairs up and the largest step down; the rest climbs to the same top and steps down to half of that.
        made.append(
            _by_time(
                f"esc_test ({name})", "35 s to 52 s and 100.5 s to 104.4 s", runs, "rpm", ((35, 52), (100.5, 104.4))
            )
        )
        if name == "duty":
            made.append(_by_time(f"esc_test ({name})", "from 90 s: higher stairs", runs, "rpm", ((90, 999),), False))
    return made


def _imrclab(folder: Path) -> list[Split]:
    measured = pd.read_csv(_file("imrclab/cf21_stock2.csv"))
    # The bridge gives a share of a battery that sags by a tenth under load.
    measured["volts"] = measured["pwm"] / 65535 * measured["vbat[V]"]
    table = folder / "imrclab.csv"
    measured.to_csv(table, index=False)
    made = []
    for name, command in (("pwm", "pwm"), ("pwm x battery", "volts")):
        runs = _imported(table, folder, None, "10ms", [command], [f"rpm{k}:rpm" for k in (1, 2, 3, 4)])
        made.append(_by_time(f"imrclab ({name})", "the way up, to 7 s", runs, "rpm", ((0, 7),)))
        if name != "pwm":
            made.append(_by_time(f"imrclab ({name})", "from 12 s: lower stairs", runs, "rpm", ((12, 99),), False))
    return made


def _rosa(folder: Path) -> list[Split]:
    def runs(*numbers: int) -> list[Run]:
        columns = ("Time:ms", None, ["Shaft Control Effort"], ["Actual Speed:rpm"])
        return [
            run
            for k in numbers
            for run in _imported(_file(f"rosa/healthy_{k}.csv"), folder, *columns, name=f"rosa {k}")
        ]

    return [Split("rosa", "runs 103, 113, 120", runs(44, 98, 105, 110, 118), runs(103, 113, 120), "rpm")]


def _undcmotor(folder: Path) -> list[Split]:
    runs = _imported(_file("undcmotor/DCmotor_prbs_open_exp.csv"), folder, "t", None, ["u"], ["y:deg/s"])
    return [_by_time("undcmotor", "from 60 s", runs, "deg/s", ((60, 999),))]


def _cigan_bldc(folder: Path) -> list[Split]:
    captured = loadmat(_file("cigan_bldc/dataset.mat"), squeeze_me=True, struct_as_record=False)["cigan"]
    table = folder / "cigan_bldc.csv"
    # Y holds position, speed and command; the time's float step is rounded to whole microseconds by the import.
    columns = {"t": captured.X.Data, "speed": captured.Y[1].Data, "command": captured.Y[2].Data}
    pd.DataFrame(columns).to_csv(table, index=False)
    runs = _imported(table, folder, "t", None, ["command"], ["speed:rad/s"])
    return [_by_time("cigan_bldc", "from 4.9 s", runs, "rad/s", ((4.9, 99),))]


def _file(name: str) -> Path:
    path = FOLDER / name
    if not path.is_file():
        raise SystemExit(
            f"{path}: not there; set FANTWIN_DATA to the folder of measured sets (docs/how-to/datasets.md)"
        )
    return path


def _imported(
    table: Path,
    folder: Path,
    time: str | None,
    period: str | None,
    command: Sequence[str],
    speed: Sequence[str],
    name: str | None = None,
) -> list[Run]:
    recording = folder / f"{name or table.stem}.mcap"
    write_table(read_file(table, Wanted(command, speed, time, period)), recording, "tray1")
    return read_training_data([recording], Part(), in_this_process).runs


def _by_time(
    name: str,
    how: str,
    runs: Sequence[Run],
    unit: str,
    held_out_s: Sequence[tuple[float, float]],
    covered: bool = True,
) -> Split:
    """Hold out parts of time; what lies between and around them is for training."""
    edges = [-math.inf, *(edge for part in held_out_s for edge in part), math.inf]
    parts = [_between(runs, first, last) for first, last in pairwise(edges)]
    training = [run for part in parts[::2] for run in part]
    held_out = [run for part in parts[1::2] for run in part]
    return Split(name, how, training, held_out, unit, covered)


def _between(runs: Sequence[Run], first_s: float, last_s: float) -> list[Run]:
    parts = []
    for run in runs:
        if first_s < run.t_s[-1] and last_s > run.t_s[0]:
            parts.append(run.between(first_s, last_s))
    return parts

"""Wrong readings of healthy racks: how many alarms the scorer makes of them, and how many of these blame the tacho.

Boards give twice, half or an impossible speed, or 0 rpm (users report all four): for one reading, for two in a row, for
more while a command changes, or for the first one after a start. Racks learn as in `bench.detection.run --only rack`,
from fifteen minutes without wrong readings. Then readings of the test without faults are replaced. Every alarm is
false, but that where many readings are wrong, one that blames the tacho is right.

Example: python -m bench.detection.wrong_readings --keep /tmp/racks --racks 2 --report-hz 10
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

sys.path.insert(0, str(Path(__file__).parents[2]))

from bench.detection.plant import START_NS
from bench.detection.rack_limits import reports_of
from bench.detection.rack_recordings import HEALTHY, METADATA, PRODUCER, SITE, TRAY, RackData
from bench.detection.rack_scoring import DECLARED_PER_DAY, Episode, judged, twin_of
from bench.printing import JsonOption, progress, show
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.blocks import select
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Array, Raw
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import NS_PER_S

LEARNING, TEST_S = "15 minutes", 6 * 3600.0
RATES_HZ = (1.0, 2.0, 10.0, 100.0)
IMPOSSIBLE_RAD_S = 2772.0
"""26,470 rpm, as a board has shown"""
KINDS = ("half", "twice", "zero", "impossible")
IN_A_ROW, CHANGING, FIRST = "two in a row", "while the command changes", "the first"
"""when a reading is wrong, of any kind"""
CHANGE, CHANGE_S = 0.05, 2.0
"""a command changes while it differs so much from what it was before this time"""
PIECES = 12
"""parts of the time, each scored by itself, of which the first reading is wrong"""


@dataclass(frozen=True)
class Wrong:
    """Which readings are replaced. one_in: so many, on average; not of FIRST."""

    case: str
    one_in: float
    rate_hz: float

    def replaced(self, raw: Raw, rng: np.random.Generator, *, is_start: bool) -> Array:
        """(n, fans) the speeds of some reports. is_start: they are the first ones."""
        speed = raw.speed_rad_s
        chosen = rng.random(speed.shape) * self.one_in < 1.0
        kind = rng.integers(len(KINDS), size=speed.shape)
        if self.case in KINDS:
            kind[:] = KINDS.index(self.case)
        elif self.case == IN_A_ROW:
            chosen[1:] |= chosen[:-1]
            kind = np.resize(kind[0], speed.shape)
        elif self.case == CHANGING:
            before = np.maximum(np.arange(len(speed)) - round(CHANGE_S * self.rate_hz), 0)
            chosen &= np.abs(raw.command - raw.command[before]) > CHANGE
        elif self.case == FIRST:
            chosen[:] = False
            chosen[0] = is_start
        values = np.stack((0.5 * speed, 2.0 * speed, 0.0 * speed, 0.0 * speed + IMPOSSIBLE_RAD_S))
        wrong = np.take_along_axis(values, kind[np.newaxis], axis=0)[0]  # none where there is no reading
        return np.where(chosen, wrong, speed)


def main(
    racks: Annotated[int, typer.Option(help="Simulated racks of four fans.")] = 2,
    report_hz: Annotated[
        list[float] | None, typer.Option(help="Reports a second; repeatable. Default: 1, 2, 10 and 100.")
    ] = None,
    cases: Annotated[
        list[str] | None,
        typer.Option("--case", help=f"{', '.join((*KINDS, IN_A_ROW, CHANGING, FIRST))}; repeatable. Default: all."),
    ] = None,
    one_in: Annotated[
        list[float] | None,
        typer.Option(help="One reading in so many is wrong; repeatable. Default: 1000, 200, 50 and 10."),
    ] = None,
    hours: Annotated[float, typer.Option(help="So much of a rack's test of six hours is judged.")] = 0.5,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 1,
    keep: Annotated[Path | None, typer.Option(help="Folder for recordings and twins; what is there is kept.")] = None,
    json_output: JsonOption = False,
) -> None:
    """Print a row for each kind and share of wrong readings."""
    chosen = cases or [*KINDS, IN_A_ROW, CHANGING, FIRST]
    if unknown := set(chosen) - {*KINDS, IN_A_ROW, CHANGING, FIRST}:
        raise SystemExit(f"--case {unknown.pop()!r}: there is no such case; see --help")
    tables: dict[str, list[dict[str, Any]]] = {}
    for rate_hz in report_hz or RATES_HZ:
        with tempfile.TemporaryDirectory() as folder:
            data = RackData(keep or Path(folder), racks, rate_hz, TEST_S, seed)
            data.make([LEARNING], progress)
            of_all = product((case for case in chosen if case != FIRST), one_in or (1000.0, 200.0, 50.0, 10.0))
            wrongs = [Wrong(*each, rate_hz) for each in of_all]
            wrongs += [Wrong(FIRST, 0.0, rate_hz)] if FIRST in chosen else []
            tables[f"{rate_hz:g} Hz: false alarms of {racks} healthy racks in {hours:g} h each"] = [
                _row(data, wrong, hours, Path(folder) / "wrong.mcap") for wrong in wrongs
            ]
    show(tables, [f"declared: {DECLARED_PER_DAY:g} a fan and day"], as_json=json_output)


def _row(data: RackData, wrong: Wrong, hours: float, recording: Path) -> dict[str, Any]:
    alarms: list[Episode] = []
    fan_hours = 0.0
    pieces = np.linspace(0.0, 3600.0 * hours, PIECES + 1 if wrong.case == FIRST else 2)
    for rack in range(data.count):
        twin = twin_of(data, rack, LEARNING)
        for from_s, to_s in zip(pieces[:-1].tolist(), pieces[1:].tolist(), strict=True):
            write_with_wrong(data.test(HEALTHY, rack), recording, from_s, to_s, wrong, data.seed)
            found = judged(recording, twin)
            alarms += found.ours
            fan_hours += found.fan_hours
    progress(f"{wrong.case}, 1 in {wrong.one_in:g}, {data.rate_hz:g} Hz")
    return {
        "wrong readings": wrong.case,
        "1 in": f"{wrong.one_in:g}" if wrong.one_in else f"{PIECES} starts",
        "fan-hours": fan_hours,
        "alarms": len(alarms),
        "that blame the tacho": sum(one.last_cause.startswith("sensor") for one in alarms),
    }


def write_with_wrong(recording: Path, output: Path, from_s: float, to_s: float, wrong: Wrong, seed: int) -> None:
    """Write a part of a recording of a rack again, with wrong readings."""
    rng = np.random.default_rng([seed, round(wrong.one_in), round(from_s)])
    with RecordingWriter(output, METADATA, t_ns=START_NS, overwrite=True) as writer:
        for number, raw in enumerate(_part(recording, from_s, to_s)):
            speed = wrong.replaced(raw, rng, is_start=number == 0)
            message = replace(raw, speed_rad_s=speed, header=Header(PRODUCER, number, TRAY))
            writer.add_message(tray_key(SITE, TRAY, "raw"), message, int(raw.host_receive_t_ns[-1]))


def _part(recording: Path, from_s: float, to_s: float) -> Iterator[Raw]:
    for raw in reports_of(recording):
        t_s = (raw.host_receive_t_ns - START_NS) / NS_PER_S
        if t_s[0] >= to_s:
            return
        rows = np.flatnonzero((t_s >= from_s) & (t_s < to_s))
        if len(rows):
            yield select(raw, rows)


if __name__ == "__main__":
    typer.run(main)

"""Cold starts: false alarms in the first minutes of a scorer that begins in mid-run of a healthy rack.

Racks learn as in `bench.detection.run --only rack`, and recordings are kept in the same folder. Of the test of each
rack without faults, short parts at random times are scored, each by itself from the beginning: nothing is known of a
fan but its twin, and it may be standing, running up or turning. Every alarm is false.

Example: python -m bench.detection.cold_starts --keep /tmp/racks --racks 2 --report-hz 10
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

sys.path.insert(0, str(Path(__file__).parents[2]))

from bench.detection.rack_limits import reports_of
from bench.detection.rack_recordings import HEALTHY, LEARNING, RackData
from bench.detection.rack_scoring import DECLARED_PER_DAY, Judged, judged, twin_of
from bench.printing import JsonOption, progress, show
from fantwin.schemas.units import NS_PER_S

WITHIN_S = (10.0, 60.0, 300.0)
"""times since the start until which alarms are counted"""


def main(
    racks: Annotated[int, typer.Option(help="Simulated racks of four fans.")] = 2,
    starts: Annotated[int, typer.Option(help="So many of each rack.")] = 50,
    report_hz: Annotated[list[float] | None, typer.Option(help="Reports a second; repeatable. Default: 10.")] = None,
    learn: Annotated[str, typer.Option(help=f"What racks learn from: {', '.join(LEARNING)}.")] = "15 minutes",
    test_hours: Annotated[float, typer.Option(help="Length of the test of a rack.")] = 6.0,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 1,
    keep: Annotated[Path | None, typer.Option(help="Folder for recordings and twins; what is there is kept.")] = None,
    json_output: JsonOption = False,
) -> None:
    """Print a row for each rate and time since the start."""
    rows: list[dict[str, Any]] = []
    for rate_hz in report_hz or [10.0]:
        with tempfile.TemporaryDirectory() as folder:
            data = RackData(keep or Path(folder), racks, rate_hz, 3600.0 * test_hours, seed)
            data.make([learn], progress)
            found = [each for rack in range(racks) for each in _started(data, rack, learn, starts)]
        rows += [_row(rate_hz, found, within_s) for within_s in WITHIN_S]
    note = f"declared: {DECLARED_PER_DAY:g} a fan and day; {starts} starts of each of {racks} racks of four fans"
    show({"false alarms after a start in mid-run": rows}, [note], as_json=json_output)


def _started(data: RackData, rack: int, learn: str, starts: int) -> list[tuple[int, Judged]]:
    """When each part begins, in ns, and what was made of it."""
    twin, test = twin_of(data, rack, learn), data.test(HEALTHY, rack)
    first_ns, longest_s = int(next(reports_of(test)).host_receive_t_ns[0]), max(WITHIN_S)
    drawn_s = np.random.default_rng([data.seed, rack]).uniform(0.0, data.test_s - longest_s, starts)
    found = [
        (first_ns + round(from_s * NS_PER_S), judged(test, twin, from_s=from_s, to_s=from_s + longest_s))
        for from_s in drawn_s.tolist()
    ]
    progress(f"{starts} starts of rack {rack + 1} of {data.count} at {data.rate_hz:g} Hz")
    return found


def _row(rate_hz: float, found: list[tuple[int, Judged]], within_s: float) -> dict[str, Any]:
    alarms = [[one for one in part.ours if one.raised_ns - start_ns <= within_s * NS_PER_S] for start_ns, part in found]
    causes = Counter(one.last_cause or one.statistic for each in alarms for one in each)
    return {
        "Hz": f"{rate_hz:g}",
        "within": f"{within_s:g} s",
        "false alarms": sum(map(len, alarms)),
        "declared": DECLARED_PER_DAY * sum(part.fan_hours for _, part in found) / 24.0 * within_s / max(WITHIN_S),
        "starts with one": sum(map(bool, alarms)),
        "causes": ", ".join(f"{cause} {count}" for cause, count in causes.most_common()) or "-",
    }


if __name__ == "__main__":
    typer.run(main)

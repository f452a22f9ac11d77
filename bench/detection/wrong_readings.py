"""Wrong readings of healthy racks: how many alarms the product and the one model make of them.

Boards give twice, half or an impossible speed, or 0 rpm, for one reading (users report all four). Racks learn as in
`bench.detection.run --only rack`, from fifteen minutes without wrong readings; then some of the readings of a healthy
test are replaced, and the recording is scored. Every alarm is false.

Example: python -m bench.detection.wrong_readings --keep /tmp/racks --racks 2 --report-hz 10
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

sys.path.insert(0, str(Path(__file__).parents[2]))

from bench.detection.one_model.method import NAME as ONE_MODEL
from bench.detection.plant import START_NS
from bench.detection.rack_limits import reports_of
from bench.detection.rack_recordings import HEALTHY, METADATA, PRODUCER, SITE, TRAY, RackData
from bench.detection.rack_scoring import DECLARED_PER_DAY, Judged, judged, model_of, twin_of
from bench.printing import JsonOption, progress, show
from pipeline.recordings.writing import RecordingWriter
from schemas.header import Header
from schemas.messages import Array
from schemas.topics import tray_key

LEARNING, TEST_S = "15 minutes", 6 * 3600.0
ONE_IN = (1000, 200, 50)
IMPOSSIBLE_RAD_S = 2772.0
"""26,470 rpm, as a board has shown"""


def main(
    racks: Annotated[int, typer.Option(help="Simulated racks of four fans.")] = 2,
    report_hz: Annotated[float, typer.Option(help="Reports of the racks a second: 2, 10 or 100.")] = 10.0,
    hours: Annotated[float, typer.Option(help="So much of a rack's test of six hours is judged.")] = 1.0,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 1,
    keep: Annotated[Path | None, typer.Option(help="Folder for recordings and twins; what is there is kept.")] = None,
    json_output: JsonOption = False,
) -> None:
    """Print a row for each share of wrong readings."""
    with tempfile.TemporaryDirectory() as folder:
        data = RackData(keep or Path(folder), racks, report_hz, TEST_S, seed)
        data.make([LEARNING], progress)
        rows = [_row(data, one_in, hours, Path(folder)) for one_in in ONE_IN]
    title = f"{report_hz:g} Hz: false alarms of {racks} healthy racks in {hours:g} h each"
    show({title: rows}, [f"declared: {DECLARED_PER_DAY:g} a fan and day"], as_json=json_output)


def _row(data: RackData, one_in: int, hours: float, folder: Path) -> dict[str, Any]:
    found: list[Judged] = []
    for rack in range(data.count):
        twin = twin_of(data, rack, LEARNING)
        recording = folder / f"{rack}.mcap"
        write_with_wrong(data.test(HEALTHY, rack), recording, one_in, hours, data.seed)
        found.append(judged(recording, twin, [model_of(data, rack, LEARNING, twin)]))
        progress(f"one reading in {one_in} wrong: {rack + 1} of {data.count} racks")
    return {
        "wrong readings": f"1 in {one_in}",
        "fan-hours": f"{sum(one.fan_hours for one in found):.1f}",
        "fantwin": str(sum(len(one.ours) for one in found)),
        ONE_MODEL: str(sum(len(one.others[ONE_MODEL]) for one in found)),
    }


def write_with_wrong(recording: Path, output: Path, one_in: int, hours: float, seed: int) -> None:
    """Write the first hours of a recording of a rack again, with one reading in so many replaced."""
    rng = np.random.default_rng([seed, one_in])
    with RecordingWriter(output, METADATA, t_ns=START_NS, overwrite=True) as writer:
        for number, raw in enumerate(reports_of(recording)):
            if raw.host_receive_t_ns[-1] > START_NS + hours * 3.6e12:
                break
            speed = np.where(
                rng.random(raw.speed_rad_s.shape) * one_in < 1.0, wrong(raw.speed_rad_s, rng), raw.speed_rad_s
            )
            message = replace(raw, speed_rad_s=speed, header=Header(PRODUCER, number, TRAY))
            writer.add_message(tray_key(SITE, TRAY, "raw"), message, int(raw.host_receive_t_ns[-1]))


def wrong(speed_rad_s: Array, rng: np.random.Generator) -> Array:
    """Half, twice, none or impossible, instead of each speed; NaN where there is no reading."""
    kinds = np.stack((0.5 * speed_rad_s, 2.0 * speed_rad_s, 0.0 * speed_rad_s, 0.0 * speed_rad_s + IMPOSSIBLE_RAD_S))
    chosen = rng.integers(len(kinds), size=speed_rad_s.shape)
    found: Array = np.take_along_axis(kinds, chosen[np.newaxis], axis=0)[0]
    return found


if __name__ == "__main__":
    typer.run(main)

"""What a fan-sample costs in each stage: the time of the processor for the cores of the stages and for the codec.

Rough fans at 100 Hz under random stairs, all healthy, watched by a calibrated twin of one such fan. Their samples are
made beforehand, put into messages of a length, and taken by the cores one after the other, in this process. Bus,
recorder and viewer are not in it.

    python -m bench.fleet.stage_cost
"""

from __future__ import annotations

import io
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from bench.detection.plant import START_NS
from bench.printing import JsonOption, progress, show
from bench.stage_context import stage_context
from bench.training.published_fan import RATE_HZ, rough_run
from pipeline.cli.twins.calibrate import calibrate
from pipeline.config.loading import parse_config
from pipeline.recordings.writing import RecordingWriter
from pipeline.runtime.stage import Core, load_stage
from schemas.codec import decode, encode
from schemas.header import Header
from schemas.messages import Alarm, Grid, Prediction, Raw, Score
from schemas.topics import tray_key
from schemas.units import NS_PER_S
from twin.build import train_twin
from twin.runs import Run

SITE, TRAY = "fleet", "tray1"
STAGES = ("resampler", "twin_integrator", "scorer")
TRAINING_S, HEALTHY_S = 80.0, 150.0
BLOCKS_S = (0.05, 0.1, 1.0)
TRAYS = (8, 64)
"""fans of a tray"""


@dataclass
class Cost:
    """Of the samples of one tray so far."""

    seconds: dict[str, float] = field(default_factory=dict[str, float])
    """of the processor, by stage"""
    bytes: dict[str, int] = field(default_factory=dict[str, int])
    """of the messages, by topic"""
    alarms: int = 0

    def add(self, name: str, seconds: float) -> None:
        """Of a stage or the codec."""
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds


def main(
    seconds: Annotated[float, typer.Option(help="Of samples, for each row.")] = 60.0,
    json_output: JsonOption = False,
) -> None:
    """Print microseconds for each fan-sample, by stage, length of the messages, and fans of a tray."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        progress("training and calibrating the twin")
        twin = calibrated_twin(Path(folder))
        for fans in TRAYS:
            progress(f"simulating {fans} fans for {seconds:g} s")
            run = rough_run(3, seconds, fans, fan_variation=0.0).run
            for block_s in BLOCKS_S:
                progress(f"{fans} fans, messages of {block_s:g} s")
                cost = cost_of(run, block_s, twin, Path(folder))
                rows.append(_row(fans, block_s, cost, run.samples * fans))
    show({"us of the processor for each fan-sample": rows}, ["bytes: of all four messages"], as_json=json_output)


def calibrated_twin(folder: Path) -> Path:
    """A twin of one fan, which serves any number of its kind, with limits."""
    path, recording = folder / "twin.onnx", folder / "healthy.mcap"
    training, held_out = (rough_run(seed, TRAINING_S).run for seed in (1, 2))
    train_twin([training], [held_out], "hybrid", name=SITE).save(path)
    with RecordingWriter(recording, {"site": SITE, "trays": TRAY}, t_ns=START_NS) as writer:
        for raw in raws(rough_run(4, HEALTHY_S, 4, fan_variation=0.0).run, 1.0):
            writer.add_message(tray_key(SITE, TRAY, "raw"), raw, int(raw.host_receive_t_ns[-1]))
    with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()):
        calibrate(path, [recording], 24.0, extrapolate=True, jobs=1)
    return path


def raws(run: Run, block_s: float) -> Iterator[Raw]:
    """The samples of a run in messages of a length."""
    length = round(block_s * RATE_HZ)
    for number, first in enumerate(range(0, run.samples, length)):
        rows = np.arange(first, min(first + length, run.samples))
        yield Raw(
            header=Header("acquisition", number, TRAY),
            fans=run.fans,
            host_receive_t_ns=START_NS + (rows * (NS_PER_S // round(RATE_HZ))).astype(np.int64),
            device_clock_us=(rows * (1_000_000 // round(RATE_HZ))).astype(np.uint32),
            device_sequence=rows.astype(np.uint32),
            command=run.command[rows],
            speed_rad_s=run.speed_rad_s[rows],
        )


def cost_of(run: Run, block_s: float, twin: Path, folder: Path) -> Cost:
    """What the samples of a run cost, in messages of a length."""
    text = (
        f'site = "{SITE}"\nrun_folder = "{folder / "runs"}"\n'
        f'[[tray]]\nname = "{TRAY}"\nfans = {run.fans}\ntwin = "{twin}"\n'
    )
    config = parse_config(text, folder / "fantwin.toml", (), STAGES)
    cores = [load_stage(stage).build(stage_context(config, stage)).core for stage in STAGES]
    cost = Cost()
    for raw in raws(run, block_s):
        _take(raw, STAGES, cores, cost)
    return cost


def _take(message: Raw | Grid | Prediction, stages: Sequence[str], cores: Sequence[Core], cost: Cost) -> None:
    """A message travels to the first of some stages, and what that makes of it to the next."""
    arrived = _travelled(message, cost)
    began_s = time.process_time()
    made = cores[0].step(arrived)
    cost.add(stages[0], time.process_time() - began_s)
    for each in made:
        if isinstance(each, Grid | Prediction):
            _take(replace(each, header=message.header), stages[1:], cores[1:], cost)
        elif isinstance(each, Score):
            _travelled(each, cost)
        cost.alarms += isinstance(each, Alarm)


def _travelled(message: Any, cost: Cost) -> Any:
    began_s = time.process_time()
    data = encode(message)
    arrived = decode(type(message), data)
    cost.add("codec", time.process_time() - began_s)
    name = type(message).__name__.lower()
    cost.bytes[name] = cost.bytes.get(name, 0) + len(data)
    return arrived


def _row(fans: int, block_s: float, cost: Cost, fan_samples: int) -> dict[str, Any]:
    us = {name: seconds / fan_samples * 1e6 for name, seconds in cost.seconds.items()}
    total_us = sum(us.values())
    return {
        "fans of the tray": fans,
        "message, s": block_s,
        **{name: us[name] for name in (*STAGES, "codec")},
        "sum": total_us,
        "fans at 100 Hz a core": round(1e6 / (total_us * RATE_HZ)),
        "bytes": sum(cost.bytes.values()) / fan_samples,
        "alarms": cost.alarms,
    }


if __name__ == "__main__":
    typer.run(main)

"""What a fan-sample costs in each stage, and the memory of a fan in the scorer.

Rough fans at 100 Hz under random stairs, healthy unless `--in-alarm` says otherwise, watched by the calibrated twin of
one: trays of 8, of 64, and 20 trays of 500. Messages are made beforehand and taken by the cores one after the other,
in this process: time of the processor for the cores of the stages and for the codec. Memory is by how much this process
grows once there are scorers. Bus, recorder and viewer are not in it.

    python -m bench.fleet.stage_cost
"""

from __future__ import annotations

import io
import os
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
from bench.fleet.hall import FAULT_S, Hall, HallFault
from bench.printing import JsonOption, progress, show
from bench.runtime.stage_memory import memory_mb
from bench.stage_context import stage_context
from bench.training.published_fan import RATE_HZ, rough_run
from fantwin.pipeline.cli.twins.calibrate import calibrate
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.runtime.building import build_parts
from fantwin.pipeline.runtime.stage import Core, load_stage
from fantwin.schemas.codec import decode, encode
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Grid, Prediction, Raw, Score
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import NS_PER_S
from fantwin.twin.build import train_twin
from fantwin.twin.runs import Run

SITE, TRAY = "fleet", "tray1"
STAGES = ("resampler", "twin_integrator", "scorer")
TRAINING_S, HEALTHY_S = 80.0, 150.0
BLOCKS_S = (0.05, 0.1, 1.0)
TRAYS = {8: 16, 64: 4, 500: 20}
"""fans of a tray, and number of trays"""
BEGINNING_S = 10.0
"""time before there are scorers; it is not measured"""


@dataclass
class Cost:
    """Figures of the samples so far."""

    seconds: dict[str, float] = field(default_factory=dict[str, float])
    """of the processor, by stage"""
    bytes: dict[str, int] = field(default_factory=dict[str, int])
    """of the messages, by topic"""
    alarms: int = 0
    scorer_mb: float = 0.0

    def add(self, name: str, seconds: float) -> None:
        """Of a stage or the codec."""
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds


def main(
    seconds: Annotated[float, typer.Option(help="Of samples, for each row.")] = 30.0,
    fans_of_tray: Annotated[
        list[int] | None,
        typer.Option(help="One tray of so many, but 16 of 8, 4 of 64 and 20 of 500; repeatable. Default: these three."),
    ] = None,
    in_alarm: Annotated[float, typer.Option(help="Share of the fans that lose speed, and so have an alarm.")] = 0.0,
    json_output: JsonOption = False,
) -> None:
    """Print microseconds for each fan-sample, by stage, length of the messages, and fans of a tray."""
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        progress("training and calibrating the twin")
        twin = calibrated_twin(Path(folder))
        for fans in fans_of_tray or TRAYS:
            for block_s in BLOCKS_S:
                hall = Hall(fans * TRAYS.get(fans, 1), fans, block_s)
                progress(f"{hall.trays} trays of {fans} fans, messages of {block_s:g} s")
                rows.append(_row(hall, block_s, cost_of(hall, seconds, twin, in_alarm), seconds))
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
        calibrate(path, [recording], 24.0, extrapolate=True, jobs="1")
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


def cost_of(hall: Hall, seconds: float, twin: Path, in_alarm: float) -> Cost:
    """What the samples of a hall cost. in_alarm: share of the fans that lose speed."""
    table = f'[[tray]]\nname = "{{}}"\nfans = {hall.fans_of_tray}\ntwin = "{twin}"\n'
    text = f'site = "{SITE}"\n[resampler]\nrate_hz = {RATE_HZ:g}\n' + "".join(map(table.format, hall.names))
    config = parse_config(text, twin.parent / "fantwin.toml", (), STAGES)
    starts_s = np.arange(BEGINNING_S, BEGINNING_S + seconds, FAULT_S).tolist()
    of_tray = range(round(in_alarm * hall.fans_of_tray))
    faults = [HallFault(tray, fan, at_s) for tray in range(hall.trays) for fan in of_tray for at_s in starts_s]
    messages, cost = hall.messages(START_NS, faults), Cost()
    before = [_cores(stage, config) for stage in STAGES[:-1]]
    for _ in range(round(BEGINNING_S * RATE_HZ / hall.block)):
        for tray, raw in enumerate(next(messages)):
            _take(raw, STAGES, [of[tray] for of in before], Cost())
    began_mb = memory_mb(os.getpid())[0]
    stages = [*before, _cores(STAGES[-1], config)]
    for _ in range(round(seconds * RATE_HZ / hall.block)):
        for tray, raw in enumerate(next(messages)):
            _take(raw, STAGES, [of[tray] for of in stages], cost)
    cost.scorer_mb = memory_mb(os.getpid())[0] - began_mb
    return cost


def _cores(stage: str, config: Config) -> list[Core]:
    """One for each tray."""
    return [parts.core for parts in build_parts(load_stage(stage), stage_context(config, stage)).values()]


def _take(message: Raw | Grid | Prediction, stages: Sequence[str], cores: Sequence[Core], cost: Cost) -> None:
    """A message travels to the first of some stages, and what that makes of it to the next that has a core."""
    if not cores:
        return
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


def _row(hall: Hall, block_s: float, cost: Cost, seconds: float) -> dict[str, Any]:
    fan_samples = hall.fans * seconds * RATE_HZ
    us = {name: seconds / fan_samples * 1e6 for name, seconds in cost.seconds.items()}
    total_us = sum(us.values())
    return {
        "fans": hall.fans,
        "of a tray": hall.fans_of_tray,
        "message, s": block_s,
        **{name: us[name] for name in (*STAGES, "codec")},
        "sum": total_us,
        "fans at 100 Hz a core": round(1e6 / (total_us * RATE_HZ)),
        "bytes": sum(cost.bytes.values()) / fan_samples,
        "alarms": cost.alarms,
        "scorer, MB a fan": cost.scorer_mb / hall.fans,
    }


if __name__ == "__main__":
    typer.run(main)

"""A simulated rack as its user has it: `fantwin train`, `fantwin calibrate` and `fantwin replay --offline`.

The functions of these commands are called, with their defaults and the options of docs/tutorial/own-fan.md. The other
methods see the same predictions, and their limits are set on the same recordings.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.detection.campaigns import calibrate as set_limits
from bench.detection.competitors import plain_methods
from bench.detection.methods import Log, Method
from bench.detection.metrics import RaisedAlarm
from bench.detection.rack_recordings import RackData
from fantwin.pipeline.cli.twins.calibrate import calibrate
from fantwin.pipeline.cli.twins.train import train
from fantwin.pipeline.replay.offline.replay_input import open_replay_input
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.messages import Alarm, Message, Prediction, Score

CANNOT_TELL = "cannot_tell"
DECLARED_PER_DAY = 1.0
"""false alarms of a fan"""


@dataclass(frozen=True)
class Episode:
    """An alarm from raised to cleared. cleared_ns: None if it stood at the end."""

    fan: int
    raised_ns: int
    cleared_ns: int | None
    statistic: str
    message: str
    first_cause: str
    """the most probable when any was first named: other than `cannot_tell`"""
    last_cause: str
    """the most probable when causes were last reported; may be `cannot_tell`"""


@dataclass
class Judged:
    """What all methods made of one run of a rack."""

    fan_hours: float = 0.0
    """judged by the scorer"""
    not_judged_hours: dict[str, float] = field(default_factory=dict)
    ours: list[Episode] = field(default_factory=list)
    others: dict[str, list[RaisedAlarm]] = field(default_factory=dict)
    seconds: float = 0.0


def trained(data: RackData, rack: int, twin: Path) -> None:
    """Write the twin of a rack, trained on its sweep and evaluated on five minutes under the thermostat."""
    with _quietly(twin.with_suffix(".train.txt")):
        train([data.sweep(rack)], twin, validate=data.learning("15 minutes", rack)[:1])


def calibrated(data: RackData, rack: int, learning: str, twin: Path, output: Path) -> None:
    """Write the twin, calibrated on the recordings to learn from; as a target where they cannot show the rate.

    Raises:
        UserError: the recordings do not suffice.
    """
    with _quietly(output.with_suffix(".calibrate.txt")):
        healthy = data.learning(learning, rack)
        calibrate(twin, healthy, DECLARED_PER_DAY, extrapolate=learning != "three nights", output=output, jobs="1")


def twin_of(data: RackData, rack: int, learning: str) -> Path:
    """The twin of a rack, calibrated on the recordings to learn from; made where it is not kept.

    Raises:
        UserError: the recordings do not suffice.
    """
    twin = data.sweep(rack).parent / "twin.onnx"
    made = twin.with_name(f"twin-{data.kept_name(learning)}.onnx")
    if not twin.exists():
        trained(data, rack, twin)
    if not made.exists():
        calibrated(data, rack, learning, twin, made)
    return made


@contextmanager
def _quietly(log: Path) -> Iterator[None]:
    """What a command prints goes to a file."""
    with log.open("w") as file, redirect_stdout(file), redirect_stderr(file):
        yield


def other_methods(data: RackData, rack: int, learning: str, twin: Path) -> list[Method]:
    """The plain methods, with limits from the recordings that the twin is calibrated on."""
    methods = plain_methods(data.rate_hz, DECLARED_PER_DAY / 24.0)
    set_limits(methods, _predictions(data.learning(learning, rack), twin), DECLARED_PER_DAY / 24.0)
    return methods


def _predictions(paths: Sequence[Path], twin: Path) -> Iterator[tuple[str, Prediction]]:
    for path in paths:
        with open_replay_input([path], None, (), twin) as replay_input:
            for block in replay_input.pipeline(replay_input.trays[0].name).predictions():
                yield path.stem, block


def judged(
    path: Path, twin: Path, methods: Sequence[Method] = (), from_s: float = 0.0, to_s: float = math.inf
) -> Judged:
    """A recording, or a part of it by itself, scored as by `fantwin replay --offline`, and by other methods on the same
    predictions."""
    began_s = time.monotonic()
    found = Judged()
    detectors: dict[str, Any] = {}
    logs = {method.name: Log() for method in methods}
    alarms: list[Alarm] = []
    reasons: dict[int, int] = {}
    period_s = 0.0

    def observe(message: Message) -> None:
        if isinstance(message, Prediction):
            for method in methods:
                detector = detectors.setdefault(method.name, method.detector(message.fans))
                logs[method.name].take(path.stem, detector.take(message).changes)

    with open_replay_input([path], None, (), twin, from_s, to_s) as replay_input:
        for _, message in replay_input.pipeline(replay_input.trays[0].name, observe=observe).run():
            if isinstance(message, Alarm):
                alarms.append(message)
            elif isinstance(message, Score):
                period_s = message.period_ns / 1e9
                for reason, count in zip(*np.unique(message.invalid_reason, return_counts=True), strict=True):
                    reasons[int(reason)] = reasons.get(int(reason), 0) + int(count)
    hours = {InvalidReason(code).name.lower(): count * period_s / 3600 for code, count in reasons.items()}
    found.fan_hours = hours.pop("none", 0.0)
    found.not_judged_hours = hours
    found.ours = episodes(alarms)
    found.others = {name: log.alarms for name, log in logs.items()}
    found.seconds = time.monotonic() - began_s
    return found


def episodes(alarms: list[Alarm]) -> list[Episode]:
    """Alarms from raised to cleared, of one run, in the order in which they were raised."""
    done: list[Episode] = []
    standing: dict[int, Episode] = {}
    for alarm in sorted(alarms, key=lambda one: one.t_ns):
        cause = alarm.causes[0].cause if alarm.causes else ""  # as people read it: `cannot_tell` before those it lists
        now = standing.get(alarm.fan)
        if alarm.active:
            if now is None:
                now = Episode(alarm.fan, alarm.t_ns, None, alarm.statistic.name.lower(), alarm.message, "", "")
            named = "" if cause == CANNOT_TELL else cause
            standing[alarm.fan] = replace(now, first_cause=now.first_cause or named, last_cause=cause or now.last_cause)
        elif now is not None:
            done.append(replace(standing.pop(alarm.fan), cleared_ns=alarm.t_ns))
    return sorted([*done, *standing.values()], key=lambda one: (one.raised_ns, one.fan))

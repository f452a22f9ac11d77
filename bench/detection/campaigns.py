"""Running methods over simulated runs: healthy ones, block by block, and faulty ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from bench.detection.knobs import EVERYDAY, Knobs
from bench.detection.methods import Calibration, Detector, Log, Method
from bench.detection.metrics import RaisedAlarm
from bench.detection.plant import RATE_HZ, Plant
from bench.detection.simulated import Fleet, PredictionStages, run_name
from fantwin.schemas.messages import Array, Prediction

Progress = Callable[[str], None]
KEPT_ROWS = 8
"""the largest score of this many samples is kept"""


@dataclass(frozen=True)
class Healthy:
    """The alarms and scored time of a method on healthy data."""

    alarms: list[RaisedAlarm]
    fan_hours: float
    """samples with a score"""
    in_alarm_hours: float


def everyday(fleet: Fleet, runs: int, seed: int) -> Plant:
    """Healthy runs of the whole fleet, as in use."""
    columns = fleet.count * runs
    knobs = [EVERYDAY[fan % len(EVERYDAY)] for fan in range(columns)]
    return Plant(fleet.fans, runs, Knobs(knobs, seed), seed + 1)


def predictions(fleet: Fleet, plant: Plant, seconds: float, progress: Progress) -> Iterator[tuple[str, Prediction]]:
    """(run name, prediction) of every tray of every run, block by block."""
    trays = len(fleet.twins)
    stages: dict[int, PredictionStages] = {}
    reported = 0
    for number, blocks in enumerate(plant.blocks(seconds)):
        for unit, raw in enumerate(blocks):
            unit_stages = stages.setdefault(unit, PredictionStages(fleet.twins[unit % trays]))
            for prediction in unit_stages.take(raw):
                yield run_name(unit, trays), prediction
        minutes = int(number * len(blocks[0].command) / RATE_HZ / 60)
        if minutes >= reported + 10:
            reported = minutes
            progress(f"  {minutes} of {seconds / 60:.0f} min of {len(blocks)} trays")


def calibrate(
    methods: Sequence[Method], stream: Iterator[tuple[str, Prediction]], alarms_per_hour: float
) -> Calibration | None:
    """Set the limits that are not fixed, all by the same rule on the same runs. alarms_per_hour: per fan.

    None if no method has such a limit; the stream is consumed in any case.
    """
    open_ones = [method for method in methods if not method.is_fixed]
    calibrations = {method.name: Calibration(alarms_per_hour) for method in open_ones}
    scores = {}
    for run, block in stream:
        for method in open_ones:
            one = scores.setdefault((method.name, run), method.scores(block.fans))
            calibrations[method.name].take(run, block, one.take(block))
    for method in open_ones:
        method.limit = calibrations[method.name].limit()
    return next(iter(calibrations.values()), None)


class Watch:
    """One method over all runs: its alarms, the scored time, and its scores if they are kept."""

    def __init__(self, detector: Callable[[str, int], Detector], *, keep_scores: bool) -> None:
        self._new = detector
        self._detectors: dict[str, Detector] = {}
        self._log = Log()
        self._keep = keep_scores
        self._kept: dict[str, list[Array]] = {}
        self._scored = 0
        self._step_ns = 0
        self._start_ns: dict[str, int] = {}
        self._end_ns: dict[str, int] = {}

    def take(self, run: str, block: Prediction) -> None:
        """Score a block of a run."""
        if run not in self._detectors:
            self._detectors[run] = self._new(run, block.fans)
            self._start_ns[run] = int(block.t_ns[0])
        output = self._detectors[run].take(block)
        self._log.take(run, output.changes)
        self._scored += int(np.isfinite(output.score).sum())
        self._step_ns, self._end_ns[run] = block.period_ns, int(block.t_ns[-1])
        if self._keep:
            self._kept.setdefault(run, []).append(thinned(output.score).astype(np.float32))

    def healthy(self) -> Healthy:
        """Its alarms and hours, for runs without faults."""
        alarms = self._log.alarms
        in_alarm_ns = sum((one.cleared_ns or self._end_ns[one.run]) - one.raised_ns for one in alarms)
        return Healthy(alarms, self._scored * self._step_ns / 3.6e12, in_alarm_ns / 3.6e12)

    @property
    def alarms(self) -> list[RaisedAlarm]:
        """All alarms."""
        return self._log.alarms

    def scores(self, run: str) -> Array:
        """(m, fans) of a run, thinned; see `times_ns`."""
        return np.concatenate(self._kept[run]).astype(np.float64)

    def times_ns(self, run: str) -> Array:
        """(m,) of the kept scores."""
        count = sum(map(len, self._kept[run]))
        return self._start_ns[run] + KEPT_ROWS * self._step_ns * np.arange(count)


def thinned(score: Array) -> Array:
    """(m, fans) the largest of each KEPT_ROWS samples; NaN where none was scored."""
    rows = -len(score) % KEPT_ROWS
    padded = np.concatenate((score, np.full((rows, score.shape[1]), np.nan)))
    largest = np.where(np.isfinite(padded), padded, -np.inf).reshape(-1, KEPT_ROWS, score.shape[1]).max(axis=1)
    return np.where(np.isfinite(largest), largest, np.nan)


def watched(watches: dict[str, Watch], stream: Iterator[tuple[str, Prediction]]) -> dict[str, Watch]:
    """Feed all blocks to all methods."""
    for run, block in stream:
        for watch in watches.values():
            watch.take(run, block)
    return watches

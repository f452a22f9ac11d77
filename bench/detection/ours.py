"""The scorer itself as a detector, and its calibration on simulated data that are too long for a recording.

`fantwin calibrate` does the same with recordings. Here the healthy samples of all trays lie in plain files of a
temporary folder, in single precision, and one set of limits is found for the whole fleet.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from bench.detection.methods import AlarmChange, MethodOutput
from bench.detection.plant import BLOCK, STEP_NS, TRAY_FANS
from bench.detection.simulated import tray_number
from pipeline.replay.offline.limits_of_twin import find_limits
from pipeline.runtime.stage import Core
from pipeline.runtime.tray_twin import load_tray_twin
from schemas.messages import Alarm, Array, Prediction, Score
from scoring.calibration.healthy_statistics import HealthyRun, one_after_another
from scoring.limits import Limits, default_timing
from scoring.samples import Samples, samples_of
from twin.export.card_entries import with_card_entries

NAME = "fantwin"
COLUMNS = (
    "speed_rad_s",
    "speed_residual",
    "speed_sigma_rad_s",
    "speed_unseen",
    "balance",
    "balance_sigma",
    "balance_unseen",
    "command",
    "predicted_rad_s",
)
FLAGS = ("speed_valid", "balance_valid", "missing", "reading_missing", "idle", "alive")


class Scorer:
    """The stage's core. Its score is the largest ratio of a statistic to its limit."""

    def __init__(self, core: Core) -> None:
        self._core = core

    def take(self, block: Prediction) -> MethodOutput:
        """See methods.Detector."""
        scores: list[Array] = []
        changes: list[AlarmChange] = []
        for message in self._core.step(block):
            if isinstance(message, Score):
                scores.append(message.score)
            elif isinstance(message, Alarm):
                causes = sorted(message.causes, key=lambda one: -one.probability)
                reported = tuple(one.cause for one in causes)
                changes.append(AlarmChange(message.fan, message.t_ns, message.active, reported))
        return MethodOutput(np.concatenate(scores), changes)


class HealthySamples:
    """Samples of healthy runs, kept in files, to be gone through several times."""

    def __init__(self, folder: Path, twins: Iterable[Path]) -> None:
        """twins: of the trays."""
        self._folder = folder
        self._unseen_errors = [load_tray_twin(twin).unseen_error for twin in twins]
        self._fans: dict[str, int] = {}
        self._rows: dict[str, int] = {}

    def take(self, run: str, block: Prediction) -> None:
        """Keep a block of a run."""
        samples = samples_of(block, self._unseen_errors[tray_number(run)])
        self._fans[run] = block.fans
        self._rows[run] = self._rows.get(run, 0) + len(block.t_ns)
        for name in (*COLUMNS, *FLAGS):
            column: Array = getattr(samples, name)
            with self._file(run, name).open("ab") as file:
                column.astype(np.float32 if name in COLUMNS else np.bool_).tofile(file)

    def __call__(self) -> Iterator[HealthyRun]:
        """All runs from the beginning, as scoring.calibration.calibration expects them."""
        for run, fans in self._fans.items():
            yield HealthyRun(run, fans, self._blocks(run, fans), fans_of(tray_number(run)))

    def clear(self) -> None:
        """Remove the files."""
        for run in self._fans:
            for name in (*COLUMNS, *FLAGS):
                self._file(run, name).unlink()
        self._fans.clear()

    def _blocks(self, run: str, fans: int) -> Iterator[Samples]:
        shape = (self._rows[run], fans)
        columns = {
            name: np.memmap(self._file(run, name), np.float32 if name in COLUMNS else np.bool_, "r", shape=shape)
            for name in (*COLUMNS, *FLAGS)
        }
        for first in range(0, shape[0], BLOCK):
            rows = slice(first, min(first + BLOCK, shape[0]))
            yield Samples(
                t_ns=STEP_NS * np.arange(rows.start, rows.stop),
                period_ns=STEP_NS,
                **{name: np.array(column[rows], np.float64) for name, column in columns.items() if name in COLUMNS},
                **{name: np.array(column[rows]) for name, column in columns.items() if name in FLAGS},
            )

    def _file(self, run: str, name: str) -> Path:
        return self._folder / f"{run.replace('/', '-')}.{name}"


def calibrated_twins(
    twins: Iterable[Path], healthy: HealthySamples, alarms_per_day: float, *, extrapolate: bool
) -> tuple[list[Path], Limits]:
    """Twins with limits in their cards, beside the ones given; and the limits.

    Raises:
        TooLittleError: the healthy running cannot support so low a rate.
    """
    given = list(twins)
    known = [load_tray_twin(path) for path in given]
    timing = default_timing(min(run.fans for run in healthy()))
    limits = find_limits(known, one_after_another(healthy), timing, alarms_per_day, extrapolate=extrapolate)
    made = []
    for number, path in enumerate(given):
        made.append(path.with_name(f"calibrated-{path.name}"))
        calibration = json.loads(limits.of(fans_of(number)).model_dump_json())
        made[-1].write_bytes(with_card_entries(path.read_bytes(), {"calibration": calibration}))
    return made, limits


def fans_of(tray: int) -> range:
    """The fans of the fleet that a tray has."""
    return range(TRAY_FANS * tray, TRAY_FANS * (tray + 1))

"""Calibration and alarms from predictions that are kept: scoring alone, without what comes before it.

What a twin predicts does not depend on how it is scored. So predictions are made once, and calibrated on and judged as
often as `scoring` is to be changed. The calls are those of `fantwin calibrate` and `fantwin replay --offline`.
"""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.detection.ours import HealthyBins
from bench.detection.rack_scoring import Episode, episodes
from fantwin.pipeline.replay.offline.replay_input import open_replay_input
from fantwin.pipeline.runtime.stage import Core
from fantwin.schemas.messages import Alarm, Array, Prediction, Score
from fantwin.schemas.units import NS_PER_S


@dataclass(frozen=True)
class Judged:
    """What the scorer made of one run. score, t_ns: of all its samples, (n, fans) and (n,)."""

    alarms: list[Episode]
    score: Array
    t_ns: Array
    fan_hours: float


def keep_predictions(recording: Path, twin: Path, kept: Path) -> None:
    """Write what a twin predicts for a recording of one tray, unless it is there."""
    if kept.exists():
        return
    with open_replay_input([recording], None, (), twin) as replay_input:
        blocks = list(replay_input.pipeline(replay_input.trays[0].name).predictions())
    write_predictions(blocks, kept)


def write_predictions(blocks: Sequence[Prediction], kept: Path) -> None:
    """Keep them in a file."""
    unfinished = kept.with_name(f"{kept.name}.part")
    unfinished.write_bytes(pickle.dumps(list(blocks), pickle.HIGHEST_PROTOCOL))
    unfinished.replace(kept)


def read_predictions(kept: Path) -> list[Prediction]:
    """Those of a file that this program wrote."""
    found: list[Prediction] = pickle.loads(kept.read_bytes())
    return found


def calibrate_twin(twin: Path, output: Path, kept: Sequence[Path], alarms_per_day: float, *, extrapolate: bool) -> None:
    """Write a twin that is calibrated on healthy recordings whose predictions are kept."""
    with tempfile.TemporaryDirectory() as folder:
        healthy = HealthyBins(Path(folder), twin)
        for path in kept:
            for block in read_predictions(path):
                healthy.take(path.stem, block)
        healthy.calibrate(alarms_per_day, output, extrapolate=extrapolate)


def scorer_of(recording: Path, twin: Path) -> Core:
    """The scorer of a recording's tray, as a replay builds it."""
    with open_replay_input([recording], None, (), twin) as replay_input:
        context = replay_input.contexts(replay_input.trays[0])[-1]
        return replay_input.stages.stages[-1].build(context).core


def judged(scorer: Core, blocks: Iterable[Prediction]) -> Judged:
    """The alarms and scores of a run."""
    alarms: list[Alarm] = []
    scores: list[Score] = []
    for block in blocks:
        for message in scorer.step(block):
            if isinstance(message, Alarm):
                alarms.append(message)
            elif isinstance(message, Score):
                scores.append(message)
    score = np.concatenate([one.score for one in scores])
    fan_hours = float(np.isfinite(score).sum()) * scores[0].period_ns / NS_PER_S / 3600.0
    return Judged(episodes(alarms), score, np.concatenate([one.t_ns for one in scores]), fan_hours)

"""Limits and alarms from predictions that are kept: scoring alone, without what comes before it.

What a twin predicts does not depend on how it is scored. So predictions are made once, and calibrated on and judged as
often as `scoring` is to be changed. The calls are those of `fantwin calibrate` and `fantwin replay --offline`.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.detection.rack_scoring import Episode, episodes
from pipeline.replay.offline.healthy_runs import HealthyPart, HealthyRuns
from pipeline.replay.offline.limits_of_twin import find_limits
from pipeline.replay.offline.replay_input import open_replay_input
from pipeline.runtime.stage import Core
from pipeline.runtime.tray_twin import load_tray_twin
from schemas.messages import Alarm, Array, Prediction, Score
from schemas.units import NS_PER_S
from scoring.calibration.healthy_statistics import HealthyRun, one_after_another
from scoring.samples import samples_of
from twin.export.card_entries import with_card_entries


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


def calibrated_twin(
    twin: Path,
    output: Path,
    recordings: Sequence[Path],
    kept: Sequence[Path],
    alarms_per_day: float,
    *,
    extrapolate: bool,
) -> None:
    """Write a twin with limits from healthy recordings, whose predictions are kept, as `fantwin calibrate` does."""
    known = load_tray_twin(twin)
    runs = []
    for path in kept:
        blocks = [samples_of(block, known.unseen_error) for block in read_predictions(path)]
        fans = blocks[0].speed_rad_s.shape[1]
        runs.append(HealthyRun(path.stem, fans, blocks, range(fans) if known.fans > 1 else None, known.card.tacho))
    timing = HealthyRuns(recordings, HealthyPart(twin)).timing()
    limits = find_limits([known], one_after_another(lambda: runs), timing, alarms_per_day, extrapolate=extrapolate)
    output.write_bytes(with_card_entries(twin.read_bytes(), {"calibration": json.loads(limits.model_dump_json())}))


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

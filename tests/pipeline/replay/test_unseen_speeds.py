"""A speed that training has not seen widens the band and raises no alarm; a fault there is found all the same.

The drive of this fan saturates above the commands of training, which no model can know.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import onnx
import pytest

from fantwin.pipeline.recordings.reading import read_recording
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm, Array, Score
from fantwin.schemas.twin_card import CARD_PROPERTY
from fantwin.twin.runs import Run
from tests.support.fan_data import rough_run
from tests.support.fantwin_command import fantwin

KNEE, HIGHEST = 70.0, 77.0
BLOCKED_S = 40.0
KEPT_EVERY = 4
"""sample of the simulation: 25 Hz, of which a network is trained in a quarter of the time"""


def saturating(run: Run) -> Run:
    """The same with the commands that a drive needs to act so: 2.4 for each above the knee."""
    return replace(run, command=run.command + 1.4 * np.maximum(run.command - KNEE, 0.0))


def blocked_at_its_highest_command(run: Run) -> tuple[Run, float]:
    """The run with its rotor stopped from some time on, and that time."""
    at = int(np.flatnonzero((run.t_s >= BLOCKED_S) & (run.command[:, 0] > KNEE))[0])
    speed_rad_s = run.speed_rad_s.copy()
    speed_rad_s[at:] = np.abs(np.random.default_rng(1).normal(size=speed_rad_s[at:].shape))
    return replace(run, speed_rad_s=speed_rad_s), float(run.t_s[at])


def recording(folder: Path, name: str, run: Run) -> Path:
    table, made = folder / f"{name}.csv", folder / f"{name}.mcap"
    columns = np.column_stack((run.t_s, run.command, run.speed_rad_s))[::KEPT_EVERY]
    np.savetxt(table, columns, delimiter=",", header="t,u,y", comments="", fmt="%.6f")
    result = fantwin("import", table, "--time", "t:s", "--command", "u", "--speed", "y:rad/s", "-o", made)
    assert result.exit_code == 0, result.output
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("unseen")
    training = recording(path, "training", rough_run(5, 60.0, high=KNEE))
    healthy = recording(path, "healthy", rough_run(6, 150.0, low=20.0, high=KNEE))
    result = fantwin("train", training, "--iterations", 12, "-o", path / "twin.onnx")
    assert result.exit_code == 0, result.output
    result = fantwin("calibrate", path / "twin.onnx", healthy, "--false-alarms-per-day", 24, "--extrapolate")
    assert result.exit_code == 0, result.output
    faulty, _ = blocked_at_its_highest_command(beyond())
    recording(path, "beyond", beyond())
    recording(path, "blocked", faulty)
    return path


@cache
def beyond() -> Run:
    return saturating(rough_run(7, 60.0, low=40.0, high=HIGHEST))


def replayed(folder: Path, name: str, twin: Path) -> tuple[list[Score], list[Alarm]]:
    """Scores, and the alarms that were raised."""
    out = folder / f"{name}-{twin.stem}.mcap"
    result = fantwin("replay", folder / f"{name}.mcap", "--offline", "--twin", twin, "-o", out)
    assert result.exit_code == 0, result.output
    messages = [entry.message for entry in read_recording(out, ("score", "alarm"))]
    raised = [one for one in messages if isinstance(one, Alarm) and one.transition == Transition.RAISED]
    return [one for one in messages if isinstance(one, Score)], raised


def joined(scores: list[Score], name: str) -> Array:
    return np.concatenate([getattr(score, name) for score in scores])[:, 0]


def knows_nothing(twin: Path) -> Path:
    """The twin without what its card says about its own error."""
    model = onnx.load(twin)
    for entry in model.metadata_props:
        if entry.key == CARD_PROPERTY:
            entry.value = json.dumps(json.loads(entry.value) | {"model_uncertainty": None})
    onnx.save(model, made := twin.with_name("knows-nothing.onnx"))
    return made


def test_a_speed_that_training_has_not_seen_widens_the_band_and_raises_no_alarm(folder: Path) -> None:
    twin = folder / "twin.onnx"
    scores, alarms = replayed(folder, "beyond", twin)
    assert not alarms
    command, valid = joined(scores, "command"), joined(scores, "valid")
    unseen = valid & (command > 1.1 * KNEE)
    assert unseen.sum() > 500 / KEPT_EVERY, "it is judged there"
    half_rad_s = (joined(scores, "upper_bound_rad_s") - joined(scores, "lower_bound_rad_s")) / 2.0
    seen = valid & (command < 0.9 * KNEE)
    assert np.median(half_rad_s[unseen]) > 1.5 * np.median(half_rad_s[seen])
    assert joined(scores, "outside")[unseen].mean() < 0.5, (
        "most are inside, though the drive saturates by more than the twin can know"
    )

    without, _ = replayed(folder, "beyond", knows_nothing(twin))
    score, score_without = joined(scores, "score"), joined(without, "score")
    assert score_without[unseen].max() > score[unseen].max() + 0.1, "more speaks for a fault if the twin does not know"


def test_evaluate_counts_the_band_of_a_running_site(folder: Path) -> None:
    twin = folder / "twin.onnx"
    covered = [
        json.loads(fantwin("evaluate", each, folder / "beyond.mcap", "--json").stdout)["coverage_2_sigma"]
        for each in (twin, knows_nothing(twin))
    ]
    assert 1.0 - covered[0] < 0.8 * (1.0 - covered[1]), "a third of the commands are beyond training"


def test_a_fault_at_such_a_speed_is_found(folder: Path) -> None:
    _, since_s = blocked_at_its_highest_command(beyond())
    scores, alarms = replayed(folder, "blocked", folder / "twin.onnx")
    first_ns = scores[0].t_ns[0]
    assert since_s < (alarms[0].t_ns - first_ns) / 1e9 + 0.1 < since_s + 2.0

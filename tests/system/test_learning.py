"""`fantwin up` without a twin: it learns one beside the running stages, which go on with it, and a replay agrees."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.learning.versions import TwinVersions, learning_folder
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.messages import ModelCard, Score
from tests.support.fantwin_command import fantwin
from tests.support.healthy_recordings import FANS, add_recording
from tests.support.running_chain import DEADLINE_S, RunningCommand, eventually

pytestmark = [pytest.mark.slow, pytest.mark.real_time]


@pytest.fixture
def configuration(tmp_path: Path, endpoint: str) -> Path:
    """The file of a tray with some minutes of healthy history, enough for a first version."""
    path = tmp_path / "fantwin.toml"
    path.write_text(
        f'run_folder = "runs"\n[bus]\nendpoint = "{endpoint}"\n[[tray]]\nname = "tray1"\nfans = {FANS}\n'
        f'command_max = 100\nport = "{tmp_path / "line"}"\n'
        '[recorder]\ntopics = ["raw", "score"]\n'
        # beside the training the line may stand still for longer than the default, and late samples would be lost
        "[resampler]\nwatermark_s = 5\n"
        '[launcher]\nstages = ["acquisition", "resampler", "twin_integrator", "scorer", "recorder", "learner"]\n',
        encoding="utf-8",
    )
    folder = learning_folder(tmp_path / "runs", "tray1")
    add_recording(folder, -100_000_000, 660.0, 1, every=20)
    return path


def test_a_twin_is_learned_and_takes_over_while_the_stages_run(
    tmp_path: Path, configuration: Path, start_command: Callable[..., RunningCommand]
) -> None:
    line = ("--link", tmp_path / "line", "--profile", "prbs", "--set", "rate_hz=10", "--json")
    start_command("simulate", "--fans", FANS, *line).line_with("fans on")
    versions = TwinVersions(learning_folder(configuration.parent / "runs", "tray1"), "tray1")
    up = start_command("up", "-c", configuration, "--json")
    up.line_with("learner, tray1: no twin yet, nothing is judged; ")
    eventually(versions.in_force, "the first version is made", 2 * DEADLINE_S)
    up.line_with("learner, tray1: tray1-1 is in force; ")
    assert up.end() == 0
    outcome = up.output()
    assert outcome["restarts"] == {}
    assert not any(outcome["lost"].values())
    (recording,) = map(Path, outcome["recordings"])
    messages = [envelope.message for envelope in read_recording(recording)]
    (card,) = [message for message in messages if isinstance(message, ModelCard)]
    assert card.content == versions.file("tray1-1").read_bytes()
    scores = [message for message in messages if isinstance(message, Score)]
    t_ns = np.concatenate([score.t_ns for score in scores])
    without = np.concatenate([(score.invalid_reason == InvalidReason.NO_TWIN).all(axis=1) for score in scores])
    assert without[t_ns < card.t_ns].all()
    assert not without[t_ns >= card.t_ns].any()
    verified = fantwin("replay", "--offline", "--verify", recording)
    assert verified.exit_code == 0, verified.output
    assert "all decisions are identical" in verified.stdout

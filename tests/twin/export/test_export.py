"""The exported file against the model in numpy and in torch, and files that are not one."""

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import helper

from fantwin.schemas.twin_card import CARD_PROPERTY, DataCard, TwinCard
from fantwin.twin.errors import TwinError
from fantwin.twin.export.onnx_export import export_onnx
from fantwin.twin.export.onnx_twin import OnnxTwin
from fantwin.twin.finishing import TrainedTwin
from fantwin.twin.models.hybrid import Hybrid
from fantwin.twin.models.model import Model
from tests.support import fan_data
from tests.support.made_once import TrainedOnce
from tests.support.random_models import ALL_MODELS, random_network

SAMPLES = 2000
CREATED = datetime(2026, 1, 1, tzinfo=UTC)


@pytest.fixture(scope="module")
def trained(trained_once: TrainedOnce) -> TrainedTwin:
    run = fan_data.published_run(1, 20.0, fans=2)
    data = [DataCard("bench.csv", "ab" * 32, run.fans, run.samples)]
    return trained_once([run], [], "physical", name="bench", command_unit="%", data=data, created=CREATED)


def saved(model: Model, card: TwinCard, folder: Path) -> OnnxTwin:
    fields = json.loads(card.to_json())
    fields |= {"kind": model.kind, "n_state": model.state_layout.size}
    fields["state_layout"] = {"speed": model.state_layout.speed, "command": model.state_layout.command}
    path = folder / f"{model.kind}.onnx"
    path.write_bytes(export_onnx(model, TwinCard.from_json(json.dumps(fields))))
    return OnnxTwin(path)


EVERY_MODEL = [*ALL_MODELS, Hybrid(random_network(10, ("speed",)))]
every_model = pytest.mark.parametrize("model", EVERY_MODEL, ids=["physical", "neural-ode", "hybrid", "narx", "speed"])
FANS = 4


def fleet() -> np.ndarray:
    """(4, 4) parameters of fans that differ in every parameter; the second has no lag, the last a small one."""
    scale = np.linspace(0.8, 1.3, FANS)[:, np.newaxis] ** np.array([1.0, -1.0, 2.0])
    return np.column_stack((scale * fan_data.PUBLISHED_PARAMETERS, (0.05, 0.0, 1.0, 5e-5)))


def uneven_commands() -> tuple[np.ndarray, np.ndarray]:
    """Twenty seconds for four fans at uneven steps, some of them tiny or zero."""
    rng = np.random.default_rng(9)
    step_s = rng.uniform(0.008, 0.012, SAMPLES)
    step_s[100:110], step_s[1500] = 1e-7, 0.0
    return fan_data.stairs(rng, SAMPLES, FANS), step_s


def state_of(model: Model, command: np.ndarray) -> np.ndarray:
    """Fans that turn, one of them backwards, after a command that differs from the first one here."""
    return model.state_layout.initial_state(np.array([20.0, 90.0, 0.0, -40.0]), command[0] + 30.0)


@every_model
def test_the_file_runs_uneven_steps_in_two_blocks_as_numpy_does_in_one(
    model: Model, trained: TrainedTwin, tmp_path: Path
) -> None:
    command, step_s = uneven_commands()
    twin = saved(model, trained.card, tmp_path)
    state, parameters = state_of(model, command), fleet()
    expected, expected_state = model.advance(state, command, step_s, parameters)
    first, middle = twin.advance(state, command[:777], step_s[:777], parameters)
    second, last = twin.advance(middle, command[777:], step_s[777:], parameters)
    assert np.ptp(expected, axis=0).min() > 50.0
    np.testing.assert_allclose(np.concatenate((first, second)), expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(last, expected_state, rtol=1e-9, atol=1e-9)


def test_the_card_travels_in_the_file(trained: TrainedTwin, tmp_path: Path) -> None:
    card = OnnxTwin(trained.save(tmp_path / "twin.onnx")).card
    assert card == trained.card
    assert card.created == "2026-01-01T00:00:00+00:00"
    assert card.command_unit == "%"
    assert card.training.data[0].sha256 == "ab" * 32
    assert card.rate_hz == pytest.approx(100.0)
    assert card.calibration is None
    calibrated = replace(card, calibration={"false_alarms_per_day": 1.0, "limits": [3.0, None]})
    assert TwinCard.from_json(calibrated.to_json()) == calibrated
    np.testing.assert_array_equal(card.parameters, trained.parameters)


def refusal(path: Path) -> str:
    with pytest.raises(TwinError) as caught:
        OnnxTwin(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_file_that_is_not_a_twin_or_not_whole_is_refused_in_one_line(trained: TrainedTwin, tmp_path: Path) -> None:
    path = trained.save(tmp_path / "twin.onnx")
    whole, file = path.read_bytes(), onnx.load(path)
    del file.metadata_props[:]
    onnx.save(file, path)
    assert "not a fantwin twin" in refusal(path)
    assert "no such file" in refusal(tmp_path / "absent.onnx")
    path.write_text("not a model")
    assert "not an ONNX file" in refusal(path)
    for length in np.linspace(0, len(whole) - 1, 5).astype(int):
        path.write_bytes(whole[:length])
        refusal(path)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"format": 99}, "a twin card of format 99; this fantwin reads format 1: update fantwin"),
        ({"state_layout": {"speed": 1, "command": 0}, "n_state": 1}, r"the card says (fans, 1)"),
        ({"n_state": 3}, "n_state"),
        ({"parameters": [[0.1, 0.1, 0.1, 0.0]]}, "parameters"),
        ({"parameter_names": ["J", "alpha", "C_D"], "parameters": [[0.1] * 3] * 2}, r"the card says (fans, 3)"),
    ],
)
def test_a_card_that_does_not_fit_the_graph_is_refused_in_one_line(
    trained: TrainedTwin, tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    path = trained.save(tmp_path / "twin.onnx")
    file = onnx.load(path)
    helper.set_model_props(file, {CARD_PROPERTY: json.dumps(json.loads(trained.card.to_json()) | changes)})
    onnx.save(file, path)
    assert words in refusal(path)

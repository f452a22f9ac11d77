"""The card in the exported file, and files that are not one. The graph itself: contracts/test_model_kinds.py."""

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
from fantwin.twin.export.onnx_twin import OnnxTwin
from fantwin.twin.finishing import TrainedTwin
from tests.support import fan_data
from tests.support.made_once import TrainedOnce

CREATED = datetime(2026, 1, 1, tzinfo=UTC)


@pytest.fixture(scope="module")
def trained(trained_once: TrainedOnce) -> TrainedTwin:
    run = fan_data.published_run(1, 20.0, fans=2)
    data = [DataCard("bench.csv", "ab" * 32, run.fans, run.samples)]
    return trained_once([run], [], "physical", name="bench", command_unit="%", data=data, created=CREATED)


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

"""pipeline.twin_file: a twin is loaded whole, or refused in one line that says what to do."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from pipeline.stage import StageError
from pipeline.twin_file import CARD_PROPERTY, TwinFile
from tests.twin_files import PARAMETERS, SIGMA_RAD_S, small_hybrid, write_twin
from twin import physics
from twin.integration import free_run
from twin.neural_ode import NeuralOde


def _refusal(path: Path, fans: int = 2) -> str:
    with pytest.raises(StageError) as caught:
        TwinFile.load(path, fans)
    line = str(caught.value)
    assert line.startswith(str(path))
    assert "\n" not in line
    return line


def test_the_card_is_read_and_the_file_is_named_by_its_hash(tmp_path: Path) -> None:
    path = write_twin(tmp_path / "twin.onnx", fans=2)
    twin = TwinFile.load(path, 2)
    assert (twin.name, twin.kind, twin.fans, twin.rate_hz) == ("made up physical", "physical", 2, 100.0)
    assert twin.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert json.loads(twin.card_json)["kind"] == "physical"
    np.testing.assert_allclose(twin.sigma_rad_s, [SIGMA_RAD_S, 1.05 * SIGMA_RAD_S])
    assert not twin.is_discrete


def test_each_fan_runs_with_its_own_parameters(tmp_path: Path) -> None:
    twin = TwinFile.load(write_twin(tmp_path / "twin.onnx", fans=2), 2)
    command, step_s = np.full((50, 2), 40.0), np.full(50, 0.01)
    speed, state = twin.advance(twin.initial_state(np.array([10.0, 20.0]), command[0]), command, step_s)
    parameters = np.array(PARAMETERS) * np.array([[1.0], [1.05]])
    expected, last = free_run(
        lambda w, u: physics.acceleration(w, u, parameters), np.array([10.0, 20.0]), command, step_s
    )
    np.testing.assert_allclose(speed, expected, rtol=1e-12)
    np.testing.assert_allclose(state[:, 0], last, rtol=1e-12)


def test_a_twin_of_one_fan_serves_every_fan_of_the_tray(tmp_path: Path) -> None:
    path = write_twin(tmp_path / "twin.onnx", small_hybrid())
    command, step_s = np.full((50, 1), 40.0), np.full(50, 0.01)
    one, five = TwinFile.load(path, 1), TwinFile.load(path, 5)
    speed, _ = one.advance(np.zeros((1, 1)), command, step_s)
    speeds, _ = five.advance(np.zeros((5, 1)), np.repeat(command, 5, axis=1), step_s)
    assert five.sigma_rad_s.shape == (5,)
    np.testing.assert_allclose(speeds, np.repeat(speed, 5, axis=1), rtol=1e-12)


def test_a_state_of_past_values_is_filled_with_the_start(tmp_path: Path) -> None:
    path = write_twin(tmp_path / "twin.onnx")
    twin = TwinFile.load(path, 2)
    layout = twin.layout.model_copy(update={"speed": 3, "command": 2})
    past = TwinFile(**{**vars(twin), "layout": layout})
    assert past.is_discrete
    state = past.initial_state(np.array([1.0, 2.0]), np.array([8.0, 9.0]))
    np.testing.assert_array_equal(state, [[1, 1, 1, 8, 8], [2, 2, 2, 9, 9]])


def test_a_kind_that_needs_no_parameters_is_loaded_all_the_same(tmp_path: Path) -> None:
    twin = TwinFile.load(write_twin(tmp_path / "twin.onnx", NeuralOde(small_hybrid().network)), 3)
    speed, _ = twin.advance(np.zeros((3, 1)), np.full((2, 3), 40.0), np.full(2, 0.01))
    assert np.isfinite(speed).all()


def test_a_missing_file_is_refused(tmp_path: Path) -> None:
    assert "No such file" in _refusal(tmp_path / "none.onnx")


@pytest.mark.parametrize("content", [b"", b"speed,command\n1,2\n", bytes(range(256))])
def test_a_file_that_is_not_onnx_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "twin.onnx"
    path.write_bytes(content)
    assert "not an ONNX file" in _refusal(path)


def _identity(path: Path, card: str | None) -> Path:
    value = [helper.make_tensor_value_info(name, TensorProto.DOUBLE, ["n"]) for name in ("x", "y")]
    graph = helper.make_graph([helper.make_node("Identity", ["x"], ["y"])], "g", value[:1], value[1:])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    if card is not None:
        helper.set_model_props(model, {CARD_PROPERTY: card})
    onnx.save(model, str(path))
    return path


def test_an_onnx_file_without_a_card_is_refused(tmp_path: Path) -> None:
    assert "not a twin" in _refusal(_identity(tmp_path / "other.onnx", None))


def test_a_card_on_another_graph_is_refused(tmp_path: Path) -> None:
    twin = TwinFile.load(write_twin(tmp_path / "twin.onnx"), 2)
    assert "inputs x and outputs y" in _refusal(_identity(tmp_path / "other.onnx", twin.card_json))


def test_a_newer_format_is_refused_even_if_its_card_looks_different(tmp_path: Path) -> None:
    assert "update fantwin" in _refusal(write_twin(tmp_path / "a.onnx", format_version=2))
    assert "update fantwin" in _refusal(write_twin(tmp_path / "b.onnx", format_version=2, sigma_rad_s=None))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"sigma_rad_s": None}, "sigma_rad_s"),
        ({"sigma_rad_s": [0.0]}, "sigma_rad_s"),
        ({"parameters": [[0.1, 0.1, 0.1]] * 2}, "parameters"),
        ({"command_range": [1.0, 0.0]}, "command_range"),
        ({"n_state": 2}, "state_layout"),
        ({"n_state": 2, "state_layout": {"speed": 2, "command": 0}}, "state"),
    ],
)
def test_a_card_that_makes_no_sense_is_refused_by_name(tmp_path: Path, changes: dict[str, Any], named: str) -> None:
    assert named in _refusal(write_twin(tmp_path / "twin.onnx", **changes))


def test_text_in_place_of_a_card_is_refused(tmp_path: Path) -> None:
    assert "card cannot be used" in _refusal(_identity(tmp_path / "other.onnx", "not JSON"))


def test_a_twin_of_two_fans_does_not_serve_three(tmp_path: Path) -> None:
    assert "fans = 3" in _refusal(write_twin(tmp_path / "twin.onnx", fans=2), fans=3)

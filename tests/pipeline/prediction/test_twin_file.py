"""pipeline.prediction.twin_file: a twin is loaded whole, or refused in one line that says what to do."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper

from fantwin.pipeline.prediction import twin_file
from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.pipeline.runtime.stage import StageError
from fantwin.schemas.twin_card import CARD_PROPERTY
from fantwin.twin.models.physical import PhysicalModel
from tests.support.random_models import random_narx
from tests.support.twin_files import PARAMETERS, SIGMA_COMMAND, SIGMA_RAD_S, made_up_balance, write_twin


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
    assert (twin.card.name, twin.card.kind, twin.fans, twin.card.rate_hz) == ("made up physical", "physical", 2, 100.0)
    assert twin.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    assert json.loads(twin.card_json)["kind"] == "physical"
    np.testing.assert_allclose(twin.sigma_rad_s, [SIGMA_RAD_S, 1.05 * SIGMA_RAD_S])
    assert not twin.card.fixed_rate


def test_each_fan_runs_with_its_own_parameters_and_lag(tmp_path: Path) -> None:
    twin = TwinFile.load(write_twin(tmp_path / "twin.onnx", fans=2), 2)
    command, step_s = np.full((50, 2), 40.0), np.full(50, 0.01)
    start = twin.initial_state(np.array([10.0, 20.0]), np.array([0.0, 5.0]))
    parameters = np.array(PARAMETERS) * np.array([[1.0], [1.05]])
    expected, last = PhysicalModel().advance(start, command, step_s, parameters)
    speed, state = twin.advance(start, command, step_s)
    np.testing.assert_allclose(speed, expected, rtol=1e-12)
    np.testing.assert_allclose(state, last, rtol=1e-12)


def test_the_balance_of_each_fan_is_read_and_that_of_one_fan_holds_for_all(tmp_path: Path) -> None:
    two = TwinFile.load(write_twin(tmp_path / "two.onnx", fans=2), 2).balance
    inertia, viscous, drag, lag_s = np.array(PARAMETERS)[:, np.newaxis] * [1.0, 1.05]
    for value, expected in ((two.inertia, inertia), (two.viscous, viscous), (two.drag, drag), (two.lag_s, lag_s)):
        np.testing.assert_allclose(value, expected)
    assert two.filter_rate_per_s == 3.0
    five = TwinFile.load(write_twin(tmp_path / "one.onnx"), 5).balance
    for array in (five.inertia, five.friction, five.sigma_command):
        assert array.shape == (5,)
        assert np.ptp(array) == 0.0
    np.testing.assert_allclose(five.sigma_command, SIGMA_COMMAND)


def test_an_invalid_balance_is_refused_by_name(tmp_path: Path) -> None:
    whole = asdict(made_up_balance((PARAMETERS,)))
    for changes, named in (
        ({"sigma_command": [0.0]}, "balance.sigma_command"),
        ({"inertia": [0.1, 0.1]}, "balance.inertia must have one value for each fan"),
        ({"covariance": [[[1.0, 1.0, 1.0]] * 4]}, "balance.covariance"),
        ({"filter_rate_per_s": 0.0}, "balance.filter_rate_per_s"),
        ({"covariance": [np.diag([1.0, 1.0, -1.0, 1.0]).tolist()]}, "no variance below zero"),
        ({"covariance": [np.triu(np.ones((4, 4))).tolist()]}, "must be symmetric"),
    ):
        assert named in _refusal(write_twin(tmp_path / "twin.onnx", balance=whole | changes))
    assert "balance" in _refusal(write_twin(tmp_path / "twin.onnx", balance=None))


def test_a_continuous_twin_starts_with_its_lagged_command_settled_and_a_discrete_one_with_a_past_of_it(
    tmp_path: Path,
) -> None:
    start = np.array([1.0, 2.0]), np.array([8.0, 9.0])
    twin = TwinFile.load(write_twin(tmp_path / "twin.onnx"), 2)
    assert not twin.card.fixed_rate
    np.testing.assert_array_equal(twin.initial_state(*start), [[1.0, 8.0], [2.0, 9.0]])
    twin = TwinFile.load(write_twin(tmp_path / "twin.onnx", random_narx()), 2)
    assert twin.card.fixed_rate
    state = twin.initial_state(*start)
    np.testing.assert_array_equal(state, [[1.0] * 10 + [8.0] * 10, [2.0] * 10 + [9.0] * 10])
    speed, _ = twin.advance(state, np.full((2, 2), 40.0), np.full(2, 0.01))
    assert np.isfinite(speed).all()


def test_a_file_that_is_no_twin_is_refused(tmp_path: Path) -> None:
    assert "No such file" in _refusal(tmp_path / "none.onnx")
    path = tmp_path / "twin.onnx"
    for content in (b"", b"speed,command\n1,2\n"):
        path.write_bytes(content)
        assert "not an ONNX file" in _refusal(path)
    assert "not a twin" in _refusal(_identity(tmp_path / "other.onnx", None))
    assert "card cannot be used" in _refusal(_identity(tmp_path / "other.onnx", "not JSON"))
    twin = TwinFile.load(write_twin(path, fans=2), 2)
    assert "inputs x and outputs y" in _refusal(_identity(tmp_path / "other.onnx", twin.card_json))
    assert "fans = 3" in _refusal(path, fans=3)
    assert "update fantwin" in _refusal(write_twin(path, format=2, sigma_rad_s=None)), (
        "even if its card looks different"
    )
    line = _refusal(write_twin(path, format=None, parameters=[[0.15, 0.12, 0.0005]], n_state=1))
    assert "a twin card without a format number; this fantwin reads format 1: train the twin again" in line


def _identity(path: Path, card: str | None) -> Path:
    value = [helper.make_tensor_value_info(name, TensorProto.DOUBLE, ["n"]) for name in ("x", "y")]
    graph = helper.make_graph([helper.make_node("Identity", ["x"], ["y"])], "g", value[:1], value[1:])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    if card is not None:
        helper.set_model_props(model, {CARD_PROPERTY: card})
    onnx.save(model, str(path))
    return path


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"sigma_rad_s": None}, "sigma_rad_s"),
        ({"sigma_rad_s": [0.0]}, "sigma_rad_s"),
        ({"parameters": [[0.1, 0.1, 0.1, 0.0]] * 2}, "parameters"),
        ({"parameters": [[0.1, 0.1, 0.1]]}, "parameters"),
        (
            {"parameters": [[0.1, 0.1, 0.1]], "parameter_names": ["J", "alpha", "C_D"]},
            "parameters is ['fans', 4], the card says (fans, 3)",
        ),
        ({"rate_hz": 0.0}, "rate_hz"),
        ({"command_range": [1.0, 0.0]}, "command_range"),
        ({"n_state": 3}, "state_layout"),
        ({"n_state": 1, "state_layout": {"speed": 1, "command": 0}}, "state is ['fans', 2], the card says (fans, 1)"),
    ],
)
def test_an_invalid_card_is_refused_by_name(tmp_path: Path, changes: dict[str, Any], named: str) -> None:
    assert named in _refusal(write_twin(tmp_path / "twin.onnx", **changes))


def test_a_truncated_file_is_refused_wherever_it_was_cut(tmp_path: Path) -> None:
    path = write_twin(tmp_path / "twin.onnx", fans=2)
    whole = path.read_bytes()
    for length in np.linspace(0, len(whole) - 1, 15).astype(int):
        path.write_bytes(whole[:length])
        _refusal(path)


def _of_the_right_names(path: Path, dtype: int, nodes: list[onnx.NodeProto], card: str) -> Path:
    shapes: dict[str, list[str | int]] = {
        "state": ["fans", 2],
        "command": ["n", "fans"],
        "step_s": ["n"],
        "parameters": ["fans", 4],
        "speed_rad_s": ["n", "fans"],
        "state_out": ["fans", 2],
    }
    values = [helper.make_tensor_value_info(name, dtype, shape) for name, shape in shapes.items()]
    graph = helper.make_graph(nodes, "g", values[:4], values[4:])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, {CARD_PROPERTY: card})
    onnx.save(model, str(path))
    return path


@pytest.mark.parametrize(
    ("dtype", "second", "named"),
    [
        (TensorProto.FLOAT, ("Identity", ["state"]), "state is tensor(float), expected tensor(double)"),
        (TensorProto.DOUBLE, ("MatMul", ["state", "parameters"]), "the twin does not run"),
        (TensorProto.DOUBLE, ("MatMul", ["state", "command"]), "the twin gives speeds"),
    ],
)
def test_a_graph_that_only_looks_like_a_twin_is_refused(
    tmp_path: Path, dtype: int, second: tuple[str, list[str]], named: str
) -> None:
    card = TwinFile.load(write_twin(tmp_path / "twin.onnx", fans=3), 3).card_json
    nodes = [
        helper.make_node("Identity", ["command"], ["speed_rad_s"]),
        helper.make_node(second[0], second[1], ["state_out"]),
    ]
    assert named in _refusal(_of_the_right_names(tmp_path / "other.onnx", dtype, nodes, card), fans=3)


def test_row_17_a_twin_with_an_endless_loop_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(twin_file, "FIRST_RUN_LIMIT_S", 0.2)
    card = TwinFile.load(write_twin(tmp_path / "twin.onnx", fans=3), 3).card_json
    scalar, state = (
        helper.make_tensor_value_info("", *of) for of in ((TensorProto.BOOL, []), (TensorProto.DOUBLE, None))
    )
    values = {}
    for name, like in {"count": scalar, "go": scalar, "goes": scalar, "x": state, "y": state}.items():
        values[name] = onnx.ValueInfoProto()
        values[name].CopyFrom(like)
        values[name].name = name
    values["count"].type.tensor_type.elem_type = TensorProto.INT64
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["goes"]), helper.make_node("Identity", ["x"], ["y"])],
        "body",
        [values["count"], values["go"], values["x"]],
        [values["goes"], values["y"]],
    )
    nodes = [
        helper.make_node("Identity", ["command"], ["speed_rad_s"]),
        helper.make_node("Constant", [], ["start"], value=helper.make_tensor("start", TensorProto.BOOL, [], [True])),
        helper.make_node("Loop", ["", "start", "state"], ["state_out"], body=body),
    ]
    path = _of_the_right_names(tmp_path / "endless.onnx", TensorProto.DOUBLE, nodes, card)
    assert "the twin takes more than 0.2 s for two samples; export it again" in _refusal(path, fans=3)


def test_row_17_a_file_that_is_too_large_for_a_twin_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "twin.onnx"
    with path.open("wb") as file:
        file.truncate(1 << 40)
    assert "larger than 67,108,864 bytes, so not a twin" in _refusal(path)

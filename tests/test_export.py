"""The exported file against the model in numpy and in torch, and files that are not one."""

import json
from datetime import UTC, datetime
from pathlib import Path

import fan_data
import numpy as np
import onnx
import pytest
import torch
from onnx import helper
from test_models import ALL_MODELS, PARAMETERS, random_network

from twin.build import TrainedTwin, evaluate, train_twin
from twin.card import CARD_KEY, Card, DataCard
from twin.errors import TwinError
from twin.export import export_onnx
from twin.hybrid import Hybrid
from twin.neural_ode import NeuralOde
from twin.onnx_twin import OnnxTwin
from twin.torch_reference import torch_free_run

MINUTE = 6000
CREATED = datetime(2026, 1, 1, tzinfo=UTC)


@pytest.fixture(scope="module")
def trained() -> TrainedTwin:
    run = fan_data.published_run(1, 20.0, fans=2)
    data = [DataCard("bench.csv", "ab" * 32, run.fans, run.samples)]
    return train_twin([run], [], "physical", name="bench", command_unit="%", data=data, created=CREATED)


def saved(model, card: Card, folder: Path) -> OnnxTwin:
    fields = json.loads(card.to_json())
    fields |= {"kind": model.kind, "n_state": model.state_layout.size}
    fields["state_layout"] = {"speed": model.state_layout.speed, "command": model.state_layout.command}
    path = folder / f"{model.kind}.onnx"
    path.write_bytes(export_onnx(model, Card.from_json(json.dumps(fields))))
    return OnnxTwin(path)


def minute_of_commands() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(9)
    return fan_data.random_stairs(rng, MINUTE, 2), rng.uniform(0.008, 0.012, MINUTE)


@pytest.mark.parametrize("model", ALL_MODELS, ids=lambda model: model.kind)
def test_the_file_runs_a_minute_as_numpy_does(model, trained: TrainedTwin, tmp_path: Path) -> None:
    command, step_s = minute_of_commands()
    twin = saved(model, trained.card, tmp_path)
    state = model.state_layout.initial_state(np.array([20.0, 90.0]), command[0])
    expected, expected_state = model.advance(state, command, step_s, PARAMETERS)
    speed, state_out = twin.advance(state, command, step_s, PARAMETERS)
    np.testing.assert_allclose(speed, expected, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(state_out, expected_state, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "model",
    [Hybrid(random_network(10)), Hybrid(random_network(10, ("speed",))), NeuralOde(random_network(20))],
    ids=["hybrid", "hybrid on speed alone", "neural-ode"],
)
def test_the_file_runs_a_minute_as_torch_does(model, trained: TrainedTwin, tmp_path: Path) -> None:
    command, step_s = minute_of_commands()
    initial = np.array([20.0, 90.0])
    with torch.no_grad():
        arrays = (model.network.theta, PARAMETERS, initial, command, step_s)
        expected = torch_free_run(model, *(torch.from_numpy(array) for array in arrays)).numpy()
    speed, _ = saved(model, trained.card, tmp_path).advance(initial[:, None], command, step_s, PARAMETERS)
    np.testing.assert_allclose(speed, expected, rtol=1e-5)


@pytest.mark.parametrize("model", ALL_MODELS, ids=lambda model: model.kind)
def test_two_blocks_with_the_state_carried_are_one_block(model, trained: TrainedTwin, tmp_path: Path) -> None:
    command, step_s = (values[:300] for values in minute_of_commands())
    twin = saved(model, trained.card, tmp_path)
    state = model.state_layout.initial_state(np.zeros(2), command[0])
    whole, last = twin.advance(state, command, step_s, PARAMETERS)
    first, middle = twin.advance(state, command[:1], step_s[:1], PARAMETERS)
    second, end = twin.advance(middle, command[1:], step_s[1:], PARAMETERS)
    np.testing.assert_array_equal(np.concatenate((first, second)), whole)
    np.testing.assert_array_equal(end, last)


def test_the_graph_keeps_the_contract(trained: TrainedTwin, tmp_path: Path) -> None:
    graph = onnx.load(trained.save(tmp_path / "twin.onnx")).graph

    def shapes(values) -> dict[str, list[str | int]]:
        return {
            value.name: [axis.dim_param or axis.dim_value for axis in value.type.tensor_type.shape.dim]
            for value in values
        }

    assert shapes(graph.input) == {
        "state": ["fans", 1],
        "command": ["n", "fans"],
        "step_s": ["n"],
        "parameters": ["fans", 3],
    }
    assert shapes(graph.output) == {"speed_rad_s": ["n", "fans"], "state_out": ["fans", 1]}


def test_the_card_travels_in_the_file(trained: TrainedTwin, tmp_path: Path) -> None:
    card = OnnxTwin(trained.save(tmp_path / "twin.onnx")).card
    assert card == trained.card
    assert card.created == "2026-01-01T00:00:00+00:00"
    assert card.command_unit == "%"
    assert card.training.data[0].sha256 == "ab" * 32
    assert card.rate_hz == pytest.approx(100.0)
    np.testing.assert_array_equal(card.parameters, trained.parameters)


def test_evaluating_the_file_is_evaluating_the_twin(trained: TrainedTwin, tmp_path: Path) -> None:
    run = fan_data.published_run(2, 10.0, fans=2)
    from_file, from_memory = evaluate(trained.save(tmp_path / "twin.onnx"), [run]), evaluate(trained, [run])
    assert from_file.pooled.rmse_rad_s == pytest.approx(from_memory.pooled.rmse_rad_s, rel=1e-9)
    assert from_file.pooled.one_step_rmse_rad_s == pytest.approx(from_memory.pooled.one_step_rmse_rad_s, rel=1e-9)


def test_the_same_model_and_card_give_the_same_bytes(trained: TrainedTwin) -> None:
    assert export_onnx(trained.model, trained.card) == export_onnx(trained.model, trained.card)


def foreign_model(path: Path) -> None:
    value = helper.make_tensor_value_info("x", onnx.TensorProto.DOUBLE, ["n"])
    out = helper.make_tensor_value_info("y", onnx.TensorProto.DOUBLE, ["n"])
    graph = helper.make_graph([helper.make_node("Abs", ["x"], ["y"])], "abs", [value], [out])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)


def test_a_file_that_is_not_a_twin_is_refused_in_one_line(trained: TrainedTwin, tmp_path: Path) -> None:
    text, foreign = tmp_path / "notes.txt", tmp_path / "abs.onnx"
    text.write_text("not a model")
    foreign_model(foreign)
    old = onnx.load(trained.save(tmp_path / "old.onnx"))
    fields = json.loads(trained.card.to_json())
    helper.set_model_props(old, {CARD_KEY: json.dumps(fields | {"format_version": 99})})
    onnx.save(old, tmp_path / "old.onnx")
    for path, words in (
        (tmp_path / "absent.onnx", "no such file"),
        (text, "not an ONNX file"),
        (foreign, "not a fantwin twin"),
        (tmp_path / "old.onnx", "format_version 99"),
    ):
        with pytest.raises(TwinError, match=words) as refusal:
            OnnxTwin(path)
        assert str(path) in str(refusal.value)
        assert "\n" not in str(refusal.value)


def test_a_card_with_a_field_missing_or_wrong_names_it(trained: TrainedTwin) -> None:
    fields = json.loads(trained.card.to_json())
    with pytest.raises(TwinError, match="rate_hz is wrong"):
        Card.from_json(json.dumps(fields | {"rate_hz": "fast"}))
    del fields["fans"]
    with pytest.raises(TwinError, match="fans is wrong: Field required"):
        Card.from_json(json.dumps(fields))

"""A kind of model is added by a class and one row: it is trained, exported, loaded by the runtime and run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from onnx import helper

from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.messages import Prediction
from fantwin.schemas.twin_card import NetworkCard, StateLayout
from fantwin.stages.twin_integrator import TwinIntegratorConfig, TwinIntegratorCore
from fantwin.twin import kinds
from fantwin.twin.build import evaluate, train_twin
from fantwin.twin.export.onnx_twin import OnnxTwin
from fantwin.twin.finishing import TrainedTwin
from fantwin.twin.fitting.model_fits import FitRequest, FittedModel
from fantwin.twin.models.onnx_nodes import Nodes, double
from fantwin.twin.report.content import SpeedUnit, report_content
from fantwin.twin.report.page import report_page
from fantwin.twin.runs import Array, Run
from tests.support import fan_data
from tests.support.integrated_twins import grid_of


@dataclass(frozen=True)
class FirstOrder:
    """w[k + 1] = decay w[k] + gain u[k]: a discrete fan without physics."""

    decay: float
    gain: float
    state_layout: StateLayout = StateLayout(speed=1, command=0)

    kind: ClassVar[str] = "first-order"
    fixed_rate: ClassVar[bool] = True
    used_parameters: ClassVar[tuple[str, ...]] = ()

    @property
    def network_card(self) -> NetworkCard:
        return NetworkCard(units=0, inputs=(), parameter_count=0)

    def advance(self, state: Array, command: Array, step_s: Array, parameters: Array) -> tuple[Array, Array]:
        speeds = [state[:, 0]]
        for held in command:
            speeds.append(self.decay * speeds[-1] + self.gain * held)
        return np.stack(speeds[:-1]), speeds[-1][:, np.newaxis]

    def graph(self) -> Nodes:
        block, body = Nodes(), Nodes("step/")
        column = body.add("Unsqueeze", ["command_k", body.constant("axis", [1], np.int64)], "command")
        kept = body.add("Mul", ["state_k", body.constant("decay", self.decay)], "kept")
        driven = body.add("Mul", [column, body.constant("gain", self.gain)], "driven")
        following = body.add("Add", [kept, driven], "state_next")
        present = body.add("Squeeze", ["state_k", body.constant("row", [1], np.int64)], "speed_now")
        one_step = helper.make_graph(
            body.nodes,
            "one_step",
            [double("state_k", ["fans", 1]), double("command_k", ["fans"])],
            [double(following, ["fans", 1]), double(present, ["fans"])],
            body.constants,
        )
        block.scan(one_step, ["state"], ["command"], ["state_out"], "speed_rad_s")
        return block


def fit_first_order(request: FitRequest) -> FittedModel:
    """Least squares of each speed on the speed and the command before."""
    pairs = [np.column_stack((run.speed_rad_s[:-1, 0], run.command[:-1, 0])) for run in request.runs]
    after = [run.speed_rad_s[1:, 0] for run in request.runs]
    (decay, gain), *_ = np.linalg.lstsq(np.concatenate(pairs), np.concatenate(after))
    return FittedModel(FirstOrder(float(decay), float(gain)), request.identification.parameters, iterations=1)


def linear_run(seed: int) -> Run:
    """20 s of two equal fans of first order, almost without noise."""
    rng = np.random.default_rng(seed)
    command = np.repeat(fan_data.stairs(rng, 2000, 1), 2, axis=1)
    speed, _ = FirstOrder(0.97, 0.06).advance(np.zeros((2, 1)), command, np.full(2000, 0.01), np.zeros((2, 4)))
    return Run("linear", np.arange(2000) / 100.0, command, speed + rng.normal(0.0, 0.1, speed.shape))


@pytest.fixture(scope="module")
def trained() -> Iterator[TrainedTwin]:
    row = kinds.ModelKind("first-order", "first order", fit_first_order)
    kinds.KINDS.append(row)
    yield train_twin([linear_run(1)], [linear_run(2)], "first-order", name="toy")
    kinds.KINDS.remove(row)


def test_an_added_model_is_trained_and_reported_and_its_file_runs_alike(trained: TrainedTwin, tmp_path: Path) -> None:
    assert isinstance(trained.model, FirstOrder)
    assert trained.model.decay == pytest.approx(0.97, rel=1e-3)
    assert trained.validation.pooled.rmse_rad_s < 0.3
    assert trained.card.kind == "first-order"
    path, run = trained.save(tmp_path / "toy.onnx"), linear_run(3)
    from_file, from_memory = evaluate(path, [run]), evaluate(trained, [run])
    assert from_file.pooled.rmse_rad_s == pytest.approx(from_memory.pooled.rmse_rad_s, rel=1e-9)
    page = report_page(report_content(OnnxTwin(path), [run], [], SpeedUnit("rad/s", 1.0)))
    assert "first order" in page


def test_the_runtime_loads_and_runs_it_by_its_card_alone(trained: TrainedTwin, tmp_path: Path) -> None:
    path = trained.save(tmp_path / "toy.onnx")
    twin = TwinFile.load(path, 2)
    run = linear_run(4)
    core = TwinIntegratorCore(twin, TwinIntegratorConfig(warm_up_s=0.5), 0)
    (prediction,) = (
        message for message in core.step(grid_of(run.command, run.speed_rad_s)) if isinstance(message, Prediction)
    )
    assert (prediction.invalid_reason[100:] == InvalidReason.NONE).all()
    error = prediction.measured_speed_rad_s - prediction.predicted_speed_rad_s
    assert np.sqrt(np.mean(error[100:] ** 2)) < 0.3

"""A twin in PyTorch is the twin in its file, and its gradients are those of what it computes."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import fantwin
from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.schemas.twin_card import DriveCard, NetworkCard
from fantwin.twin.errors import TwinError
from fantwin.twin.export.onnx_export import export_onnx
from fantwin.twin.models.drive import DRIVE_PARAMETERS, Drive
from fantwin.twin.models.fan_ode import FanOde
from fantwin.twin.models.narx import Narx
from fantwin.twin.models.network import Scaling, TanhNetwork
from fantwin.twin.models.neural_ode import NeuralOde
from fantwin.twin.models.physical import PhysicalModel
from fantwin.twin.models.physics import PARAMETER_NAMES
from tests.support.twin_files import made_up_card, small_hybrid, write_twin

FANS, PERIOD_S = 3, 0.01
DRIVE = Drive(turning_command=20.0, kick_s=0.15, rest_s=0.4)


@pytest.fixture(scope="module")
def torch() -> Any:
    """It takes seconds to import, which the other tests of a worker need not wait for."""
    return import_module("torch")


def network(units: int = 6) -> TanhNetwork:
    hybrid = small_hybrid().network
    return TanhNetwork(units, hybrid.inputs, Scaling(150.0, 150.0, 50.0, 50.0, 300.0), hybrid.theta)


def written(folder: Path, model: FanOde | Narx) -> fantwin.Twin:
    card = made_up_card(model, FANS)
    if isinstance(model, FanOde) and model.network:
        card = replace(card, network=NetworkCard(6, model.network.inputs, model.network.parameter_count))
    if isinstance(model, FanOde) and model.drive:
        card = replace(
            card,
            parameters=tuple((0.15, 0.12, 0.0005, 0.02 * fan, 30.0, 1.0 + fan, 60.0) for fan in range(FANS)),
            parameter_names=(*PARAMETER_NAMES, *DRIVE_PARAMETERS),
            drive=DriveCard(model.drive.turning_command, model.drive.kick_s, model.drive.rest_s, (30.0,) * FANS),
        )
    return fantwin.Twin(export_onnx(model, card))


def stairs(fans: int, low: float, high: float, samples: int = 300) -> np.ndarray:
    rng = np.random.default_rng(3)
    return np.repeat(rng.uniform(low, high, (samples // 20, fans)), 20, axis=0)


def largest_difference(
    torch: Any, twin: fantwin.Twin, initial: np.ndarray, commands: np.ndarray, period_s: float
) -> float:
    """Between the module and the file, relative to the highest speed."""
    file = TwinFile.of_content(Path("twin"), twin.content)
    state, step_s = file.initial_state(initial, commands[0]), np.full(len(commands), period_s)
    expected, _ = file.advance(state, commands, step_s)
    found = twin.as_torch().free_run(torch.tensor(initial), torch.tensor(commands), period_s).detach().numpy()
    assert np.ptp(expected, axis=0).min() > 1.0, "the fans must move"
    return float(np.abs(found - expected).max() / np.abs(expected).max())


@pytest.mark.parametrize(
    "model",
    [
        PhysicalModel(),
        small_hybrid(),
        NeuralOde(network()),
        small_hybrid().with_drive(DRIVE),
        PhysicalModel().with_drive(DRIVE),
    ],
    ids=lambda model: f"{model.kind}{' behind a drive' if model.drive else ''}",
)
def test_the_module_computes_what_the_file_computes(torch, tmp_path, model):
    twin = written(tmp_path, model)
    commands = stairs(FANS, 0.0, 100.0)  # the drive stops, starts with a kick, and keeps its lowest speed
    assert largest_difference(torch, twin, np.linspace(100.0, 200.0, FANS), commands, PERIOD_S) < 1e-12


def test_the_twin_of_the_demo_is_the_same_also_in_longer_steps_and_for_more_fans(torch, tmp_path):
    twin, commands = fantwin.load(), stairs(8, 0.2, 0.9)
    assert largest_difference(torch, twin, np.full(8, 400.0), commands, 0.01) < 1e-12
    module, initial = twin.as_torch(), torch.full((8,), 400.0, dtype=torch.float64)
    coarse = module.free_run(initial, torch.tensor(commands[::20]), 0.2)
    assert torch.allclose(coarse, module.free_run(initial, torch.tensor(commands), 0.01)[::20])
    one = fantwin.load(write_twin(tmp_path / "one.onnx")).as_torch()
    assert one.free_run(torch.zeros(5, dtype=torch.float64), torch.ones(7, 5, dtype=torch.float64), 0.01).shape == (
        7,
        5,
    )


@pytest.mark.parametrize("model", [small_hybrid(), PhysicalModel().with_drive(DRIVE)], ids=["hybrid", "drive"])
def test_gradients_are_those_of_what_is_computed(torch, tmp_path, model):
    module = written(tmp_path, model).as_torch()
    initial = torch.tensor([100.0, 150.0, 200.0], dtype=torch.float64, requires_grad=True)
    commands = torch.tensor(stairs(FANS, 25.0, 90.0, 40)[::4], requires_grad=True)

    class Run(torch.nn.Module):
        """The free run as what a module does."""

        def __init__(self) -> None:
            super().__init__()
            self.of = module

        def forward(self, *inputs: Any) -> Any:
            return self.of.free_run(*inputs)

    assert torch.autograd.gradcheck(partial(module.free_run, period_s=0.02), (initial, commands), fast_mode=True)
    assert torch.autograd.gradcheck(module, (initial, commands[0].detach().requires_grad_()))
    for parameter in module.parameters():

        def of_parameter(values: Any, parameter=parameter) -> Any:
            name = next(name for name, each in module.named_parameters() if each is parameter)
            inputs = (initial.detach(), commands.detach(), 0.02)
            return torch.func.functional_call(Run(), {f"of.{name}": values}, inputs)

        assert torch.autograd.gradcheck(of_parameter, (parameter.detach().clone().requires_grad_(),), fast_mode=True)


def test_its_parameters_are_relative_physics_and_the_weights(torch, tmp_path):
    module = fantwin.load().as_torch()
    assert {name: tuple(each.shape) for name, each in module.named_parameters()} == {
        "physics": (8, 3),
        "weights": (41,),
    }
    speed, command = (torch.full((8,), value, dtype=torch.float64) for value in (600.0, 0.6))
    before = module(speed, command)
    assert module.physics is not None
    with torch.no_grad():
        module.physics[:, 2] = 1.3
    trained = torch.tensor(fantwin.load().card.parameters, dtype=torch.float64)
    assert torch.allclose(before - module(speed, command), 0.3 * trained[:, 2] * 600.0**2 / trained[:, 0])
    assert written(tmp_path, PhysicalModel()).as_torch().weights is None


def test_what_cannot_be_a_module_is_refused(tmp_path, monkeypatch):
    narx = fantwin.load(write_twin(tmp_path / "narx.onnx", Narx(np.zeros(1151), Scaling(0, 1, 0, 1, 1))))
    with pytest.raises(fantwin.FantwinError, match="a narx twin is not continuous in time"):
        narx.as_torch()
    monkeypatch.setattr("fantwin.pipeline.extras.is_installed", lambda module: module != "torch")
    with pytest.raises(fantwin.FantwinError, match=r"as_torch\(\) needs PyTorch: .*pip install torch"):
        narx.as_torch()


SPEEDS, COMMANDS = (FANS, 100.0), (30, FANS, 60.0)
"""a shape and a value"""
REFUSED: dict[str, tuple[Any, tuple[float, ...], str]] = {
    "one command for each fan": (SPEEDS, (FANS, 60.0), r"commands must be \(n, 3\), not \(3,\)"),
    "turned": (SPEEDS, (FANS, 30, 60.0), r"commands must be \(n, 3\), not \(3, 30\)"),
    "one fan": ((1, 100.0), COMMANDS, r"initial_speed must be a tensor \(3,\).* not \(1,\)"),
    "a number": (100.0, COMMANDS, r"initial_speed must be a tensor \(3,\).* not 100.0"),
    "rpm": ((FANS, 1000.0), COMMANDS, "convert it to rad/s"),
    "unknown": ((FANS, np.nan), COMMANDS, "convert it to rad/s"),
    "unknown command": (SPEEDS, (30, FANS, np.nan), "commands must be finite"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_free_run_refuses_what_cannot_be_right(torch, tmp_path, case):
    speed, commands, words = REFUSED[case]
    given: list[Any] = [
        each if isinstance(each, float) else torch.full(each[:-1], each[-1]) for each in (speed, commands)
    ]
    module = written(tmp_path, PhysicalModel()).as_torch()
    with pytest.raises(TwinError, match=words):
        module.free_run(*given, period_s=1.0)

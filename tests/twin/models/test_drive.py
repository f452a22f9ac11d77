"""The drive of a fan that controls its own speed: what it makes of a command, in numpy and in the exported graph."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fantwin.twin.build import train_twin
from fantwin.twin.export.onnx_export import export_onnx
from fantwin.twin.export.onnx_twin import OnnxTwin
from fantwin.twin.models.drive import DRIVE_LAYOUT, DRIVE_PARAMETERS, Drive
from fantwin.twin.models.fan_ode import FanOde
from fantwin.twin.models.hybrid import Hybrid
from fantwin.twin.models.physical import PhysicalModel
from fantwin.twin.models.physics import PARAMETER_NAMES
from tests.support import fan_data
from tests.support.random_models import random_network

DRIVE = Drive(turning_command=20.0, kick_s=0.6, rest_s=2.0)
SETTINGS = np.array([[50.0, 5.0, 180.0]])


def acting(command: list[float], charge: float = 20.0, step_s: float = 0.1) -> tuple[list[float], float]:
    column = np.array(command)[:, np.newaxis]
    share, after = DRIVE.kick(column, np.full((len(command), 1), step_s), np.array([charge]))
    return DRIVE.effective(column, share, SETTINGS)[:, 0].tolist(), float(after[0])


def test_a_command_acts_above_the_plateau_keeps_the_plateau_below_it_and_stops_the_fan_below_that() -> None:
    assert acting([120.0, 50.0, 30.0, 20.0, 19.9, 0.0])[0] == [115.0, 45.0, 45.0, 45.0, 0.0, 0.0]


def test_a_rested_fan_gets_one_full_kick_and_one_that_was_off_for_less_gets_a_shorter_one() -> None:
    effective, charge = acting([0.0] * 20 + [100.0] * 10)
    np.testing.assert_allclose(effective, [0.0] * 20 + [175.0] * 6 + [95.0] * 4, rtol=1e-12)
    assert charge == 20.0
    assert acting([100.0, 100.0], charge=0.0, step_s=0.4)[0] == pytest.approx([175.0, 0.5 * 175.0 + 0.5 * 95.0])
    effective, _ = acting([0.0] * 10 + [100.0] * 10)
    assert np.sum(np.array(effective[10:]) - 95.0) == pytest.approx(3 * 80.0)
    assert acting([100.0], charge=100.0)[0] == [95.0]


def test_derivatives_by_the_settings_are_those_of_differences() -> None:
    rng = np.random.default_rng(1)
    command = rng.choice([0.0, 30.0, 120.0], 200)[:, np.newaxis]
    share, _ = DRIVE.kick(command, np.full((200, 1), 0.1), np.zeros(1))
    exact = DRIVE.by_settings(command, share, SETTINGS)
    for index in range(len(DRIVE_PARAMETERS)):
        moved = SETTINGS + 1e-6 * np.eye(3)[index]
        difference = (DRIVE.effective(command, share, moved) - DRIVE.effective(command, share, SETTINGS)) / 1e-6
        np.testing.assert_allclose(exact[..., index], difference, atol=1e-6)


@pytest.mark.parametrize("plain", [PhysicalModel(), Hybrid(random_network(10, ("speed", "command")))])
def test_the_exported_graph_has_the_drive_however_a_run_is_cut(plain: FanOde, tmp_path: Path) -> None:
    run = fan_data.published_run(1, 20.0, fans=2)
    card = train_twin([run], [], "physical", name="bench").card
    model = plain.with_drive(Drive(0.2, 0.3, 1.0))
    settings = np.array([[0.3, 0.05, 0.7], [0.4, 0.02, 0.8]])
    parameters = np.hstack((np.array([[*fan_data.PUBLISHED_PARAMETERS, 0.05]] * 2), settings))
    names = (*PARAMETER_NAMES, *DRIVE_PARAMETERS)
    rows = tuple(map(tuple, parameters.tolist()))
    described = replace(
        card, kind=model.kind, n_state=3, state_layout=DRIVE_LAYOUT, parameter_names=names, parameters=rows
    )
    path = tmp_path / "twin.onnx"
    path.write_bytes(export_onnx(model, described))
    exported = OnnxTwin(path)
    rng = np.random.default_rng(2)
    command = np.repeat(rng.choice([0.0, 0.25, 0.5, 1.0], (40, 2)), 10, axis=0)
    step_s, state = np.full(400, 0.05), model.state_layout.initial_state(np.array([10.0, 20.0]), command[0])
    speed, after = model.advance(state, command, step_s, parameters)
    from_file, state_out = exported.advance(state, command, step_s, parameters)
    np.testing.assert_allclose(from_file, speed, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(state_out, after, rtol=1e-9, atol=1e-9)
    first, between = exported.advance(state, command[:133], step_s[:133], parameters)
    second, _ = exported.advance(between, command[133:], step_s[133:], parameters)
    np.testing.assert_array_equal(np.concatenate((first, second)), from_file)

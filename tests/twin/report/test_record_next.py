"""twin.report.assessment: what to record next is where a twin knows least, among what its fan can do."""

from __future__ import annotations

import numpy as np

from fantwin.schemas.model_uncertainty import ModelUncertainty
from fantwin.schemas.twin_card import DriveCard
from fantwin.twin.report.assessment import least_known
from fantwin.twin.report.steady_states import StaticCurve
from tests.support.uncertainty_tables import by_speed

COMMANDS = np.linspace(0.0, 1.0, 11)
CURVE = StaticCurve((), np.column_stack((COMMANDS, 200.0 * COMMANDS)))
SPEEDS_RAD_S = tuple((200.0 * COMMANDS).tolist())


def known(**unknown: float) -> ModelUncertainty:
    """2 rad/s everywhere but at the point of row and column (speed and command), which training has not seen."""
    std = np.full((11, 11), 2.0)
    if unknown:
        std[int(unknown["speed"] / 20.0), round(unknown["command"] * 10)] = unknown["std"]
    return by_speed(SPEEDS_RAD_S, COMMANDS.tolist(), std.tolist(), 2.0)


def test_a_command_never_held_is_advised_first_then_a_step_and_nothing_that_would_tell_little() -> None:
    found = least_known(known(speed=140.0, command=0.7, std=9.0), CURVE, None)
    assert found is not None
    assert (found.command, found.speed_rad_s, found.std_rad_s, found.held) == (COMMANDS[7], SPEEDS_RAD_S[7], 9.0, True)
    found = least_known(known(speed=160.0, command=0.2, std=9.0), CURVE, None)
    assert found is not None
    assert (found.command, found.speed_rad_s, found.held) == (COMMANDS[2], SPEEDS_RAD_S[8], False)
    assert least_known(known(speed=140.0, command=0.7, std=2.9), CURVE, None) is None
    diverging = StaticCurve((), np.column_stack((COMMANDS, np.full(11, np.nan))))
    assert least_known(known(speed=140.0, command=0.7, std=9.0), diverging, None) is None


def test_with_a_drive_commands_on_its_plateau_are_its_end() -> None:
    """The fan turns at 40 rad/s at commands from 0.1 to 0.2, and the table knows the end only."""
    drive = DriveCard(turning_command=0.1, kick_s=0.5, rest_s=1.0, lowest_command=(0.2,))
    on_plateau = np.column_stack((COMMANDS, np.maximum(200.0 * COMMANDS, 40.0)))[1:]
    unknown = known(speed=40.0, command=0.1, std=9.0)
    assert least_known(unknown, StaticCurve((), on_plateau), drive) is None
    assert least_known(unknown, StaticCurve((), on_plateau), None) is not None

"""scoring.diagnosis.current_evidence: a weak drive takes less current, a load more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from scoring.diagnosis.current_evidence import gain_of_current
from scoring.diagnosis.diagnosis import diagnose
from scoring.diagnosis.regression_window import Window
from tests.support.diagnosis_data import HEALTHY, STEP_S, from_onset, measured, moving_command, onset_of, speeds

SECONDS_BEFORE = 30.0
BY_COMMAND_A, BY_SPEED_A, NOISE_A = 1.5, -9e-4, 0.02


def window_of(seed: int, *, gain: float = 1.0, drag: float = 1.0, moves_after: bool = True) -> Window:
    """Half a minute of health, then a fault; current and speed have noise."""
    command = moving_command(seed, SECONDS_BEFORE + 8.0)
    if not moves_after:
        command[onset_of(command) - 100 :] = 0.6
    of_gain, of_drag = from_onset(command, gain, 1.0), from_onset(command, drag, 1.0)
    speed = speeds(command, gain=of_gain, drag=of_drag)
    noise = NOISE_A * np.random.default_rng(seed).normal(size=len(command))
    current = BY_COMMAND_A * of_gain * command + BY_SPEED_A * speed + 0.01 + noise
    return Window(STEP_S, command, measured(speed, seed), onset_of(command), current_a=current)


@pytest.mark.parametrize("seed", range(2))
def test_it_finds_the_change_of_the_gain_and_none_where_the_load_has_changed(seed: int) -> None:
    for gain, drag in ((0.88, 1.0), (1.0, 1.7), (1.0, 1.0)):
        found = gain_of_current(window_of(seed, gain=gain, drag=drag), HEALTHY)
        assert found is not None
        assert found.change == pytest.approx(gain - 1.0, abs=3.0 * found.std_error)
        assert found.std_error < 0.04


@pytest.mark.parametrize("seed", range(2))
def test_at_a_constant_command_it_tells_a_weak_drive_from_drag(seed: int) -> None:
    """Where the motion alone explains both alike."""
    for gain, drag, cause in ((0.85, 1.0, "gain_down"), (1.0, 1.9, "drag_up")):
        window = window_of(seed, gain=gain, drag=drag, moves_after=False)
        with_current, without = diagnose(window, HEALTHY), diagnose(replace(window, current_a=None), HEALTHY)
        share, before = (
            {each.cause: each.probability for each in found.causes}["gain_down"] for found in (with_current, without)
        )
        if cause == "gain_down":
            assert with_current.first.cause == "gain_down"
            assert share > before
            assert "by the current -1" in with_current.first.sentence
        else:
            assert share < 0.1
            assert share < before


def test_it_says_nothing_where_the_command_never_moved_or_the_current_is_not_known() -> None:
    window = window_of(1, gain=0.9)
    assert gain_of_current(replace(window, current_a=None), HEALTHY) is None
    assert gain_of_current(replace(window, current_a=np.full(len(window.command), np.nan)), HEALTHY) is None
    constant = np.full_like(window.command, 0.6)
    current = BY_COMMAND_A * 0.6 + NOISE_A * np.random.default_rng(1).normal(size=len(constant))
    speed = measured(speeds(constant), 1)
    assert gain_of_current(Window(STEP_S, constant, speed, window.onset, current_a=current), HEALTHY) is None

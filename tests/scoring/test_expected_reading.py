"""The readings that a counting tacho may show, against a tacho that counts pulses."""

import numpy as np
import pytest

from fantwin.schemas.messages import Array
from fantwin.schemas.tacho import Tacho
from fantwin.scoring.expected_reading import AveragedCommand, ExpectedReading

PERIOD_S = 0.1
TACHOS = (
    Tacho(kind="count", window_s=1.0),
    Tacho(kind="count", window_s=0.75, update_s=0.3, delay_s=0.13),
    Tacho(),
)
FANS = len(TACHOS)
ALL = np.ones(FANS, np.bool_)


def speeds(seconds: float, period_s: float) -> tuple[Array, Array]:
    """Time (n,) and the speeds (n, FANS) of fans that are steady, step up and down, coast and stand still, rad/s."""
    t_s = np.arange(round(seconds / period_s)) * period_s
    levels = np.array([120.0, 40.0, 200.0, 200.0, 0.0, 60.0])
    target, speed = levels[(t_s // 7.0).astype(int) % len(levels)], np.empty(len(t_s))
    speed[0] = level = target[0]
    for row in range(1, len(t_s)):
        level += (target[row] - level) * -np.expm1(-period_s / 0.8)
        speed[row] = level
    return t_s, np.column_stack([speed] * FANS)


def counted(t_s: Array, fine_t_s: Array, fine_speed: Array, tacho: Tacho, phase_s: float) -> Array:
    """(n,) readings at t_s of a tacho whose windows end at phase_s + k update_s, without quantisation, rad/s."""
    angle = np.concatenate(([0.0], np.cumsum((fine_speed[1:] + fine_speed[:-1]) / 2 * np.diff(fine_t_s))))
    end_s = np.floor((t_s - tacho.delay_s - phase_s) / tacho.held_s) * tacho.held_s + phase_s
    begin_angle, end_angle = (np.interp(at_s, fine_t_s, angle) for at_s in (end_s - tacho.window_s, end_s))
    return (end_angle - begin_angle) / tacho.window_s


def test_a_counting_tacho_shows_nothing_beyond_the_expected_readings_whatever_its_phase() -> None:
    fine_t_s, fine = speeds(60.0, 0.001)
    t_s, speed = fine_t_s[::100], fine[::100]
    expected = ExpectedReading(TACHOS, PERIOD_S)
    expected.start(ALL, speed[0])
    middle, half_range = expected.update(speed)
    compared = t_s > 3.0
    for fan, tacho in enumerate(TACHOS[:2]):
        shown = np.array([counted(t_s, fine_t_s, fine[:, fan], tacho, 0.01 * phase) for phase in range(100)])
        beyond = np.abs(shown - middle[:, fan]) - half_range[:, fan]
        assert beyond[:, compared].max() < 1.5, "rad/s: the error of taking the speed as linear over 0.1 s"
        reached = np.ptp(shown[:, compared], axis=0) - 2 * half_range[compared, fan]
        assert np.abs(reached).max() < 5.0, "the range is no wider than what such tachos show"
    np.testing.assert_array_equal(middle[:, 2], speed[:, 2])
    assert not half_range[:, 2].any()


def test_the_averaged_command_is_the_mean_over_window_and_age_and_unknown_after_an_unknown_command() -> None:
    tacho = Tacho(kind="count", window_s=1.0)
    command = np.zeros((60, 1))
    command[30:] = 1.0
    averaged = AveragedCommand([tacho], PERIOD_S).update(command)[:, 0]
    assert np.isnan(averaged[:20]).all()
    half = averaged[30 + 9 : 30 + 11]
    assert half[0] < 0.5 < half[1], "half of a step has arrived after half of window and age"
    assert averaged[29] == 0.0
    assert averaged[52] == pytest.approx(1.0)
    command[40] = np.nan
    averaged = AveragedCommand([tacho], PERIOD_S).update(command)[:, 0]
    assert np.isnan(averaged[40:60]).all()

"""twin.fitting.standstill: what runs with stops and starts show, as a tacho that counts over a second reports them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fantwin.schemas.standstill import SLOWED_SHARE, Standstill
from fantwin.schemas.tacho import Tacho
from fantwin.twin.fitting.standstill import find_standstill
from fantwin.twin.runs import Array, Run

PERIOD_S = 0.1
COUNT = Tacho(kind="count", window_s=1.0)
PLATEAU, PER_COMMAND, COAST_S = 30.0, 2.0, 1.3


def measured(
    *levels: tuple[float, float], start_delay_s: float = 0.0, coast_s: float = COAST_S, tacho: Tacho = COUNT
) -> Run:
    """A fan under levels (command, seconds): at least at its plateau above a command of 20, slower down than up."""
    command = np.concatenate([np.full(round(seconds / PERIOD_S), level) for level, seconds in levels])
    speed, now, driven_s = np.zeros(len(command)), 0.0, 0.0
    for row, level in enumerate(command):
        driven_s = driven_s + PERIOD_S if level > 20.0 else 0.0
        target = max(PLATEAU, PER_COMMAND * level) if driven_s > start_delay_s else 0.0
        now += (target - now) * PERIOD_S / (0.8 if target > now else coast_s)
        speed[row] = now
    t_s = np.arange(len(command), dtype=np.float64) * PERIOD_S
    return Run("levels", t_s, command, _counted(speed, tacho), (tacho,))


def _counted(speed: Array, tacho: Tacho) -> Array:
    window = round(tacho.window_s / PERIOD_S)
    if not window:
        return speed
    counts = speed[: len(speed) // window * window].reshape(-1, window).mean(axis=1) / tacho.resolution_rad_s
    shown = np.repeat(np.floor(counts + 1e-9) * tacho.resolution_rad_s, window)
    return np.concatenate((np.zeros(window), shown))[: len(speed)]


def shown_by(*runs: Run) -> Standstill:
    found = find_standstill(runs)
    assert found is not None
    return found


STOPS = ((100.0, 30.0), (0.0, 40.0), (40.0, 30.0), (10.0, 40.0), (30.0, 40.0), (80.0, 20.0))


def test_stops_and_starts_are_found_with_their_times() -> None:
    found = shown_by(measured(*STOPS))
    assert (found.off_command, found.turning_command) == (10.0, 30.0)
    assert 0.4 * PER_COMMAND * 30.0 < found.standing_below_rad_s < 0.6 * PER_COMMAND * 30.0
    assert found.start_s is not None
    assert 0.5 < found.start_s <= COUNT.reach_s + 1.0
    assert found.coast_time_constant_s == pytest.approx(COAST_S, rel=0.5)
    expected_s = COAST_S * np.log(PER_COMMAND * 100.0 / found.standing_below_rad_s)
    assert found.coast_s is not None
    assert expected_s < found.coast_s < expected_s + COUNT.reach_s + 1.0
    assert found.lapse_s == 0.0
    slowed_s = COAST_S * np.log(1.0 / SLOWED_SHARE)
    assert found.slowing_s is not None
    assert 0.0 <= found.slowing_s < slowed_s + COUNT.held_s, "readings tell it to a count"


def test_a_fan_that_stood_under_a_rising_command_does_not_stop_under_it() -> None:
    """It starts above 20 only, and once it turns it turns at 15, too."""
    up = [(level, 15.0) for level in (0.0, 5.0, 10.0, 15.0)]
    started, then = measured(*up, (100.0, 30.0)), [(40.0, 30.0), (15.0, 30.0), (0.0, 30.0)]
    turning = measured((100.0, 30.0), *[(max(level, 20.1), seconds) for level, seconds in then[:2]], then[2])
    commands = np.concatenate([np.full(round(seconds / PERIOD_S), level) for level, seconds in [(100.0, 30.0), *then]])
    found = shown_by(started, replace(turning, command=commands[:, np.newaxis]))
    assert (found.off_command, found.turning_command) == (0.0, 40.0), "under 15 it may stand or turn"
    assert found.start_s is not None
    assert found.start_s < 5.0


@pytest.mark.parametrize("disturbed", ["", "glitch", "gap"])
def test_a_command_that_only_a_standing_fan_has_seen_does_not_stop_it(disturbed: str) -> None:
    """It is at rest under 15 for half a minute, and turns under 15 later."""
    rest = [(0.0, 30.0), (15.0, 30.0), (40.0, 30.0), (100.0, 30.0)]
    standing = measured(*rest) if not disturbed else measured((100.0, 30.0), *rest)
    turning = measured((100.0, 30.0), (20.1, 60.0))
    turning = replace(turning, command=np.where(turning.command == 20.1, 15.0, turning.command))
    speed, t_s = standing.speed_rad_s.copy(), standing.t_s.copy()
    row = round(75.0 / PERIOD_S)
    if disturbed == "glitch":
        speed[row] = 90.0
    if disturbed == "gap":
        t_s[row:] += 5.0
    found = shown_by(replace(standing, speed_rad_s=speed, t_s=t_s), turning)
    assert (found.off_command or 0.0) == 0.0


def test_a_fan_that_never_stopped_shows_what_turns_it_and_nothing_else() -> None:
    found = shown_by(measured((100.0, 30.0), (40.0, 30.0), (60.0, 30.0)))
    assert found == Standstill(turning_command=40.0, standing_below_rad_s=found.standing_below_rad_s)
    command, standing, turning = np.array([0.0, 0.0, 40.0, 5.0]), np.zeros(4), np.full(4, 100.0)
    assert found.stops(command, standing).tolist() == [True, True, False, False]
    assert not found.stops(command, turning).any(), "it may turn at its minimum speed without a command"


def test_a_command_is_not_taken_to_stop_a_fan_that_turns_under_it_slowly_or_unread() -> None:
    slow = measured((300.0, 30.0), (25.0, 13.0), (150.0, 20.0), coast_s=6.0, tacho=Tacho())
    found = shown_by(slow)
    assert 100.0 < slow.speed_rad_s[420] < found.standing_below_rad_s, "near the end it reads as one that stands"
    assert (found.off_command, found.turning_command) == (None, 150.0)
    run = measured((100.0, 30.0), (0.0, 20.0), (100.0, 30.0), tacho=Tacho())
    speed = run.speed_rad_s.copy()
    speed[-7:] = 0.0
    found = shown_by(replace(run, speed_rad_s=speed))
    assert (found.off_command, found.turning_command) == (0.0, 100.0)


def test_lapses_of_the_tacho_are_measured() -> None:
    run = measured((100.0, 60.0), (0.0, 40.0), (100.0, 60.0), tacho=Tacho())
    speed = run.speed_rad_s.copy()
    speed[300:307] = 0.0
    found = shown_by(replace(run, speed_rad_s=speed))
    assert found.lapse_s == pytest.approx(0.7)


@pytest.mark.parametrize("run", [measured((-50.0, 30.0), (50.0, 30.0)), measured((0.0, 30.0))])
def test_nothing_is_said_of_fans_that_turn_both_ways_or_never(run: Run) -> None:
    assert find_standstill([run]) is None

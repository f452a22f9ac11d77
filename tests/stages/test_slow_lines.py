"""Lines of about a sample a second, such as those of baseboard controllers, from raw samples to alarms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from fantwin.schemas.blocks import cut, join
from fantwin.schemas.enums import InvalidReason, Transition
from fantwin.schemas.messages import Alarm, Grid, Prediction, Score
from fantwin.schemas.tacho import Tacho
from fantwin.stages.resampler import ResamplerConfig, ResamplerCore
from tests.support import integrated_twins, scored_blocks
from tests.support.clockless_device import EPOCH_NS, at, raw

Floats = NDArray[np.float64]
PHASES_S = (0.0, 0.03, 0.4, 0.97)
FINE_S = 0.01
SECONDS = 120


def times_of(phase_s: float, jitter_s: float = 0.03) -> Floats:
    """A time a second, now and then before or after where it should be."""
    return phase_s + np.arange(SECONDS) + np.random.default_rng(3).uniform(0.0, jitter_s, SECONDS)


def commands_of(t_s: Floats) -> Floats:
    """A controller that always moves its fans."""
    return np.round(50.0 + 30.0 * np.sin(t_s / 8.0))


def speeds_at(t_s: Floats, command: Floats) -> Floats:
    """Speeds of the fan that the twin is of, whose commands change at the samples that show them."""
    fine_s = np.arange(0.0, t_s[-1] + FINE_S, FINE_S)
    held = command[np.clip(np.searchsorted(t_s, fine_s, "right") - 1, 0, None)][:, np.newaxis]
    twin = integrated_twins.physical_twin()
    steps_s = np.full(len(fine_s), FINE_S)
    speed = twin.advance(twin.initial_state(np.array([150.0]), held[0]), held, steps_s)[0][:, 0]
    return np.interp(t_s, fine_s, speed)


def gridded(t_s: Floats, speed: Floats, command: Floats, tacho: Tacho | None = None, parts: int = 1) -> Grid:
    core = ResamplerCore(1, ResamplerConfig(rate_hz=1.0), tachos=(tacho or Tacho(),))
    messages = [raw(at(*t_s[rows]), speed[rows], command[rows]) for rows in np.array_split(np.arange(SECONDS), parts)]
    return join([*(grid for message in messages for grid in core.step(message)), *core.close()])


@pytest.mark.parametrize("phase_s", PHASES_S)
def test_a_twin_follows_its_fan_whatever_the_phase_of_samples_and_grid(phase_s: float) -> None:
    t_s = times_of(phase_s)
    command = commands_of(t_s)
    grid = gridded(t_s, speeds_at(t_s, command), command)
    found = integrated_twins.feed(integrated_twins.core_of(warm_up_s=10.0), [grid])
    residual = (found.measured_speed_rad_s - found.predicted_speed_rad_s)[found.valid]
    assert len(residual) > SECONDS - 20
    moves = np.abs(np.diff(found.measured_speed_rad_s[:, 0]))
    assert np.quantile(moves, 0.9) > 9.0, "rad/s that a command costs which acts a period late or early"
    assert np.abs(residual).max() < 0.5


@pytest.mark.parametrize("phase_s", PHASES_S)
def test_no_impulse_of_a_command_is_lost_on_a_slow_grid(phase_s: float) -> None:
    t_s = times_of(phase_s, jitter_s=0.0)
    command = commands_of(t_s)
    grid = gridded(t_s, np.zeros(SECONDS), command)
    edges_s = np.append(grid.t_ns - EPOCH_NS, grid.t_ns[-1] + grid.period_ns - EPOCH_NS) / 1e9
    fine_s = np.arange(edges_s[0] + FINE_S / 2, edges_s[-1], FINE_S)
    held = command[np.searchsorted(t_s, fine_s, "right") - 1].reshape(len(grid.t_ns), -1).mean(axis=1)
    np.testing.assert_allclose(grid.command[:, 0], held, atol=0.021)


def test_a_slow_grid_depends_on_the_samples_alone_and_not_on_how_they_came() -> None:
    t_s = times_of(0.97, 0.06)
    command, tacho = commands_of(t_s), Tacho(kind="average", window_s=1.0, update_s=1.0)
    whole = gridded(t_s, command, command, tacho)
    for parts in (7, SECONDS):
        other = gridded(t_s, command, command, tacho, parts)
        np.testing.assert_array_equal(other.command, whole.command)
        np.testing.assert_array_equal(other.speed_rad_s, whole.speed_rad_s)


def scored(grid: Grid) -> tuple[list[Score], list[Alarm], Prediction]:
    """Scores and alarms of a fan that runs at the speed of its twin."""
    predicted = integrated_twins.feed(integrated_twins.core_of(warm_up_s=10.0), [grid])
    speed = scored_blocks.noise_of(len(grid.t_ns)) + scored_blocks.TWIN_SPEED
    known = predicted.valid
    fan = replace(
        predicted,
        predicted_speed_rad_s=np.where(known, scored_blocks.TWIN_SPEED, np.nan),
        measured_speed_rad_s=np.where(np.isfinite(grid.speed_rad_s), speed, np.nan),
        sigma_rad_s=np.full(1, scored_blocks.SIGMA),
    )
    core = scored_blocks.core_of()
    found = [message for row in range(len(grid.t_ns)) for message in core.step(cut(fan, row, row + 1))]
    scores = [each for each in found if isinstance(each, Score)]
    return scores, [each for each in found if isinstance(each, Alarm)], predicted


@pytest.mark.parametrize("has_speed", [True, False])
@pytest.mark.parametrize("unknown", [1, 3, 30])
def test_a_command_that_is_unknown_for_a_while_is_said_raises_no_alarm_and_leaves_no_trace(
    unknown: int, has_speed: bool
) -> None:
    t_s = times_of(0.4, 0.0)
    command = np.full(SECONDS, 50.0)
    speed = speeds_at(t_s, command)
    command[60 : 60 + unknown] = np.nan
    if not has_speed:  # as of a fan whose object cannot be read
        speed[60 : 60 + unknown] = np.nan
    grid = gridded(t_s, speed, command)
    assert np.isfinite(grid.speed_rad_s).all() or not has_speed, "the speed is known all the same"
    scores, alarms, predicted = scored(grid)
    assert not [alarm for alarm in alarms if alarm.transition == Transition.RAISED]
    reason, lacking = predicted.invalid_reason[:, 0], np.isnan(grid.command[:, 0])
    assert unknown <= lacking.sum() <= unknown + 1
    assert (reason[lacking] != InvalidReason.NONE).all()
    after = np.concatenate([score.valid[:, 0] for score in scores])
    assert after[20:58].all() and after[60 + unknown + 20 :].all(), "judged again soon"
    marks = np.concatenate([score.score[:, 0] for score in scores])
    assert np.isfinite(marks[after]).all() and np.nanmax(marks[after]) < 0.5
    reasons = np.concatenate([score.invalid_reason[:, 0] for score in scores])
    assert (reasons[~after] != InvalidReason.NONE).all(), "no sample without a score is without its reason"

"""Parameters recovered, in any units, or refused."""

import numpy as np
import pytest

from bench.training.published_fan import published_fan
from fantwin.schemas.messages import Array
from fantwin.twin.errors import TwinError
from fantwin.twin.fitting.identifiability import short_warnings
from fantwin.twin.fitting.identification import Identification, identify
from fantwin.twin.runs import Run
from tests.support import fan_data


@pytest.fixture(scope="module")
def published() -> tuple[Run, Identification]:
    run = fan_data.published_run(seed=11, duration_s=40.0, fans=4)
    return run, identify([run])


def test_the_published_fan_is_recovered_within_its_confidence_intervals(published) -> None:
    _, found = published
    low, high = found.interval_95[..., 0], found.interval_95[..., 1]
    truth = np.array([*fan_data.PUBLISHED_PARAMETERS, 0.0])
    inside = (low <= truth) & (high >= truth)
    assert inside.mean() >= 0.85
    np.testing.assert_allclose(found.parameters[:, 0], 0.15, rtol=0.02)
    np.testing.assert_allclose(found.parameters[:, 2], 0.0025, rtol=0.01)
    assert found.warnings == ()


@pytest.mark.slow
def test_95_percent_intervals_hold_the_truth_in_95_percent_of_recordings() -> None:
    runs = [fan_data.published_run(seed, duration_s=5.0, fans=20) for seed in range(100, 104)]
    found = [identify([run]) for run in runs]
    low, high = (np.concatenate([one.interval_95[:, :3, side] for one in found]) for side in (0, 1))
    inside = (low <= fan_data.PUBLISHED_PARAMETERS) & (high >= fan_data.PUBLISHED_PARAMETERS)
    # 80 recordings determine a share of 95 % to 2.4 %; the bound is 2.7 times that.
    assert np.all(np.abs(inside.mean(axis=0) - 0.95) < 0.066), inside.mean(axis=0)


def test_a_fan_that_physics_alone_do_not_describe_is_reported(published) -> None:
    assert published[1].misfits == ()
    found = identify([fan_data.rough_run(1, 40.0)])
    assert "fan 0: the physical model misses the speed by " in found.misfits[0]
    (line,) = identify([fan_data.rough_run(1, 40.0, fans=3)]).misfits
    assert line.startswith("fans 0, 1, 2: the physical model misses the speed by up to ") and "use a hybrid" in line


def test_a_lag_is_found_where_there_is_one_and_none_where_there_is_none(published) -> None:
    run, without = published
    assert np.count_nonzero(without.parameters[:, 3]) == 0
    lagging = published_fan(run.command, 0, "lagging", lag_s=0.03).run
    found = identify([lagging])
    np.testing.assert_allclose(found.parameters[:, 3], 0.03, atol=0.004)
    assert np.all(np.abs(found.parameters[:, 3] - 0.03) < 4.0 * found.standard_errors[:, 3])
    np.testing.assert_allclose(found.parameters[:, 0], 0.15, rtol=0.02)


@pytest.mark.parametrize("stretch", [0.1, 60.0], ids=["23 ms", "14 s"])
def test_a_fan_ten_times_faster_or_sixty_times_slower_is_recovered_in_any_units(published, stretch: float) -> None:
    run, found = published
    scaled = identify([Run("scaled", run.t_s * stretch, run.command * 655.35, run.speed_rad_s * 0.1)])
    factors = np.array([6553.5 * stretch, 6553.5, 65535.0, 1.0])
    np.testing.assert_allclose(scaled.parameters, found.parameters * factors, rtol=0.02)


def test_missing_and_jittered_samples_do_not_bias(published) -> None:
    run, _ = published
    rng = np.random.default_rng(8)
    keep = np.sort(rng.choice(run.samples, run.samples * 4 // 5, replace=False))
    speed = run.speed_rad_s.copy()
    speed[rng.random(speed.shape) < 0.2] = np.nan
    found = identify([Run("lossy", run.t_s[keep], run.command[keep], speed[keep])])
    np.testing.assert_allclose(found.parameters[:, 2], 0.0025, rtol=0.03)
    np.testing.assert_allclose(found.parameters[:, 0], 0.15, rtol=0.08)


def test_a_command_that_never_changes_and_a_dead_sensor_are_refused() -> None:
    command = fan_data.stairs(np.random.default_rng(3), 500, 1)
    t_s = np.arange(500) / 100.0
    for held, speed_rad_s, words in (
        (np.full_like(command, 50.0), command, "fan 0: the command never changes; record steps"),
        (command, np.full_like(command, 3.0), "speed never changes"),
        (command, np.full_like(command, np.nan), "fewer than ten measured speeds"),
    ):
        with pytest.raises(TwinError, match=words):
            identify([Run("bad", t_s, held, speed_rad_s)])


def test_a_speed_that_is_ahead_of_its_command_is_refused_with_what_the_times_of_its_rows_may_be() -> None:
    """As of a table whose rows have the times at which their counts begin."""
    rng = np.random.default_rng(5)
    command = np.repeat(rng.uniform(20.0, 90.0, 120), 20)[:, np.newaxis]
    speed_rad_s = np.roll(3.0 * command, -2, axis=0) + rng.normal(0.0, 0.5, command.shape)
    with pytest.raises(TwinError, match="fan 0: the speed changes about 2 s before the command does"):
        identify([Run("early", np.arange(len(command), dtype=np.float64), command, speed_rad_s)])


STEPS = np.array([20.0, 40.0, 60.0, 80.0, 90.0, 100.0])


@pytest.mark.parametrize(
    ("command", "lost", "words"),
    [
        (np.tile(STEPS, (8, 1)), 0, "gaps cut the recording into runs of 6 samples at most"),
        (np.resize(STEPS, (8, 1)).repeat(20, axis=1), 0, "no command, or no speed, changes within a run"),
        (np.tile(STEPS.repeat(5), (8, 1)), 9, "the speed is 0 in 72 samples at commands from 90"),
    ],
)
def test_gaps_and_a_supply_that_fails_are_said(command: Array, lost: int, words: str) -> None:
    """Runs of a fan that settles within a sample. command: (runs, samples)."""
    speed_rad_s = 3.0 * command + np.random.default_rng(1).normal(0.0, 1.0, command.shape)
    speed_rad_s[:, command.shape[1] - lost :] = 0.0
    t_s = 2.0 * np.arange(command.shape[1])
    with pytest.raises(TwinError, match=words):
        identify([Run("", 1000.0 * k + t_s, command[k, :, None], speed_rad_s[k, :, None]) for k in range(8)])


def test_a_recording_of_few_time_constants_is_said_to_be_too_short_before_anything_else() -> None:
    """The published fan has a time constant of about 0.2 s: 5 s are few, 20 s are enough."""
    first = identify([fan_data.published_run(1, duration_s=5.0)]).warnings[0]
    assert first.startswith("too short: 5 s are 24 time constants of the slowest fan (0.21 s), and one round of steps")
    assert "takes 75; record 5 min or more" in first
    parts = [fan_data.published_run(seed, duration_s=10.0) for seed in (1, 2)]
    assert not any("too short" in line for line in identify(parts).warnings), "recordings count together"
    (line,) = short_warnings([fan_data.published_run(1, duration_s=5.0)], np.array([0.01, 10.0]))
    assert "of the slowest fan (10 s)" in line
    assert "record 25 min or more" in line

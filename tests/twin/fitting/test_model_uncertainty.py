"""How far a twin may be wrong: little where it was trained, and as far as it is wrong where it was not."""

import numpy as np
import pytest

from fantwin.schemas.model_uncertainty import ModelUncertainty
from fantwin.twin.build import train_twin
from fantwin.twin.evaluation.accuracy import compared_readings, free_run_readings
from fantwin.twin.finishing import TrainedTwin
from fantwin.twin.fitting.identification import identify
from fantwin.twin.fitting.model_uncertainty import model_uncertainty
from fantwin.twin.models.physical import PhysicalModel
from fantwin.twin.models.recursion import linear_recursion
from fantwin.twin.runs import Array, Run
from tests.support import fan_data
from tests.support.driven_fan import DRIVE, run_of
from tests.support.made_once import TrainedOnce


@pytest.fixture(scope="module")
def upper(trained_once: TrainedOnce) -> TrainedTwin:
    """Trained on the upper half of the commands alone."""
    return trained_once([fan_data.rough_run(5, 40.0, low=50.0)], [], "hybrid", name="x", max_iterations=15)


def known(twin: TrainedTwin) -> ModelUncertainty:
    assert twin.card.model_uncertainty is not None
    return twin.card.model_uncertainty


def along(twin: TrainedTwin, run: Run) -> tuple[Array, Array]:
    """(n,) the error of the free run, and what it may be, of one fan."""
    predicted = free_run_readings(twin.model, twin.parameters, run)
    return (compared_readings(run) - predicted)[:, 0], known(twin).std_at(predicted, run.command)[:, 0]


def test_beyond_its_data_it_says_how_wrong_a_twin_may_be_and_within_them_that_it_is_right(upper) -> None:
    sigma = upper.card.sigma_rad_s[0]
    _, within_rad_s = along(upper, fan_data.rough_run(6, 30.0, low=50.0))
    assert np.median(within_rad_s) < 0.5 * sigma
    assert np.mean(within_rad_s > np.hypot(0.5 * sigma, known(upper).seen_std_rad_s)) < 0.07
    test = fan_data.rough_run(3, 40.0)
    error, std_rad_s = along(upper, test)
    beyond = (test.command[:, 0] > 10.0) & (test.command[:, 0] < 20.0)
    assert np.mean(np.abs(error[beyond]) <= 2.0 * sigma) < 0.8
    assert np.mean(np.abs(error[beyond]) <= 2.0 * np.hypot(sigma, std_rad_s[beyond])) > 0.95


def two_fans(first: Run, second: Run) -> Run:
    count = min(first.samples, second.samples)
    command, speed_rad_s = (
        np.hstack([getattr(run, name)[:count] for run in (first, second)]) for name in ("command", "speed_rad_s")
    )
    return Run("two", first.t_s[:count], command, speed_rad_s)


def test_what_one_fan_has_shown_is_not_all_known_of_another() -> None:
    """A second fan like the first that had only the upper half of the commands."""
    whole, upper_half = fan_data.rough_run(5, 20.0), fan_data.rough_run(6, 20.0, low=50.0)
    table = known(train_twin([two_fans(whole, upper_half)], [], "hybrid", name="x", max_iterations=3))
    command = np.full((1, 2), 25.0)
    speed_rad_s = np.array([[np.interp(25.0, table.commands, of_fan) for of_fan in table.settled_speed_rad_s]])
    shown, not_shown = table.std_at(speed_rad_s, command)[0]
    alone = train_twin([upper_half], [], "hybrid", name="x", max_iterations=3)
    alone = known(alone).std_at(speed_rad_s[:, 1:], command[:, 1:])
    assert 5.0 * shown < not_shown < 0.7 * alone[0, 0]


LEVELS = (0.2, 0.35, 0.5, 0.65, 0.8, 1.0)


def held_run(standing: int = 0, saturates_at: float = np.inf) -> Run:
    """A linear fan held at each of the levels in turn for 8 s, and as often as given at rest, with noise."""
    levels = [level for level in (*LEVELS, *LEVELS[::-1]) for level in (level, *(0.0,) * standing)]
    command = np.repeat(levels * 3, 80)[:, np.newaxis]
    acts = np.minimum(command, saturates_at)
    kept = np.full((len(command) - 1, 1), 0.8)
    speed_rad_s = linear_recursion(kept, np.vstack((300.0 * acts[:1], 60.0 * acts[:-1])))
    noise = np.where(speed_rad_s > 1.0, np.random.default_rng(1).normal(size=speed_rad_s.shape), 0.0)
    return Run("held", np.arange(len(command)) / 10.0, command, speed_rad_s + noise)


def at_levels(table: ModelUncertainty) -> tuple[Array, Array]:
    """The standard deviations where a fan settles under the levels, and what of them is unseen, rad/s."""
    speed_rad_s = np.interp(LEVELS, table.commands, table.settled_speed_rad_s[0])
    pairs = speed_rad_s[:, np.newaxis], np.array(LEVELS)[:, np.newaxis]
    return table.std_at(*pairs)[:, 0], table.unseen_std_at(*pairs)[:, 0]


def of_physics(run: Run) -> ModelUncertainty:
    """Uncertainty of the physical model of a fan without a drive."""
    found = identify([run])
    return model_uncertainty(PhysicalModel(), found.parameters, [run], [run], np.zeros(1), found)


def test_what_is_held_is_known_however_long_a_fan_stands() -> None:
    table = of_physics(held_run(standing=4))
    std_rad_s, unseen_rad_s = at_levels(table)
    assert max(std_rad_s.max(), unseen_rad_s.max()) < 0.3, "of the noise, which is 1 rad/s"
    assert table.seen_std_rad_s[0] > 0.0


def test_what_is_held_where_a_fan_turns_no_faster_is_known() -> None:
    twin = train_twin([held_run(saturates_at=0.7)], [], "hybrid", name="x", max_iterations=10)
    _, unseen_rad_s = at_levels(known(twin))
    assert unseen_rad_s.max() < 0.3 * twin.card.sigma_rad_s[0]


def test_its_speeds_are_around_those_at_which_fans_with_a_drive_settle() -> None:
    """The friction of the drive takes its part, and the plateau is raised."""
    run = run_of(DRIVE, 1).between(0.0, 240.0)
    twin = train_twin([run], [], "hybrid", name="x", max_iterations=5)
    assert twin.card.drive is not None
    raised = twin.card.drive.raised(run.command)
    predicted_rad_s = free_run_readings(twin.model, twin.parameters, run)
    settled = np.flatnonzero(np.diff(run.command[:, 0]) != 0.0)  # the end of each level
    settled = settled[run.command[settled, 0] >= twin.card.drive.turning_command]
    (speeds_rad_s,) = known(twin).settled_speed_rad_s
    at_command = np.interp(raised[settled, 0], known(twin).commands, speeds_rad_s)
    off = np.abs(at_command - predicted_rad_s[settled, 0]) / np.ptp(predicted_rad_s)
    assert np.median(off) < 0.01

"""How far a twin may be wrong: little where it was trained, and as far as it is wrong where it was not."""

import numpy as np
import pytest

from schemas.model_uncertainty import ModelUncertainty
from tests.support import fan_data
from tests.twin.fitting.test_drive_fit import DRIVE, run_of
from twin.build import TrainedTwin, train_twin
from twin.evaluation.accuracy import compared_readings, free_run_readings
from twin.fitting.identification import identify
from twin.fitting.model_uncertainty import model_uncertainty, variance_of_independent
from twin.models.physical import PhysicalModel
from twin.models.recursion import linear_recursion
from twin.runs import Array, Run


@pytest.fixture(scope="module")
def upper() -> TrainedTwin:
    """Trained on the upper half of the commands alone."""
    return train_twin([fan_data.rough_run(5, 60.0, low=50.0)], [], "hybrid", name="x")


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
    seen_rad_s = known(upper).seen_std_rad_s
    assert seen_rad_s is not None
    assert 0.85 < np.mean(within_rad_s <= seen_rad_s) < 1.0
    test = fan_data.rough_run(3, 40.0)
    error, std_rad_s = along(upper, test)
    beyond = (test.command[:, 0] > 10.0) & (test.command[:, 0] < 20.0)
    assert np.mean(np.abs(error[beyond]) <= 2.0 * sigma) < 0.8
    assert np.mean(np.abs(error[beyond]) <= 2.0 * np.hypot(sigma, std_rad_s[beyond])) > 0.95


def test_more_data_leave_less_open() -> None:
    run = fan_data.rough_run(5, 80.0)
    short, long = (
        train_twin([run.between(0.0, seconds)], [], "hybrid", name="x", max_iterations=20).card.model_uncertainty
        for seconds in (10.0, 80.0)
    )
    assert short is not None
    assert long is not None
    speed_rad_s = np.nan_to_num(run.speed_rad_s)
    short_rad_s, long_rad_s = (np.quantile(each.std_at(speed_rad_s, run.command), 0.9) for each in (short, long))
    assert long_rad_s < 0.6 * short_rad_s


def test_only_a_network_that_is_used_has_one() -> None:
    """The physics alone miss what they miss wherever they were trained."""
    run = fan_data.rough_run(5, 10.0)
    for kind in ("physical", "narx", "neural-ode"):
        assert train_twin([run], [], kind, name="x", max_iterations=1).card.model_uncertainty is None


def test_fans_with_a_drive_have_one_over_the_commands_that_they_are_given() -> None:
    run = run_of(DRIVE, 1)
    twin = train_twin([run], [run_of(DRIVE, 2)], "hybrid", name="x", max_iterations=5)
    assert twin.card.drive is not None
    raised = twin.card.drive.raised(run.command)
    assert known(twin).commands[0] < raised.min() < raised.max() < known(twin).commands[-1]


def test_a_recording_without_noise_has_one() -> None:
    """Of a linear fan at four levels, exactly."""
    command = np.repeat([0.3, 0.6, 0.9, 0.5], 500)[:, np.newaxis]
    speed_rad_s = linear_recursion(np.full((len(command) - 1, 1), 0.7), np.vstack((np.zeros(1), 30.0 * command[:-1])))
    run = Run("clean", np.arange(len(command), dtype=np.float64) / 10.0, command, speed_rad_s)
    runs, parameters = [run], np.array([[0.3 / 100.0, 1.0 / 100.0, 0.0, 0.0]])
    found = model_uncertainty(PhysicalModel(), parameters, runs, runs, identify(runs))
    assert np.isfinite(found.std_rad_s).all()


def test_noise_that_stays_leaves_more_open_than_noise_of_a_moment() -> None:
    rng = np.random.default_rng(1)
    white = rng.normal(size=20_000)
    assert variance_of_independent(white) == pytest.approx(1.0, rel=0.1)
    slow = linear_recursion(np.full((len(white) - 1, 1), 0.9), white[:, np.newaxis])[:, 0]
    assert variance_of_independent(slow) == pytest.approx(100.0, rel=0.2)  # 1 / (1 - 0.9)^2

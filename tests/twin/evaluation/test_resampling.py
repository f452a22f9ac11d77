"""Runs on other grids, and the errors of twins on them."""

import numpy as np
import pytest

from fantwin.twin.errors import TwinError
from fantwin.twin.evaluation.accuracy import sums_of_model
from fantwin.twin.evaluation.resampling import Grid, irregular, on_grid, resampled, thinned
from fantwin.twin.models.hybrid import UNITS, Hybrid
from fantwin.twin.models.model import TwinModel
from fantwin.twin.models.network import Scaling, TanhNetwork
from fantwin.twin.models.physical import PhysicalModel
from fantwin.twin.runs import Array, Run
from tests.support import fan_data

OTHER_GRIDS: tuple[Grid, ...] = (20.0, 50.0, 200.0, "irregular")
NOISE = fan_data.NOISE_RAD_S


def impulse(run: Run, stop_s: float) -> Array:
    """(fans,) integral of the held command up to a time."""
    edges = np.append(run.t_s, run.t_s[-1] + run.step_s[-1])
    held_s = np.clip(np.diff(np.minimum(edges, stop_s)), 0.0, None)
    return held_s @ run.command


@pytest.mark.parametrize("rate_hz", [7.0, 50.0, 130.0, 200.0])
def test_on_another_rate_no_impulse_is_lost_and_speeds_are_the_measured_ones(rate_hz: float) -> None:
    run = fan_data.published_run(1, 10.0, fans=2)
    other = resampled(run, rate_hz)
    assert np.diff(other.t_s) == pytest.approx(1.0 / rate_hz)
    for stop_s in other.t_s[[1, 5, len(other.t_s) // 2, -1]]:
        assert impulse(other, stop_s) == pytest.approx(impulse(run, stop_s), rel=1e-9)
    if rate_hz == 50.0:
        assert other.speed_rad_s == pytest.approx(run.speed_rad_s[::2])
    if rate_hz == 200.0:
        assert other.speed_rad_s[::2] == pytest.approx(run.speed_rad_s)
        assert np.isnan(other.speed_rad_s[1::2]).all()


@pytest.mark.parametrize("how", ["irregular", "every seventh"])
def test_a_thinned_run_keeps_its_readings_and_loses_no_impulse(how: str) -> None:
    run = fan_data.published_run(4, 10.0)
    thin = irregular(run, seed=1) if how == "irregular" else thinned(run, 7)
    steps = np.rint(np.diff(thin.t_s) * fan_data.RATE_HZ)
    if how == "irregular":
        assert [np.mean(steps == k) for k in (1, 2, 3)] == pytest.approx([1 / 3] * 3, abs=0.07)
        np.testing.assert_array_equal(irregular(run, seed=1).t_s, thin.t_s)
    else:
        assert np.all(steps == 7)
    np.testing.assert_array_equal(thin.speed_rad_s[:, 0], run.speed_rad_s[np.isin(run.t_s, thin.t_s), 0])
    for stop_s in thin.t_s[[1, 50, -1]]:
        assert impulse(thin, stop_s) == pytest.approx(impulse(run, stop_s), rel=1e-9)


def test_on_grids_with_few_common_times_speeds_are_interpolated_and_gaps_stay_gaps() -> None:
    # A step of 16.1 ms against one of 20 ms: they meet in one time out of 161.
    t_s = np.arange(400, dtype=np.float64) * 0.0161
    speed = 3.0 + 2.0 * t_s
    speed[100] = speed[200:203] = np.nan
    other = resampled(Run("line", t_s, np.ones(400), speed), 50.0)
    known = np.isfinite(other.speed_rad_s[:, 0])
    assert other.speed_rad_s[known, 0] == pytest.approx(3.0 + 2.0 * other.t_s[known])
    in_gap = (other.t_s > t_s[199] + 1e-9) & (other.t_s < t_s[203] - 1e-9)
    np.testing.assert_array_equal(~known, in_gap)


def test_long_gaps_are_left_out_and_short_stretches_too() -> None:
    run = fan_data.published_run(5, 10.0)
    later = run.t_s + np.where(run.t_s > 5.0, 60.0, 0.0) + np.where(run.t_s > 9.95, 60.0, 0.0)
    pieces = on_grid([Run("gapped", later, run.command, run.speed_rad_s)], 10.0)
    assert [piece.samples for piece in pieces] == [51, 50]
    assert len(on_grid([run, run], "irregular")) == 2


def test_a_run_that_cannot_be_resampled_is_refused_in_one_line() -> None:
    run = fan_data.published_run(6, 1.0)
    with pytest.raises(TwinError, match="a rate of 0.0 Hz; give a positive number"):
        resampled(run, 0.0)
    with pytest.raises(TwinError, match="0.99 s are shorter than one step at 1 Hz"):
        resampled(run, 1.0)
    with pytest.raises(TwinError, match="no run is long enough to be evaluated at 0.5 Hz"):
        on_grid([run], 0.5)
    with pytest.raises(TwinError, match="no run is long enough to be evaluated at irregular steps"):
        on_grid([run.rows(0, 3)], "irregular")


def simulated(model: TwinModel, parameters: Array, seed: int = 8) -> Run:
    """40 s at 100 Hz of a fan that is as the model says, integrated in steps of 1 ms, with noise."""
    rng = np.random.default_rng(seed)
    command = fan_data.stairs(rng, 4000, 1)
    start = model.state_layout.initial_state(np.zeros(1), command[0])
    speed, _ = model.advance(start, np.repeat(command, 10, axis=0), np.full(40_000, 0.001), parameters)
    noisy = speed[::10] + rng.normal(0.0, NOISE, command.shape)
    return Run("simulated", np.arange(4000) / fan_data.RATE_HZ, command, noisy)


def errors_in_noise(model: TwinModel, parameters: Array, run: Run) -> dict[str, float]:
    """Free-run error over the noise on the run's own grid and on the others."""
    runs = {"own": [run]} | {str(grid): on_grid([run], grid) for grid in OTHER_GRIDS}
    sigma = np.array([NOISE])
    figures = {name: sums_of_model(model, parameters, sigma, on).evaluation().pooled for name, on in runs.items()}
    return {name: each.rmse_rad_s / NOISE for name, each in figures.items()}


def random_hybrid() -> Hybrid:
    untrained = TanhNetwork.zero(UNITS, ("speed", "command"), Scaling(50.0, 50.0, 50.0, 50.0, 100.0))
    return Hybrid(untrained.with_theta(np.random.default_rng(1).normal(0.0, 0.7, untrained.parameter_count)))


@pytest.mark.parametrize(
    ("model", "lag_s"), [(PhysicalModel(), 0.05), (random_hybrid(), 0.0)], ids=["physical", "hybrid"]
)
def test_a_twin_is_as_good_on_every_grid(model: TwinModel, lag_s: float) -> None:
    parameters = fan_data.published_parameters(lag_s=lag_s)
    # 800 samples at 20 Hz: their root mean square scatters by 2.5 %.
    for error in errors_in_noise(model, parameters, simulated(model, parameters)).values():
        assert error == pytest.approx(1.0, abs=0.06)

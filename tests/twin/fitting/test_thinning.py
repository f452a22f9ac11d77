"""What of the readings a network is trained on: windows of many fans, and none that are dropouts or glitches."""

from dataclasses import replace

import numpy as np
import pytest

from fantwin.twin.build import evaluate, train_twin
from fantwin.twin.evaluation.resampling import thinned
from fantwin.twin.fitting import trajectories
from fantwin.twin.fitting.outliers import without_outliers
from fantwin.twin.fitting.trajectories import coarser, thinning_factor, windows_of
from fantwin.twin.models.recursion import linear_recursion
from fantwin.twin.runs import Run
from tests.support import fan_data

TIME_CONSTANT_S = 0.3


def tray(fans: int, seconds: float) -> Run:
    """Fans at 100 Hz whose readings are all different."""
    samples = round(100.0 * seconds)
    readings = np.arange(float(samples * fans)).reshape(samples, fans)
    return Run("tray", np.arange(samples) / 100.0, np.zeros((samples, fans)), readings)


def test_windows_show_every_moment_and_every_fan_and_few_fans_are_not_thinned() -> None:
    pieces = [tray(20, 40.0), tray(20, 90.0)]
    factor = thinning_factor(pieces, TIME_CONSTANT_S)
    assert factor == 20 // trajectories.LEAST_FANS, "as many fans as are needed in each window"
    windows = windows_of(pieces, TIME_CONSTANT_S)
    shown = np.concatenate([np.isfinite(window.speed_rad_s) for window in windows])
    assert sum(window.samples for window in windows) == sum(piece.samples for piece in pieces)
    assert np.all(shown.sum(axis=1) == trajectories.LEAST_FANS)
    assert np.all(np.abs(shown.mean(axis=0) - 1.0 / factor) < 0.1), "every fan in its share of them"
    whole = np.concatenate([piece.speed_rad_s for piece in pieces])
    np.testing.assert_array_equal(np.concatenate([each.speed_rad_s for each in windows])[shown], whole[shown])
    assert thinning_factor([tray(64, 40.0)], TIME_CONSTANT_S) == 64 * 4000 // trajectories.ENOUGH_READINGS
    for few in (tray(8, 80.0), tray(9, 1000.0), tray(64, 15.0), tray(64, 5.0)):
        assert windows_of([few], TIME_CONSTANT_S) == [few]


def test_a_network_comes_from_windows_and_the_physics_of_each_fan_from_all_its_readings(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run, then = (thinned(fan_data.rough_run(seed, 20.0, fans=8, low=25.0), 2) for seed in (1, 2))

    def trained() -> tuple[bool, float, float]:
        """Whether some of it was on all samples, the error of the twin, and what it says of it."""
        parts: set[str] = set()
        twin = train_twin([run], [], "hybrid", name="x", max_iterations=6, progress=lambda part, *_: parts.add(part))
        table = twin.card.model_uncertainty
        assert table is not None
        error = evaluate(twin, [then]).pooled.rmse_rad_s
        return "training on all samples" in parts, error, float(np.median(table.seen_std_rad_s))

    in_two, error, std = trained()
    assert not in_two
    monkeypatch.setattr(trajectories, "ENOUGH_READINGS", run.speed_rad_s.size // 2)
    monkeypatch.setattr(trajectories, "LEAST_FANS", 4)
    in_two, of_thinned, std_of_thinned = trained()
    assert in_two
    assert of_thinned < 1.005 * error, "4 % more by windows alone, 1 % if the priors do not limit the steps"
    assert 0.7 < std_of_thinned / std < 1.4


def test_coarser_samples_lie_on_the_course_of_the_speed_and_lose_no_command() -> None:
    run = fan_data.rough_run(1, 20.0, fans=2)
    ramp = np.column_stack((3.0 * run.t_s, -run.t_s))
    ramp[100:120, 1] = np.nan
    coarse = coarser(replace(run, speed_rad_s=ramp), TIME_CONSTANT_S)
    assert coarse.median_period_s == pytest.approx(0.07), "the odd number of samples in a quarter of it"
    known = np.isfinite(coarse.speed_rad_s[:, 1])
    np.testing.assert_allclose(coarse.speed_rad_s[:, 0], 3.0 * coarse.t_s)
    np.testing.assert_allclose(coarse.speed_rad_s[known, 1], -coarse.t_s[known], atol=0.03)
    assert 2 <= np.count_nonzero(~known) <= 3
    between = (run.t_s > coarse.t_s[0] - 1e-9) & (run.t_s < coarse.t_s[-1] + 0.065)
    np.testing.assert_allclose(0.07 * coarse.command.sum(axis=0), 0.01 * run.command[between].sum(axis=0))
    assert coarser(run, 0.1) is run


def test_a_recursion_of_many_signals_is_that_of_each() -> None:
    rng = np.random.default_rng(1)
    factor, forcing = rng.uniform(0.5, 1.0, (99, 3)), rng.normal(size=(100, 3, 50))
    together = linear_recursion(factor, forcing)
    alone = np.stack([linear_recursion(factor, forcing[..., each]) for each in range(50)], axis=-1)
    np.testing.assert_allclose(together, alone, rtol=1e-12, atol=1e-12)


def with_speed(run: Run, speed_rad_s: np.ndarray) -> Run:
    return Run(run.name, run.t_s, run.command, speed_rad_s)


def test_dropouts_and_double_counts_are_left_out_and_counted() -> None:
    run = fan_data.rough_run(1, 40.0, fans=2)
    rng = np.random.default_rng(2)
    speed = run.speed_rad_s.copy()
    bad = (rng.random(speed.shape) < 0.02) & (speed > 60.0)
    bad[:, 1] = False
    speed[bad] *= rng.choice([0.0, 2.0], bad.sum())
    speed[::7, 1] = np.nan
    cleaned, share = without_outliers(with_speed(run, speed))
    found = np.isnan(cleaned.speed_rad_s)
    assert (found & bad).sum() > 0.97 * bad.sum()
    assert (found & ~bad)[:, 0].sum() <= 2, "missing speeds are not counted"
    assert share[0] == pytest.approx(bad[:, 0].mean(), rel=0.05)
    assert share[1] == 0.0


@pytest.mark.parametrize(
    ("every", "step_rad_s", "most"),
    [(1, 0.0, 2e-4), (10, 0.0, 2e-4), (1, 20.0, 2e-3)],
    ids=["slow fan", "fan of 23 ms", "coarse tacho"],
)
def test_a_healthy_fan_keeps_all_its_samples(every: int, step_rad_s: float, most: float) -> None:
    run = fan_data.published_run(3, 60.0) if step_rad_s else fan_data.rough_run(3, 60.0)
    speed = np.round(run.speed_rad_s / step_rad_s) * step_rad_s if step_rad_s else run.speed_rad_s[::every]
    coarse = Run("coarse", run.t_s[: len(speed)], run.command[::every], speed)
    assert np.all(without_outliers(coarse)[1] < most)

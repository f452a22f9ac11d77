"""Training reaches the noise, repeats itself, and withstands bad samples."""

import fan_data
import numpy as np
import pytest

from twin.build import TrainedTwin, evaluate, train_twin
from twin.errors import TwinError
from twin.hybrid import Hybrid
from twin.identification import identify
from twin.network import TanhNetwork
from twin.runs import Run
from twin.torch_reference import train_adam
from twin.training import data_scaling


@pytest.fixture(scope="module")
def rough() -> tuple[Run, Run, Run]:
    return fan_data.rough_run(1, 80.0), fan_data.rough_run(2, 20.0), fan_data.rough_run(3, 30.0)


@pytest.fixture(scope="module")
def hybrid(rough) -> TrainedTwin:
    return train_twin([rough[0]], [rough[1]], "hybrid", name="hybrid", max_iterations=30)


def excess_over_noise(rmse_rad_s: float) -> float:
    return float(np.sqrt(max(rmse_rad_s**2 - fan_data.NOISE_RAD_S**2, 0.0)))


def test_the_hybrid_halves_what_the_physics_leave_above_the_noise(rough, hybrid: TrainedTwin) -> None:
    physical = train_twin([rough[0]], [rough[1]], "physical", name="physical")
    left_by_physics = excess_over_noise(evaluate(physical, [rough[2]]).pooled.rmse_rad_s)
    left_by_hybrid = excess_over_noise(evaluate(hybrid, [rough[2]]).pooled.rmse_rad_s)
    assert left_by_hybrid < 0.5 * left_by_physics


def test_training_does_not_move_the_physics(rough, hybrid: TrainedTwin) -> None:
    np.testing.assert_array_equal(hybrid.parameters, hybrid.identification.parameters)


def test_the_neural_ode_learns_without_physics(rough) -> None:
    twin = train_twin([rough[0]], [rough[1]], "neural-ode", name="neural", max_iterations=10)
    assert evaluate(twin, [rough[2]]).pooled.r2 > 0.97


def test_narx_predicts_one_step_close_to_the_noise(rough) -> None:
    twin = train_twin([rough[0]], [], "narx", name="narx", max_iterations=4)
    # Predicting a noisy sample cannot beat the noise.
    assert fan_data.NOISE_RAD_S < evaluate(twin, [rough[2]]).pooled.one_step_rmse_rad_s < 1.5 * fan_data.NOISE_RAD_S


def test_the_same_seed_gives_the_same_model_and_another_seed_another(rough) -> None:
    def weights(seed: int) -> np.ndarray:
        twin = train_twin([rough[1].between(0.0, 10.0)], [], "hybrid", name="x", seed=seed, max_iterations=3)
        assert isinstance(twin.model, Hybrid)
        return twin.model.network.theta

    np.testing.assert_array_equal(weights(4), weights(4))
    assert not np.array_equal(weights(4), weights(5))


def test_missing_samples_and_outliers_hardly_matter(rough) -> None:
    rng = np.random.default_rng(6)
    clean = rough[1]
    speed = clean.speed_rad_s.copy()
    speed[rng.random(speed.shape) < 0.3] = np.nan
    speed[rng.random(speed.shape) < 0.01] *= 1.5
    twin = train_twin([Run("dirty", clean.t_s, clean.command, speed)], [], "physical", name="dirty")
    reference = train_twin([clean], [], "physical", name="clean")
    dirty, best = (evaluate(one, [rough[2]]).pooled.rmse_rad_s for one in (twin, reference))
    assert dirty < 1.1 * best


def test_progress_is_told_after_every_step_taken(rough) -> None:
    told: list[tuple[int, int, float]] = []
    short = rough[1].between(0.0, 10.0)
    train_twin([short], [], "hybrid", name="x", max_iterations=5, progress=lambda *values: told.append(values))
    done = [values[0] for values in told]
    assert done == sorted(set(done))
    assert all(total == 5 and rmse > 0.0 for _, total, rmse in told)


def test_adam_lowers_the_free_run_error_from_the_physics_on(rough) -> None:
    short = rough[0].between(0.0, 10.0)
    found = identify([short])
    network = TanhNetwork.zero(10, ("speed", "command"), data_scaling([short], found))
    theta = np.random.default_rng(0).normal(scale=0.5, size=network.parameter_count)
    theta[-11:] = 0.0
    told: list[float] = []
    start = Hybrid(network.with_theta(theta))
    train_adam(start, [short], found, max_iterations=15, progress=lambda _done, _total, rmse: told.append(rmse))
    assert told[-1] < 0.97 * told[0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"kind": "oracle"}, "kind 'oracle' is unknown; use one of physical, narx"),
        ({"kind": "narx", "trainer": "adam"}, "cannot train the narx model"),
        ({"kind": "hybrid", "trainer": "luck"}, "trainer 'luck' is unknown"),
    ],
)
def test_an_impossible_request_is_refused_in_one_line(rough, options: dict, words: str) -> None:
    with pytest.raises(TwinError, match=words):
        train_twin([rough[1]], [], name="x", **options)

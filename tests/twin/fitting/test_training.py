"""Training reaches the noise, repeats itself, and withstands bad samples."""

import numpy as np
import pytest

from fantwin.twin.build import evaluate, train_twin
from fantwin.twin.errors import TwinError
from fantwin.twin.evaluation.resampling import thinned
from fantwin.twin.finishing import TrainedTwin
from fantwin.twin.fitting import training
from fantwin.twin.fitting.identification import identify
from fantwin.twin.fitting.outliers import without_outliers
from fantwin.twin.fitting.training import data_scaling
from fantwin.twin.models.hybrid import Hybrid
from fantwin.twin.models.network import TanhNetwork
from fantwin.twin.runs import Run
from tests.support import fan_data
from tests.support.trained_once import TrainedOnce


@pytest.fixture(scope="module")
def rough() -> tuple[Run, Run, Run]:
    return fan_data.rough_run(1, 160.0).between(0.0, 120.0), fan_data.rough_run(2, 20.0), fan_data.rough_run(3, 30.0)


@pytest.fixture(scope="module")
def part(rough) -> Run:
    """The part of the first recording that most tests need."""
    return rough[0].between(0.0, 80.0)


@pytest.fixture(scope="module")
def hybrid(rough, part, trained_once: TrainedOnce) -> TrainedTwin:
    return trained_once([part], [rough[1]], "hybrid", name="hybrid", max_iterations=10)


def times_noise(twin: TrainedTwin, run: Run) -> float:
    return evaluate(twin, [run]).pooled.rmse_rad_s / fan_data.NOISE_RAD_S


def test_the_hybrid_comes_to_the_noise_where_the_physics_stay_far_from_it(rough, part, hybrid: TrainedTwin) -> None:
    physical = train_twin([part], [rough[1]], "physical", name="physical")
    assert times_noise(physical, rough[2]) > 1.5
    assert times_noise(hybrid, rough[2]) < 1.05


def test_the_mean_of_several_networks_hardly_depends_on_the_seed(rough) -> None:
    short = rough[0].between(0.0, 25.0)
    twins = [train_twin([short], [], "hybrid", name="x", seed=seed, max_iterations=15, networks=4) for seed in range(2)]
    errors = [times_noise(twin, rough[2]) for twin in twins]
    assert max(errors) < 1.03 * min(errors), "that of a single network differs by 5 %"
    assert all(twin.card.training.networks == 4 for twin in twins)
    assert all(20 <= twin.card.network.units <= 40 for twin in twins)


def test_a_network_that_ends_worse_is_left_out_of_the_mean(rough, monkeypatch: pytest.MonkeyPatch) -> None:
    run = rough[1].between(0.0, 10.0)

    def units(least_loss: float) -> int:
        monkeypatch.setattr(training, "ABOUT_AS_WELL", least_loss)
        return train_twin([run], [], "hybrid", name="x", max_iterations=2, networks=3).card.network.units

    assert (units(1.0), units(1e9)) == (10, 30)


def test_fixed_physics_stay_as_identified_and_refined_ones_move(rough) -> None:
    fixed, refined = (
        train_twin([rough[1]], [], "hybrid", name="x", physics=physics, max_iterations=30)
        for physics in ("fixed", "refined")
    )
    np.testing.assert_allclose(fixed.parameters, fixed.identification.parameters, rtol=1e-12)
    assert np.all(refined.parameters[:, :3] != refined.identification.parameters[:, :3])
    assert (fixed.card.training.physics, refined.card.training.physics) == ("fixed", "refined")


@pytest.mark.slow
def test_the_neural_ode_comes_to_the_noise_without_physics(rough) -> None:
    twin = train_twin([rough[0].between(0.0, 60.0)], [], "neural-ode", name="neural", max_iterations=60)
    assert times_noise(twin, rough[2]) < 1.1


@pytest.mark.slow
def test_fans_that_differ_share_one_network_and_keep_their_own_physics() -> None:
    tray, test = fan_data.rough_run(1, 25.0, fans=3), fan_data.rough_run(3, 30.0, fans=3)
    together = train_twin([tray], [], "hybrid", name="tray", max_iterations=15)
    assert np.ptp(together.parameters[:, 0]) > 0.1 * together.parameters[:, 0].mean()
    assert times_noise(together, test) < 1.1


def with_samples(run: Run, keep: np.ndarray) -> Run:
    """The kept samples, each with the mean of the held command until the next one."""
    command = np.add.reduceat(run.command, keep, axis=0) / np.diff(keep, append=run.samples)[:, None]
    return Run("irregular", run.t_s[keep], command, run.speed_rad_s[keep])


def test_irregular_samples_dropouts_of_the_tacho_and_outliers_hardly_matter(rough, part) -> None:
    rng = np.random.default_rng(6)
    irregular = with_samples(part, np.sort(rng.choice(part.samples, part.samples * 2 // 3, replace=False)))
    speed = irregular.speed_rad_s.copy()
    speed[rng.random(speed.shape) < 0.1] = np.nan
    speed[rng.random(speed.shape) < 0.03] = 0.0
    speed[rng.random(speed.shape) < 0.01] *= 2.0
    dirty, _ = without_outliers(Run("dirty", irregular.t_s, irregular.command, speed))
    twin = train_twin([dirty], [], "hybrid", name="dirty", max_iterations=15)
    assert times_noise(twin, rough[2]) < 1.1


def test_a_fan_that_was_not_measured_in_the_held_out_run_is_refused(rough) -> None:
    run = fan_data.published_run(1, 15.0, fans=2)
    speed = run.speed_rad_s.copy()
    speed[:, 1] = np.nan
    with pytest.raises(TwinError, match="fan 1: no measured speed in the held-out runs"):
        train_twin([run], [Run("blind", run.t_s, run.command, speed)], "physical", name="x")


def test_without_data_the_hybrid_follows_its_physics(rough, trained_once: TrainedOnce) -> None:
    """Trained on the upper half of the commands alone, run from rest through the lower half."""
    upper = fan_data.rough_run(5, 60.0, low=50.0)
    twin, physical = (trained_once([upper], [], kind, name="x") for kind in ("hybrid", "physical"))
    assert times_noise(twin, rough[2]) < 1.5 * times_noise(physical, rough[2])


def test_progress_is_reported_of_each_part_of_the_work(rough) -> None:
    reported: dict[str, list[tuple[int, int, float]]] = {}
    short = rough[1].between(0.0, 10.0)
    trained = train_twin(
        [short],
        [],
        "hybrid",
        name="x",
        max_iterations=5,
        networks=2,
        progress=lambda part, *values: reported.setdefault(part, []).append(values),
    )
    trainings = ["network 1 of 2: training", "network 2 of 2: training"]
    of_twin = ["identification", "starting weights", *trainings, "uncertainty", "evaluation", "torque balance"]
    assert [part for part in reported if part in of_twin] == of_twin
    for part in reported.values():
        done = [values[0] for values in part]
        assert done == sorted(set(done))
        assert done[-1] <= part[-1][1]
    asked_for = {at_most for training in trainings for _, at_most, _ in reported[training]}
    assert asked_for == {5}, "as many as asked for"
    assert trained.card.training.iterations <= 2 * 5
    assert all(rmse > 0.0 for part in ("identification", "starting weights", *trainings) for *_, rmse in reported[part])


def test_adam_lowers_the_free_run_error_from_the_physics_on(rough) -> None:
    from fantwin.twin.fitting.torch_reference import train_adam  # noqa: PLC0415  torch takes seconds to import

    short = thinned(rough[0].between(0.0, 2.0), 2)  # the cost is that of the steps
    found = identify([short])
    network = TanhNetwork.zero(10, ("speed", "command"), data_scaling([short], found))
    theta = np.random.default_rng(0).normal(scale=0.5, size=network.parameter_count)
    theta[-11:] = 0.0
    reported: list[float] = []
    start = Hybrid(network.with_theta(theta))
    train_adam(start, [short], found, max_iterations=15, progress=lambda *values: reported.append(values[-1]))
    assert reported[-1] < 0.97 * reported[0]


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"kind": "oracle"}, "kind 'oracle' is unknown; use one of physical, narx"),
        ({"kind": "narx", "trainer": "adam"}, "cannot train the narx model"),
        ({"kind": "hybrid", "trainer": "luck"}, "trainer 'luck' is unknown"),
        ({"kind": "hybrid", "trainer": "adam", "networks": 2}, "and trainer adam; use the hybrid"),
        ({"kind": "hybrid", "networks": 7}, "7 networks cannot be averaged; ask for 1 to 6"),
    ],
)
def test_an_impossible_request_is_refused_in_one_line(rough, options: dict, words: str) -> None:
    with pytest.raises(TwinError, match=words):
        train_twin([rough[1]], [], name="x", **options)

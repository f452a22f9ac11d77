"""Training reaches the noise and withstands bad samples; networks are chosen by cross-validation, and averaged."""

import numpy as np
import pytest

from fantwin.twin.build import evaluate, train_twin
from fantwin.twin.errors import TwinError
from fantwin.twin.evaluation.resampling import thinned
from fantwin.twin.finishing import TrainedTwin
from fantwin.twin.fitting import training
from fantwin.twin.fitting.cross_validation import choose_prior_std, simplest_of_the_best
from fantwin.twin.fitting.identification import identify
from fantwin.twin.fitting.mean_of_networks import mean_model
from fantwin.twin.fitting.outliers import without_outliers
from fantwin.twin.fitting.training import GRID_PRIOR_STD, data_scaling
from fantwin.twin.models.fan_ode import NetworkOde
from fantwin.twin.models.hybrid import Hybrid
from fantwin.twin.models.network import Scaling, TanhNetwork
from fantwin.twin.models.neural_ode import NeuralOde
from fantwin.twin.models.physics import LAG
from fantwin.twin.runs import Array, Run
from tests.support import fan_data
from tests.support.made_once import TrainedOnce


@pytest.fixture(scope="module")
def rough() -> tuple[Run, Run, Run]:
    return fan_data.rough_run(1, 60.0), fan_data.rough_run(2, 20.0), fan_data.rough_run(3, 30.0)


@pytest.fixture(scope="module")
def short() -> Run:
    """Little, with commands of the whole range."""
    return fan_data.rough_run(1, 160.0).between(0.0, 25.0)


def times_noise(twin: TrainedTwin, run: Run) -> float:
    return evaluate(twin, [run]).pooled.rmse_rad_s / fan_data.NOISE_RAD_S


def disturbed(run: Run) -> Run:
    """Two thirds of the samples, at random, with dropouts of the tacho, double counts and missing readings."""
    rng = np.random.default_rng(6)
    keep = np.sort(rng.choice(run.samples, run.samples * 2 // 3, replace=False))
    command = np.add.reduceat(run.command, keep, axis=0) / np.diff(keep, append=run.samples)[:, None]
    speed = run.speed_rad_s[keep]
    for share, factor in ((0.1, np.nan), (0.03, 0.0), (0.01, 2.0)):
        speed[rng.random(speed.shape) < share] *= factor
    return without_outliers(Run("disturbed", run.t_s[keep], command, speed))[0]


def test_the_hybrid_comes_close_to_the_noise_also_from_bad_samples_where_physics_alone_does_not(rough) -> None:
    runs = [disturbed(rough[0])]
    twin, physical = (
        train_twin(runs, [rough[1]], kind, name="x", max_iterations=10) for kind in ("hybrid", "physical")
    )
    assert times_noise(physical, rough[2]) > 1.5
    assert times_noise(twin, rough[2]) < 1.1
    assert np.all(twin.parameters[:, :3] != twin.identification.parameters[:, :3]), "refined with the network"


def test_the_mean_of_several_networks_hardly_depends_on_the_seed(rough, short: Run) -> None:
    twins = [train_twin([short], [], "hybrid", name="x", seed=seed, max_iterations=10, networks=3) for seed in range(2)]
    errors = [times_noise(twin, rough[2]) for twin in twins]
    assert max(errors) < 1.03 * min(errors), "that of a single network differs by 5 %"
    assert all(twin.card.training.networks == 3 for twin in twins)
    assert all(20 <= twin.card.network.units <= 30 for twin in twins)


def test_a_network_that_ends_worse_is_left_out_of_the_mean(rough, monkeypatch: pytest.MonkeyPatch) -> None:
    run = rough[1].between(0.0, 5.0)

    def units(least_loss: float) -> int:
        monkeypatch.setattr(training, "ABOUT_AS_WELL", least_loss)
        return train_twin([run], [], "hybrid", name="x", max_iterations=2, networks=3).card.network.units

    assert (units(1.0), units(1e9)) == (10, 30)


@pytest.mark.slow
def test_the_neural_ode_comes_to_the_noise_without_physics(rough) -> None:
    run = thinned(rough[0].between(0.0, 40.0), 2)
    twin = train_twin([run], [], "neural-ode", name="neural", max_iterations=40)
    assert times_noise(twin, rough[2]) < 1.1


def test_a_fan_that_was_not_measured_in_the_held_out_run_is_refused(rough) -> None:
    run = fan_data.published_run(1, 15.0, fans=2)
    speed = run.speed_rad_s.copy()
    speed[:, 1] = np.nan
    with pytest.raises(TwinError, match="fan 1: no measured speed in the held-out runs"):
        train_twin([run], [Run("blind", run.t_s, run.command, speed)], "physical", name="x")


def test_without_data_the_hybrid_follows_its_physics(rough, trained_once: TrainedOnce) -> None:
    """Trained on the upper half of the commands alone, run from rest through the lower half."""
    upper = fan_data.rough_run(5, 40.0, low=50.0)
    twin, physical = (trained_once([upper], [], kind, name="x", max_iterations=15) for kind in ("hybrid", "physical"))
    assert times_noise(twin, rough[2]) < 1.5 * times_noise(physical, rough[2])


def test_progress_is_reported_of_each_part_of_the_work(rough) -> None:
    reported: dict[str, list[tuple[int, int, float]]] = {}
    trained = train_twin(
        [rough[1].between(0.0, 10.0)],
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
    assert {at_most for part in trainings for _, at_most, _ in reported[part]} == {5}, "as many as asked for"
    assert trained.card.training.iterations <= 2 * 5


def test_adam_lowers_the_free_run_error_below_that_of_the_physics(short: Run) -> None:
    from fantwin.twin.fitting.torch_reference import train_adam  # noqa: PLC0415  torch takes seconds to import

    run = thinned(short.between(0.0, 2.0), 2)  # the cost is that of the steps
    found = identify([run])
    network = TanhNetwork.zero(10, ("speed", "command"), data_scaling([run], found))
    theta = np.random.default_rng(0).normal(scale=0.5, size=network.parameter_count)
    theta[-11:] = 0.0
    reported: list[float] = []
    start = Hybrid(network.with_theta(theta))
    train_adam(start, [run], found, max_iterations=5, progress=lambda *values: reported.append(values[-1]))
    assert reported[-1] < 0.99 * reported[0]


def test_a_kind_and_a_trainer_that_are_unknown_are_refused_in_one_line(rough) -> None:
    with pytest.raises(TwinError, match="kind 'oracle' is unknown; use one of physical, narx"):
        train_twin([rough[1]], [], "oracle", name="x")
    with pytest.raises(TwinError, match="trainer 'luck' is unknown"):
        train_twin([rough[1]], [], "hybrid", name="x", trainer="luck")  # pyright: ignore[reportArgumentType]


def untrained(runs: list[Run]) -> Hybrid:
    return Hybrid(TanhNetwork.zero(10, ("speed", "command"), data_scaling(runs, identify(runs))))


@pytest.mark.slow
def test_a_fan_that_the_physics_describe_gets_no_network_and_a_rough_one_does() -> None:
    plain = [fan_data.published_run(seed, 5.0) for seed in (1, 2)]
    rough = [fan_data.rough_run(seed, 8.0) for seed in (1, 2)]
    assert choose_prior_std(untrained(plain), plain, seed=0) == 0.0
    assert choose_prior_std(untrained(rough), rough, seed=0) > 0.0
    blind = Run("blind", rough[1].t_s, rough[1].command, np.full_like(rough[1].speed_rad_s, np.nan))
    assert choose_prior_std(untrained(rough), [rough[0], blind], seed=0) == GRID_PRIOR_STD, "it does not count"


@pytest.mark.parametrize(
    ("losses", "chosen"),
    [
        ([[5.0, 5.0, 5.0], [4.0, 4.1, 3.9]], 1),
        ([[5.0, 5.0, 5.0], [4.0, 6.0, 4.9]], 0),
        ([[5.0, 5.0, 5.0], [4.0, np.inf, 4.0]], 0),
        ([[np.inf, 9.0, 9.0], [4.0, 4.0, 4.0]], 1),
    ],
)
def test_the_simplest_within_one_standard_error_of_the_best_is_chosen(losses: list, chosen: int) -> None:
    assert simplest_of_the_best(np.array(losses)) == chosen


SCALING = Scaling(60.0, 70.0, 0.4, 0.5, 200.0)
FANS = 3
BOTH = ("speed", "command")
Trained = tuple[NetworkOde, Array]


def trained(seed: int, kind: type[Hybrid | NeuralOde] = Hybrid, inputs: tuple[str, ...] = BOTH) -> Trained:
    rng = np.random.default_rng(seed)
    network = TanhNetwork.zero(10, inputs, SCALING)
    parameters = np.array([0.15, 0.012, 0.0025, 0.02]) * rng.uniform(0.5, 2.0, (FANS, 4))
    return kind(network.with_theta(rng.normal(size=network.parameter_count))), parameters


@pytest.mark.parametrize(("kind", "inputs"), [(Hybrid, ("speed",)), (NeuralOde, BOTH)])
def test_its_acceleration_is_the_mean_of_theirs_and_its_lag_too(kind, inputs: tuple[str, ...]) -> None:
    members = [trained(seed, kind, inputs) for seed in range(4)]
    model, parameters = mean_model(members)
    rng = np.random.default_rng(9)
    speed_rad_s, command = rng.uniform(-20.0, 200.0, (50, FANS)), rng.uniform(-0.2, 1.2, (50, FANS))
    theirs = [one.equation(own).acceleration(speed_rad_s, command) for one, own in members]
    np.testing.assert_allclose(
        model.equation(parameters).acceleration(speed_rad_s, command), np.mean(theirs, axis=0), rtol=1e-9, atol=1e-9
    )
    np.testing.assert_allclose(parameters[:, LAG], np.mean([own[:, LAG] for _, own in members], axis=0))

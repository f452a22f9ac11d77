"""Fans of a known type get a twin from little of their own running, and one that is not of the type is named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bench.training import published_fan
from fantwin.twin.build import evaluate, train_twin
from fantwin.twin.errors import TwinError
from fantwin.twin.evaluation.resampling import thinned
from fantwin.twin.export.onnx_twin import OnnxTwin
from fantwin.twin.finishing import TrainedTwin
from fantwin.twin.runs import Array, Run
from fantwin.twin.twin_of_type import place_twin
from tests.support import fan_data
from tests.support.made_once import TrainedOnce

OWN_S, TEST_S = 20.0, 40.0


@pytest.fixture(scope="module")
def type_twin(tmp_path_factory: pytest.TempPathFactory, trained_once: TrainedOnce) -> Path:
    """Five rough fans, whose physics differ by up to 10 %."""
    run = thinned(fan_data.rough_run(1, 40.0, 5), 2)
    twin = trained_once([run], [], "hybrid", name="type", max_iterations=10)
    return twin.save(tmp_path_factory.mktemp("type") / "type.onnx")


@pytest.fixture(scope="module")
def others() -> tuple[Run, Run]:
    """What four other fans of the type show of themselves, and what they do then."""
    whole = fan_data.rough_run(7, OWN_S + TEST_S, 4)
    return whole.between(0.0, OWN_S), whole.between(OWN_S, OWN_S + TEST_S)


@pytest.fixture(scope="module")
def placed(type_twin: Path, others: tuple[Run, Run]) -> TrainedTwin:
    return place_twin(type_twin, [others[0]], [], name="placed")


@pytest.fixture(scope="module")
def physical(others: tuple[Run, Run]) -> TrainedTwin:
    return train_twin([others[0]], [], "physical", name="physical")


def test_fans_that_differ_share_one_network_and_keep_their_own_physics(type_twin: Path) -> None:
    twin = OnnxTwin(type_twin)
    assert np.ptp(twin.parameters[:, 0]) > 0.1 * twin.parameters[:, 0].mean()
    other_stairs = thinned(fan_data.rough_run(3, 30.0, 5), 2)
    assert evaluate(twin, [other_stairs]).pooled.rmse_rad_s < 1.1 * fan_data.NOISE_RAD_S


def test_fans_that_were_never_trained_on_are_predicted_to_the_noise(
    type_twin: Path, others: tuple[Run, Run], placed: TrainedTwin, physical: TrainedTwin, tmp_path: Path
) -> None:
    _, then = others
    error = evaluate(placed, [then]).pooled
    assert error.rmse_rad_s < 1.08 * fan_data.NOISE_RAD_S
    assert evaluate(physical, [then]).pooled.rmse_rad_s > 1.3 * error.rmse_rad_s
    assert error.coverage_2_sigma > 0.93
    assert placed.card.training.of_type == "type"
    assert placed.card.network == OnnxTwin(type_twin).card.network
    stored = OnnxTwin(placed.save(tmp_path / "placed.onnx"))
    assert evaluate(stored, [then]).pooled.rmse_rad_s == pytest.approx(error.rmse_rad_s, rel=1e-9)


def test_what_fans_did_not_show_is_typical_and_widens_the_band(
    type_twin: Path, others: tuple[Run, Run], placed: TrainedTwin
) -> None:
    slow = published_fan.rough_run(8, OWN_S, 4, low=20.0, high=60.0).run
    little = place_twin(type_twin, [slow], [], name="placed")
    few, many = little.identification.standard_errors, placed.identification.standard_errors
    assert np.all(few[:, 2] > 1.2 * many[:, 2]), "of the drag, which shows at speed"
    assert np.all(_std_where_it_settles(little, 85.0) > 1.2 * _std_where_it_settles(placed, 85.0))
    assert evaluate(little, [others[1]]).pooled.coverage_2_sigma > 0.9


def _std_where_it_settles(twin: TrainedTwin, command: float) -> Array:
    """(fans,) of the twin's own error, rad/s, for each fan at its steady speed under a command."""
    uncertainty = twin.card.model_uncertainty
    assert uncertainty
    settled = [np.interp(command, uncertainty.commands, each) for each in uncertainty.settled_speed_rad_s]
    return uncertainty.std_at(np.array([settled]), np.full((1, len(settled)), command))[0]


def test_a_fan_of_another_type_is_named(type_twin: Path, others: tuple[Run, Run], placed: TrainedTwin) -> None:
    own, _ = others
    heavy = published_fan.published_fan(2.0 * own.command[:, :1], 3, "other").run
    other = Run("mixed", own.t_s, own.command[:, :1], heavy.speed_rad_s)
    (warning,) = place_twin(type_twin, [other], [], name="placed").identification.warnings
    assert warning.startswith("fan 0: its ")
    assert "standard deviations from that of its type: it is another type of fan, or faulty" in warning
    assert not placed.identification.warnings


def test_what_cannot_be_placed_is_refused_in_one_line(
    type_twin: Path, others: tuple[Run, Run], physical: TrainedTwin, tmp_path: Path
) -> None:
    own, _ = others
    with pytest.raises(TwinError, match="a physical twin has no physics beside a network; give a hybrid"):
        place_twin(physical.save(tmp_path / "physical.onnx"), [own], [], name="x")
    silent = Run("silent", own.t_s, own.command, np.where(np.arange(4) == 2, np.nan, own.speed_rad_s))
    with pytest.raises(TwinError, match="fan 2: fewer than 100 measured speeds"):
        place_twin(type_twin, [silent], [], name="x")

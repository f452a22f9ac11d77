"""What holds for every kind of model in twin/kinds.py, each trained for a moment."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fantwin.schemas.twin_card import TwinCard
from fantwin.twin.build import evaluate, train_twin
from fantwin.twin.export.onnx_export import export_onnx
from fantwin.twin.export.onnx_twin import OnnxTwin
from fantwin.twin.finishing import TrainedTwin
from fantwin.twin.kinds import KINDS
from fantwin.twin.models.physics import LAG
from fantwin.twin.runs import Array
from tests.support import fan_data
from tests.support.made_once import TrainedOnce

MOST_ITERATIONS = 2
RUN = fan_data.rough_run(1, 6.0, fans=2)
COMMAND = np.repeat(RUN.command, 2, axis=1)
STEP_S = np.random.default_rng(9).uniform(0.008, 0.012, RUN.samples)
STEP_S[100:110], STEP_S[300] = 1e-7, 0.0
LAGS_S = (0.05, 0.0, 1.0, 5e-5)
"""what four fans are given, at uneven steps, some of them tiny or zero; each has another lag, or none"""
every_kind = pytest.mark.parametrize("kind", [row.name for row in KINDS])
Advance = Callable[[Array, Array, Array, Array], tuple[Array, Array]]


@pytest.fixture
def trained(trained_once: TrainedOnce) -> Callable[..., TrainedTwin]:
    """A twin of two fans, of a kind and a seed."""
    return lambda kind, seed=0: trained_once([RUN], [], kind, name="x", seed=seed, max_iterations=MOST_ITERATIONS)


def in_pieces(advance: Advance, ends: list[int], state: Array, parameters: Array) -> tuple[Array, Array]:
    """The speeds and the last state of a run that was cut."""
    parts = []
    for first, end in zip([0, *ends], [*ends, RUN.samples], strict=True):
        speed, state = advance(state, COMMAND[first:end], STEP_S[first:end], parameters)
        parts.append(speed)
    return np.concatenate(parts), state


@every_kind
def test_a_run_that_is_cut_anywhere_goes_on_as_if_it_were_not_in_memory_and_in_the_file(
    kind: str, trained: Callable[..., TrainedTwin], tmp_path: Path
) -> None:
    twin = trained(kind)
    parameters = np.repeat(twin.parameters, 2, axis=0)
    parameters[:, LAG] = LAGS_S
    turning_rad_s = np.array([20.0, 90.0, 0.0, -40.0])
    state = twin.model.state_layout.initial_state(turning_rad_s, COMMAND[0] + 30.0)
    whole, last = twin.model.advance(state, COMMAND, STEP_S, parameters)
    assert np.ptp(whole, axis=0).min() > 20.0
    file = OnnxTwin(twin.save(tmp_path / "x.onnx"))
    of_file, last_of_file = file.advance(state, COMMAND, STEP_S, parameters)
    np.testing.assert_allclose(of_file, whole, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(last_of_file, last, rtol=1e-9, atol=1e-9)
    for ends in ([1, 2, 3], sorted(np.random.default_rng(1).choice(RUN.samples, 5, replace=False).tolist())):
        speed, after = in_pieces(twin.model.advance, ends, state, parameters)
        np.testing.assert_allclose(speed, whole, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(after, last, rtol=1e-12, atol=1e-12)
        speed, after = in_pieces(file.advance, ends, state, parameters)
        np.testing.assert_array_equal(speed, of_file)
        np.testing.assert_array_equal(after, last_of_file)


@every_kind
def test_its_card_says_what_it_is_and_its_file_is_as_good_as_itself(
    kind: str, trained: Callable[..., TrainedTwin], tmp_path: Path
) -> None:
    twin = trained(kind)
    file = OnnxTwin(twin.save(tmp_path / "x.onnx"))
    assert file.card == twin.card == TwinCard.from_json(twin.card.to_json())
    of_class = kind.removesuffix("-w")  # the same class, with a network that sees less
    assert (file.card.kind, file.card.fans) == (of_class, 2)
    assert file.card.rate_hz == pytest.approx(fan_data.RATE_HZ)
    assert (file.card.model_uncertainty is not None) == (of_class == "hybrid")
    assert file.card.training.iterations <= MOST_ITERATIONS or kind == "physical"  # those of its identification
    of_file, of_twin = (evaluate(each, [RUN]).pooled.rmse_rad_s for each in (file.path, twin))
    assert of_file == pytest.approx(of_twin, rel=1e-9)


@every_kind
def test_the_same_seed_gives_the_same_model_and_another_seed_another_network(
    kind: str, trained: Callable[..., TrainedTwin]
) -> None:
    twin = trained(kind)
    again = train_twin([RUN], [], kind, name="x", max_iterations=MOST_ITERATIONS)
    np.testing.assert_array_equal(again.parameters, twin.parameters)
    assert export_onnx(again.model, twin.card) == export_onnx(twin.model, twin.card)
    if kind == "hybrid":
        assert export_onnx(trained(kind, 1).model, twin.card) != export_onnx(twin.model, twin.card)


@pytest.mark.parametrize("kind", [row.name for row in KINDS if row.predicts == "speed"])
def test_a_step_of_no_time_leaves_the_fans_where_they_are(
    kind: str, trained: Callable[..., TrainedTwin], tmp_path: Path
) -> None:
    twin = trained(kind)
    state = twin.model.state_layout.initial_state(np.array([7.0, 70.0]), np.full(2, 50.0))
    for model in (twin.model, OnnxTwin(twin.save(tmp_path / "x.onnx"))):
        speed, after = model.advance(state, np.full((3, 2), 50.0), np.zeros(3), twin.parameters)
        np.testing.assert_array_equal(speed, [[7.0, 70.0]] * 3)
        np.testing.assert_array_equal(after, state)

"""stages.twin_integrator: a free run on the commands alone, however the grid is cut into messages."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.prediction import free_run
from fantwin.pipeline.runtime.stage import Context
from fantwin.schemas.blocks import cut
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Grid, Prediction
from fantwin.schemas.model_uncertainty import ModelUncertainty
from fantwin.schemas.tacho import INSTANTANEOUS, Tacho
from fantwin.stages.twin_integrator import STAGE, TwinIntegratorConfig
from tests.support.integrated_twins import (
    EPOCH_NS,
    NAN,
    STEP_NS,
    Floats,
    core_of,
    feed,
    grid_of,
    physical_twin,
    run_freely,
    silent,
    stairs,
    twin_with_friction,
    unstable_twin,
)
from tests.support.twin_files import write_twin

pytestmark = pytest.mark.usefixtures("one_reading_starts")


def of_session(grid: Grid, producer: str) -> Grid:
    return replace(grid, header=Header(producer, 0, "tray1"))


def test_the_prediction_is_never_corrected_by_a_measurement() -> None:
    command = stairs(500)
    measured = np.zeros(500)
    other = measured.copy()
    other[1:] += 500 * np.random.default_rng(1).normal(size=499)
    other[100:200] = NAN
    a, b = (feed(core_of(), [grid_of(command, speed)]) for speed in (measured, other))
    np.testing.assert_array_equal(b.measured_speed_rad_s[:, 0], other)
    np.testing.assert_array_equal(b.sigma_rad_s, [3.0])
    np.testing.assert_array_equal(a.predicted_speed_rad_s, b.predicted_speed_rad_s)
    assert (b.invalid_reason[100:200] == InvalidReason.NO_SPEED).all()
    assert b.valid[200:].all()


def test_the_free_run_is_the_model_run_from_the_mean_of_the_first_readings_and_valid_after_it_has_warmed_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(free_run, "START_SAMPLES", 3)
    speed = np.array([NAN, 10.0, 20.0, 60.0, 0.0, 0.0])
    command = np.array([5.0, 5.0, 5.0, 40.0, 41.0, 42.0])
    prediction = feed(core_of(), [grid_of(command, speed)])
    predicted = prediction.predicted_speed_rad_s[:, 0]
    expected, _ = run_freely(np.array([[30.0, 40.0]]), command[3:, np.newaxis], np.full(3, 0.01))
    assert np.isnan(predicted[:3]).all()
    np.testing.assert_allclose(predicted[3:], expected[:, 0], rtol=1e-12)
    none, young = InvalidReason.NONE, InvalidReason.WARMING_UP
    assert prediction.invalid_reason[:, 0].tolist() == [InvalidReason.NO_SPEED] + [young] * 2 + [none] * 3
    prediction = feed(core_of(warm_up_s=0.5), [grid_of(stairs(100))])
    assert prediction.invalid_reason[:, 0].tolist() == [young] * 52 + [none] * 48


def test_a_free_run_continues_through_a_short_silence_on_the_held_command() -> None:
    command = np.concatenate([np.full(100, 40.0), np.full(51, 40.0), np.full(99, 70.0)])
    without = feed(core_of(), [grid_of(command)])
    core = core_of()
    grids = [grid_of(command[:100]), silent(50, 100, 40.0), grid_of(command[150:], first=150)]
    prediction = feed(core, grids)
    np.testing.assert_array_equal(prediction.predicted_speed_rad_s, without.predicted_speed_rad_s)
    assert (prediction.invalid_reason[100:150] == InvalidReason.GAP).all()
    assert prediction.valid[150:].all()
    assert core.counters()["free_runs"] == 1


def test_a_long_silence_ends_the_free_run_and_a_new_one_starts_after_it() -> None:
    core = core_of(warm_up_s=0.1)
    grids = [
        grid_of(np.full(100, 40.0)),
        silent(52, 100, 40.0),
        grid_of(np.full(50, 40.0), np.full(50, 7.0), first=152),
    ]
    prediction = feed(core, grids)
    assert np.isfinite(prediction.predicted_speed_rad_s[150])  # until here the last command was held for 0.5 s
    assert np.isnan(prediction.predicted_speed_rad_s[151])
    assert prediction.predicted_speed_rad_s[152] == 7.0
    assert prediction.invalid_reason[152:, 0].tolist() == [InvalidReason.WARMING_UP] * 10 + [InvalidReason.NONE] * 40
    assert core.counters()["free_runs"] == 2


def test_row_16_missing_grid_samples_are_counted_once_and_simulated_and_many_restart_the_free_run() -> None:
    grid = grid_of(np.full(300, 40.0))
    whole = feed(core_of(), [grid])
    core = core_of()
    holed = feed(core, [cut(grid, 0, 100), cut(grid, 120, 300)])
    assert core.counters()["missing_grid_samples"] == 20
    np.testing.assert_allclose(holed.predicted_speed_rad_s[100:], whole.predicted_speed_rad_s[120:], rtol=1e-12)
    core = core_of()
    feed(core, [grid_of(np.full(100, 40.0)), grid_of(np.full(100, 40.0), np.full(100, 7.0), first=200)])
    assert (core.counters()["missing_grid_samples"], core.counters()["free_runs"]) == (100, 2)
    core = core_of()  # a gap that the resampler announced is no loss
    later = grid_of(np.full(100, 40.0), first=1_000_000)
    feed(core, [grid_of(np.full(100, 40.0)), silent(500, 100, 40.0, InvalidReason.STALE), later])
    assert "missing_grid_samples" not in core.counters()
    assert core.counters()["free_runs"] == 2


def test_a_command_outside_the_training_range_is_not_valid_and_with_a_table_of_its_error_one_further_out() -> None:
    out, good = InvalidReason.OUT_OF_RANGE, InvalidReason.NONE
    core = core_of()
    prediction = feed(core, [grid_of(np.array([40.0, 104.9, 105.1, -5.1, -4.9]))])
    assert prediction.invalid_reason[:, 0].tolist() == [good, good, out, out, good]
    assert core.counters()["not_predicted_out_of_range"] == 2
    square = ((1.0, 1.0), (1.0, 1.0))
    around = ModelUncertainty((0.0, 1.0), (0.0, 1.0), (square,), (1.0,), settled_speed_rad_s=((0.0, 1.0),))
    low, high = -25.0, 125.0  # a quarter of the range
    grid = grid_of(np.array([low, high, np.nextafter(low, -99.0), np.nextafter(high, 199.0)]))
    prediction = feed(core_of(physical_twin(model_uncertainty=around)), [grid])
    assert prediction.invalid_reason[:, 0].tolist() == [good, good, out, out]
    reversing = physical_twin(command_range=(-100.0, 100.0))
    assert feed(core_of(reversing), [grid_of(np.array([40.0, 0.0, -50.0, -104.0]))]).valid.all(), "without friction"


def why_not_of(command: list[float]) -> list[int]:
    core = core_of(twin_with_friction(10.0), warm_up_s=0.03)
    return feed(core, [grid_of(np.array([40.0] * 5 + command))]).invalid_reason[5:, 0].tolist()


@pytest.mark.parametrize("out", [9.9, 1e6])
def test_after_a_command_out_of_range_or_too_small_to_turn_the_rotor_the_twin_must_settle(out: float) -> None:
    beyond, young, good = InvalidReason.OUT_OF_RANGE, InvalidReason.WARMING_UP, InvalidReason.NONE
    assert why_not_of([out, out, 40.0, 10.0, 40.0, 40.0]) == [beyond, beyond, young, young, good, good]


def test_after_an_unknown_command_the_twin_need_not_settle() -> None:
    assert why_not_of([NAN, 40.0, np.inf, 40.0]) == [InvalidReason.OUT_OF_RANGE, InvalidReason.NONE] * 2


def test_an_unknown_command_of_one_fan_never_reaches_the_graph_and_leaves_the_other_alone() -> None:
    command = np.full((200, 2), 40.0)
    whole = feed(core_of(physical_twin(2)), [grid_of(command)])
    command[100:170, 0] = NAN
    prediction = feed(core_of(physical_twin(2)), [grid_of(command)])
    np.testing.assert_array_equal(prediction.predicted_speed_rad_s[:, 1], whole.predicted_speed_rad_s[:, 1])
    assert not prediction.valid[100:170, 0].any()
    assert np.isnan(prediction.predicted_speed_rad_s[151:170, 0]).all()


@pytest.mark.parametrize("runs_away_to_rad_s", [np.inf, 1e12])
def test_a_fan_that_diverges_within_a_block_restarts_from_the_next_reading(runs_away_to_rad_s: float) -> None:
    command = np.full((40, 2), 40.0)
    command[10, 0] = command[25, 0] = 90.0
    core = core_of(unstable_twin(2, runs_away_to_rad_s))
    prediction = feed(core, [grid_of(command)])
    assert (core.counters()["diverged"], core.counters()["free_runs"]) == (2, 2 + 2)
    assert (~prediction.valid).sum() <= 2  # at which it diverged
    assert np.nanmax(prediction.predicted_speed_rad_s) < 1e9  # the fastest of the twin's training


def test_a_discrete_twin_at_another_rate_says_so_and_judges_nothing() -> None:
    core = core_of(physical_twin(fixed_rate=True))
    prediction = feed(core, [grid_of(stairs(20), period_ns=2 * STEP_NS)])
    assert (prediction.invalid_reason == InvalidReason.NO_TWIN).all()
    assert "rate_hz = 100" in core.problem()
    assert feed(core_of(physical_twin(fixed_rate=True)), [grid_of(stairs(20))]).valid.all()


def test_on_a_grid_slower_than_its_training_the_twin_takes_steps_as_long_as_those() -> None:
    twin = physical_twin()
    per_second = round(twin.card.rate_hz)
    seconds = np.repeat(np.array([60.0, 80.0, 40.0, 70.0]), 3)
    slow = grid_of(seconds, period_ns=10**9)
    fine = grid_of(np.repeat(seconds, per_second), period_ns=10**9 // per_second)
    found, expected = (feed(core_of(twin), [grid]).predicted_speed_rad_s for grid in (slow, fine))
    np.testing.assert_array_equal(found, expected[::per_second])


def _context(folder: Path, twin: Path | None, *tacho: Tacho) -> Context:
    tray = TrayConfig(name="tray1", fans=2, twin=twin, tacho=tacho or INSTANTANEOUS)
    return Context("site", (tray,), TwinIntegratorConfig(), folder, folder, EPOCH_NS)


def test_without_a_twin_samples_pass_and_none_is_valid(tmp_path: Path) -> None:
    write_twin(tmp_path / "twin.onnx")
    assert STAGE.build(_context(tmp_path, Path("twin.onnx"))).core.tick(0), "it is found beside the configuration"
    core = STAGE.build(_context(tmp_path, None)).core
    grid = grid_of(np.full((5, 2), 50.0))
    (made,) = core.step(grid)
    assert isinstance(made, Prediction)
    assert (made.invalid_reason == InvalidReason.NO_TWIN).all()
    assert core.step(grid) == [], "the same samples again"
    assert core.step(grid_of(np.full(5, 50.0))) == []
    assert core.counters() == {"repeated": 5, "lost_wrong_fan_count": 5}
    assert core.problem() == "grid samples of 1 fans, [[tray]] says fans = 2: correct one of them"
    core.step(grid)
    assert core.problem() == ""


def test_a_bridge_of_absurdly_many_samples_is_not_run() -> None:
    steps: list[int] = []
    twin = physical_twin()

    def counted(state: Floats, command: Floats, period_s: Floats) -> tuple[Floats, Floats]:
        steps.append(len(command))
        return np.zeros(command.shape), state

    core = core_of(replace(twin, advance_with=lambda _: counted))
    grid = grid_of(np.zeros(2), period_ns=1)
    grid.t_ns[1] = grid.t_ns[0] + 300_000_000  # shorter than the command is held
    core.step(grid)
    assert sum(steps) <= 4
    assert core.counters()["free_runs"] == 2


def test_another_session_of_the_resampler_starts_the_twin_again() -> None:
    """Its times may differ by tens of milliseconds: on a ramp, the balance saw a jump, and a healthy fan alarmed."""
    core = core_of(warm_up_s=0.05)
    command = np.full(60, 50.0)
    blocks = [
        of_session(grid_of(command, command), "resampler-all-1"),
        of_session(grid_of(command, command, first=50), "resampler-all-1"),
        of_session(grid_of(command, command, first=100), "resampler-all-2"),
        of_session(grid_of(command, command, first=160), "resampler-all-2"),
    ]
    made = [message for block in blocks for message in core.step(block) if isinstance(message, Prediction)]
    assert [(m.invalid_reason == InvalidReason.WARMING_UP).sum() for m in made] == [5, 0, 5, 0]
    assert core.counters()["free_runs"] == 2
    assert [np.isnan(m.torque_balance_command[0, 0]) for m in made] == [True, False, True, False]


@pytest.mark.parametrize("moves_to", [51.0, 70.0])
def test_a_gap_in_which_the_command_has_moved_starts_the_twin_again(moves_to: float) -> None:
    """The command was held meanwhile, and the twin is wrong by what the fan has done on the real one."""
    core = core_of()
    low, high = physical_twin().card.command_range
    command = np.concatenate((np.full(30, 50.0), np.full(70, moves_to)))
    grid = grid_of(command, command)
    grid.invalid_reason[30:50] = InvalidReason.GAP
    grid.valid[30:50] = False
    core.step(grid)
    large = (moves_to - 50.0) * 0.2 > 0.01 * (high - low)
    assert core.counters()["free_runs"] == (2 if large else 1)


def test_the_twin_starts_again_after_the_clock_of_the_device_has_restarted():
    core = core_of()
    grid = grid_of(np.full(100, 50.0), np.full(100, 50.0))
    grid.invalid_reason[60] = InvalidReason.CLOCK_RESTARTED
    grid.valid[60] = False
    (prediction,) = (message for message in core.step(grid) if isinstance(message, Prediction))
    assert core.counters()["free_runs"] == 2
    balance = prediction.torque_balance_command[:, 0]
    assert np.isfinite(balance[55])
    assert np.isnan(balance[61:70]).all()
    assert np.isfinite(balance[99])


COUNTING = Tacho(kind="count", window_s=1.0)


def test_a_counting_tacho_has_a_range_of_readings_as_wide_as_the_twin_has_moved_in_its_window() -> None:
    grid = grid_of(np.repeat([40.0, 80.0], 100), period_ns=100_000_000)
    shown = feed(core_of(physical_twin(tacho=(COUNTING,))), [grid])
    half_range = shown.reading_range_rad_s[:, 0]
    assert half_range[90] < 1.0 < half_range[105] and half_range[199] < 1.0
    assert np.ptp(shown.predicted_speed_rad_s[100:120]) > half_range.max()
    assert not len(feed(core_of(), [grid]).reading_range_rad_s)


def test_a_twin_of_another_tacho_is_refused_with_what_to_correct(tmp_path: Path) -> None:
    write_twin(tmp_path / "twin.onnx", tacho=[COUNTING.model_dump()])
    assert not STAGE.check(_context(tmp_path, Path("twin.onnx"), COUNTING))
    assert STAGE.check(_context(tmp_path, Path("twin.onnx")))
    (problem,) = STAGE.check(_context(tmp_path, Path("twin.onnx"), Tacho(kind="count", window_s=0.5)))
    assert "trained on readings by count over 1 s, 2 pulses" in problem
    assert "those of the tray are by count over 0.5 s" in problem

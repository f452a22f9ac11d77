"""stages.resampler: a uniform grid from irregular samples, without invented values."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from pydantic import ValidationError

from fantwin.schemas.blocks import join, present_columns
from fantwin.schemas.enums import InvalidReason, TachoKind
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Grid, Raw, StatedTacho
from fantwin.schemas.tacho import Tacho
from fantwin.schemas.units import NS_PER_S
from fantwin.stages.resampler import ResamplerConfig, ResamplerCore
from tests.support.clockless_device import EPOCH_NS, NAN, at, raw

STEP_NS = 10_000_000
FIXED = ResamplerConfig(rate_hz=100.0)


def run(messages: Iterable[Raw], fans: int = 1, **config: float) -> tuple[Grid, ResamplerCore]:
    core = ResamplerCore(fans, ResamplerConfig.model_validate({"rate_hz": 100.0} | config))
    grids = [grid for message in messages for grid in core.step(message)]
    return join([*grids, *core.close()]), core


def assert_same(a: Grid, b: Grid) -> None:
    for name in ("t_ns", "command", "speed_rad_s", "valid", "invalid_reason", "reading_missing", "reading_repeated"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def irregular(seconds: float, seed: int = 3, jitter_s: float = 0.004) -> NDArray[np.int64]:
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, seconds, 0.01)
    return at(*(times + rng.uniform(-jitter_s, jitter_s, len(times)) + jitter_s))


def seconds_of(t_ns: NDArray[np.int64]) -> NDArray[np.float64]:
    return (t_ns - EPOCH_NS) / NS_PER_S


def test_a_sine_is_interpolated_to_the_second_order_of_the_spacing() -> None:
    omega, errors = 5.0, []
    for spacing_s in (0.02, 0.01):
        times_s = np.arange(0.0, 5.0, spacing_s) + 0.0013
        grid, _ = run([raw(at(*times_s), np.sin(omega * times_s))], rate_hz=1000)
        error = np.abs(grid.speed_rad_s[:, 0] - np.sin(omega * seconds_of(grid.t_ns))).max()
        assert error <= (omega * spacing_s) ** 2 / 8 * 1.001  # the bound of linear interpolation
        errors.append(error)
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.1)


def test_the_command_is_that_of_the_last_sample_at_or_before() -> None:
    grid, _ = run([raw(at(0.0, 0.02, 0.031, 0.05), np.zeros(4), np.array([1.0, 2.0, 3.0, 4.0]))])
    assert grid.command[:, 0].tolist() == [1, 1, 2, 2, 3, 4]


def test_a_grid_sample_is_published_with_the_first_raw_sample_at_or_after_it() -> None:
    core = ResamplerCore(1, FIXED)
    steps = [core.step(raw(at(t), np.zeros(1))) for t in (0.001, 0.009, 0.0101, 0.02)]
    assert [[seconds_of(g.t_ns).round(3).tolist() for g in grids] for grids in steps] == [[], [], [[0.01]], [[0.02]]]


def test_what_a_message_completes_is_one_message_unless_it_is_very_long() -> None:
    core = ResamplerCore(1, FIXED.model_copy(update={"gap_limit_s": 1.0, "watermark_s": 50.0}))
    assert [len(grid.t_ns) for grid in core.step(raw(at(*np.arange(0.0, 0.2, 0.01)), np.zeros(20)))] == [20]
    assert [len(grid.t_ns) for grid in core.step(raw(at(90.0), np.zeros(1)))] == [4096, 4096, 9001 - 20 - 8192]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(-3 * STEP_NS, 12 * STEP_NS), min_size=1, max_size=80))
def test_for_any_sample_times_the_grid_rises_without_repeats_and_never_bridges_a_gap(steps: list[int]) -> None:
    t_ns = EPOCH_NS + np.cumsum(steps)
    core = ResamplerCore(1, FIXED)
    grids = [*core.step(raw(t_ns, np.arange(0.0, len(t_ns)))), *core.close()]
    if not grids:
        return
    grid = join(grids)
    assert (np.diff(grid.t_ns) == STEP_NS).all()
    accepted = np.unique(np.maximum.accumulate(t_ns))
    right = np.searchsorted(accepted, grid.t_ns)
    spans = accepted[right] - accepted[np.maximum(right - 1, 0)]
    bridged = (accepted[right] == grid.t_ns) | (spans <= FIXED.timing(100.0).gap_limit_ns)
    np.testing.assert_array_equal(grid.valid[:, 0], bridged)
    np.testing.assert_array_equal(np.isfinite(grid.speed_rad_s[:, 0]), bridged)


def test_repeated_and_out_of_order_samples_are_dropped_and_counted() -> None:
    grid, core = run([raw(at(0.0, 0.01, 0.01, 0.03, 0.02, 0.04), np.array([0.0, 1, 99, 3, 99, 4]))])
    np.testing.assert_allclose(grid.speed_rad_s[:, 0], [0, 1, 2, 3, 4])
    assert (core.counters()["repeated"], core.counters()["lost_out_of_order"]) == (1, 1)


def test_a_gap_is_marked_and_holds_the_command_and_one_of_exactly_the_limit_is_bridged() -> None:
    grid, core = run([raw(at(0.0, 0.01, 0.2, 0.21), np.ones(4), np.array([1.0, 2.0, 3.0, 3.0]))])
    none, gap = InvalidReason.NONE, InvalidReason.GAP
    assert grid.invalid_reason[:, 0].tolist() == [none] * 2 + [gap] * 18 + [none] * 2
    assert np.isnan(grid.speed_rad_s[2:20]).all()
    assert (grid.command[2:20] == 2.0).all()
    assert (core.counters()["gaps"], core.counters()["grid_samples_in_gaps"]) == (1, 18)
    grid, core = run([raw(at(0.0, 0.1, 0.2001), np.zeros(3))])
    assert grid.valid[:11].all() and not grid.valid[11:].any()
    assert core.counters()["gaps"] == 1


def test_after_a_long_silence_the_grid_ends() -> None:
    grid, core = run([raw(at(0.0, 3600.0, 3600.01), np.zeros(3))])
    why = grid.invalid_reason[:, 0].tolist()
    assert (
        why == [InvalidReason.NONE] + [InvalidReason.GAP] * 50 + [InvalidReason.STALE] * 450 + [InvalidReason.NONE] * 2
    )
    assert seconds_of(grid.t_ns)[-2:].tolist() == [3600.0, 3600.01]
    assert core.counters()["grid_samples_in_gaps"] == 359_999
    _, core = run([raw(at(*np.arange(0.0, 10.0, 0.01), 20.0), np.zeros(1001))])
    assert "1, 50.0 % of the time" in core.notes()[0], "also of the part of the gap in which nothing is published"


def _ticks(core: ResamplerCore, from_s: float, to_s: float, period_s: float = 0.05) -> list[Grid]:
    return [grid for t in np.arange(from_s, to_s, period_s) for grid in core.tick(int(at(t)[0]))]


def test_a_replay_gives_the_grid_that_was_published_during_a_silence() -> None:
    messages = [raw(at(0.0, 0.01), np.ones(2)), raw(at(3.0, 3.01), np.ones(2))]
    core = ResamplerCore(1, FIXED)
    live = [*core.step(messages[0]), *_ticks(core, 0.01, 2.9)]
    assert join(live).invalid_reason[-1, 0] == InvalidReason.STALE
    live += core.step(messages[1])
    replayed, _ = run(messages)
    assert_same(join(live), replayed)


def test_nothing_is_published_before_the_watermark_or_beyond_the_end_and_a_stalled_host_is_no_silence() -> None:
    core = ResamplerCore(1, FIXED)
    core.step(raw(at(0.0), np.ones(1)))
    assert _ticks(core, 0.0, 0.2) == core.tick(int(at(30.0)[0])) == []
    assert join(core.step(raw(at(0.01), np.ones(1)))).valid.all(), "it was the host that stalled"
    core = ResamplerCore(1, FIXED)
    core.step(raw(at(0.0), np.ones(1)))
    assert _ticks(core, 0.0, 0.5) == []
    assert core.problem() == ""
    grid = join(_ticks(core, 0.5, 60.0))
    assert seconds_of(grid.t_ns[[0, -1]]).tolist() == [0.01, 5.0]
    problem = core.problem()
    assert "acquisition" in problem
    _ticks(core, 60.0, 63.0)
    assert core.problem() == problem  # without a duration, which would be a change to report every second
    core.close()
    assert not core.problem(), "the silence before an orderly stop is none"


def test_a_sample_that_arrives_after_its_grid_time_was_published_is_counted_as_lost() -> None:
    core = ResamplerCore(1, FIXED)
    core.step(raw(at(0.0), np.ones(1)))
    given_up = join(_ticks(core, 0.0, 0.7))
    grid = join(core.step(raw(at(0.01, 0.5, 0.55), np.array([5.0, 6.0, 7.0]))))
    assert core.counters()["lost_too_late"] == 1
    assert grid.t_ns[0] == given_up.t_ns[-1] + STEP_NS


def test_a_reading_that_is_held_where_a_line_was_lost_is_known_to_be_repeated() -> None:
    counts, reads_at_once = Tacho(kind="count", window_s=0.5), Tacho()
    lines = raw(at(0.0, 0.01, 0.03, 0.04, 0.055), np.array([1.0, 2.0, 4.0, 5.0, 6.0]), fans=2)
    core = ResamplerCore(2, FIXED, tachos=(counts, reads_at_once))
    grid = join([*core.step(lines), *core.close()])
    np.testing.assert_array_equal(grid.speed_rad_s, [[1, 1], [2, 2], [2, 3], [4, 4], [5, 5], [5, 5 + 2 / 3]])
    np.testing.assert_array_equal(grid.reading_repeated[:, 0], [False, False, True, False, False, True])
    assert not grid.reading_repeated[:, 1].any()
    assert grid.valid.all() and not grid.reading_missing.any()


def test_a_missing_reading_is_interpolated_up_to_the_limit_and_the_other_fan_is_untouched() -> None:
    speed = np.array([[0.0, 10.0], [1.0, NAN], [2.0, NAN], [3.0, 40.0]])
    grid, _ = run([raw(at(0.0, 0.01, 0.02, 0.03), speed, fans=2)], fans=2)
    np.testing.assert_allclose(grid.speed_rad_s, [[0, 10], [1, 20], [2, 30], [3, 40]])
    assert grid.valid.all()
    assert grid.reading_missing.tolist() == [[False, False], [False, True], [False, True], [False, False]]
    times_s = np.arange(31) / 100
    speed = np.stack([times_s, np.where((times_s > 0.055) & (times_s < 0.195), NAN, 1.0)], axis=1)
    grid, _ = run([raw(at(*times_s), speed, fans=2)], fans=2)
    assert grid.valid[:, 0].all()
    missing = np.flatnonzero(~grid.valid[:, 1])
    assert missing.tolist() == list(range(6, 20))
    assert (grid.invalid_reason[missing, 1] == InvalidReason.NO_SPEED).all()
    assert np.isnan(grid.speed_rad_s[missing, 1]).all()


def with_columns(times_s: list[float], **columns: list[float]) -> Raw:
    given: dict[str, Any] = {name: np.array(values, np.float32)[:, np.newaxis] for name, values in columns.items()}
    return replace(raw(at(*times_s), np.full(len(times_s), 100.0)), **given)


def test_columns_are_interpolated_between_samples_held_before_one_that_has_none_and_bridge_no_gap() -> None:
    volts, celsius = [12.0, 11.0, 12.0, 13.0], [20.0, NAN, NAN, 22.0]
    grid, _ = run([with_columns([0.0, 0.02, 0.04, 0.06], supply_voltage_v=volts, temperature_c=celsius)])
    np.testing.assert_allclose(grid.supply_voltage_v[:, 0], [12.0, 11.5, 11.0, 11.5, 12.0, 12.5, 13.0])
    np.testing.assert_array_equal(grid.temperature_c[:, 0], [20.0, 20.0, NAN, NAN, NAN, NAN, 22.0])
    grid, _ = run([with_columns([0.0, 0.01, 0.02, 0.30, 0.31], supply_voltage_v=[12.0, 12.0, 12.0, 11.0, 11.0])])
    known = np.isfinite(grid.supply_voltage_v[:, 0])
    np.testing.assert_array_equal(known, grid.valid[:, 0])
    assert 0 < known.sum() < len(known)
    core = ResamplerCore(1, FIXED)
    later = with_columns([0.03, 0.04, 0.05], supply_voltage_v=[12.0, 12.0, 12.0])
    grids = [g for m in (with_columns([0.0, 0.01]), later, with_columns([0.06, 0.07])) for g in core.step(m)]
    assert [present_columns(grid)[1:] for grid in grids] == [(), *[("supply_voltage_v",)] * 2], (
        "from its first value on"
    )


def test_a_tacho_that_fails_delays_the_others_once_by_the_gap_limit_and_none_at_all_never() -> None:
    core, without = ResamplerCore(2, FIXED), ResamplerCore(2, FIXED)
    sizes = []
    for k in range(40):
        made = core.step(raw(at(k / 100), np.array([[1.0, 1.0 if k < 10 else NAN]]), fans=2))
        sizes.append(sum(len(grid.t_ns) for grid in made))
        (grid,) = without.step(raw(at(k / 100), np.array([[1.0, NAN]]), fans=2))
        assert seconds_of(grid.t_ns).tolist() == [k / 100]
        assert grid.invalid_reason.tolist() == [[InvalidReason.NONE, InvalidReason.NO_SPEED]]
    assert sizes == [1] * 10 + [0] * 10 + [11] + [1] * 19
    waiting, _ = run([raw(at(0.0, 0.01), np.array([[1.0, 1.0], [1.0, NAN]]), fans=2)], fans=2)
    assert waiting.invalid_reason[:, 1].tolist() == [InvalidReason.NONE, InvalidReason.NO_SPEED], "published at the end"


def test_samples_of_another_number_of_fans_are_counted_and_reported_until_the_right_one_comes() -> None:
    core = ResamplerCore(2, FIXED)
    assert core.step(raw(at(0.0, 0.01), np.zeros(2), fans=3)) == []
    assert core.counters()["lost_wrong_fan_count"] == 2
    assert "raw samples of 3 fans, [[tray]] says fans = 2" in core.problem()
    core.step(raw(at(0.01), np.zeros(1), fans=2))
    assert core.problem() == ""


def test_limits_in_the_wrong_order_are_refused() -> None:
    with pytest.raises(ValidationError, match="must not be shorter"):
        ResamplerConfig(gap_limit_s=1.0, watermark_s=0.5)


def sent(producer: str, first: int, count: int, start_s: float, clock: bool = True, clock_start_us: int = 0) -> Raw:
    """Samples of one session of acquisition, numbered by the device from `first` on, 10 ms apart."""
    times_s = start_s + np.arange(count) * 0.01
    clock_us = (clock_start_us + np.rint(times_s * 1e6).astype(np.int64)) % 2**32
    return replace(
        raw(at(*times_s), np.zeros(count)),
        header=Header(producer, 0, "t"),
        device_clock_us=clock_us.astype(np.uint32) if clock else np.zeros(0, np.uint32),
        device_sequence=((first + np.arange(count)) % 2**32).astype(np.uint32),
    )


@pytest.mark.parametrize(
    ("name", "messages", "lost"),
    [
        ("sent nothing for a while", [sent("a", 0, 50, 0.0), sent("b", 97, 50, 0.97)], 47),
        ("has no clock", [sent("a", 2**32 - 53, 50, 0.0, False), sent("b", 2**32 + 44, 50, 0.97, False)], 47),
        ("goes on without a gap", [sent("a", 0, 50, 0.0), sent("b", 50, 50, 0.5)], 0),
        ("brings some again", [sent("a", 0, 50, 0.0), sent("b", 40, 60, 0.4)], 0),
        ("is the same session, which counts for itself", [sent("a", 0, 50, 0.0), sent("a", 60, 50, 0.6)], 0),
        ("device restarted", [sent("a", 0, 50, 5.0), sent("b", 60, 50, 6.0, clock_start_us=-6_000_000)], 0),
        ("device restarted, without a clock", [sent("a", 900, 50, 0.0, False), sent("b", 0, 50, 0.6, False)], 0),
        ("first there is", [sent("b", 4000, 50, 0.0)], 0),
    ],
)
def test_samples_that_no_session_has_are_counted_by_their_sequence(name: str, messages: list[Raw], lost: int) -> None:
    _, core = run(messages)
    assert core.counters().get("lost_between_sessions", 0) == lost, name


def stamped(message: Raw, producer: str, sequence: int) -> Raw:
    return replace(message, header=Header(producer, sequence, "tray1"))


def moved(message: Raw, by_s: float) -> Raw:
    return replace(message, host_receive_t_ns=message.host_receive_t_ns + round(by_s * NS_PER_S))


@pytest.mark.parametrize("producer", ["replay-a", "replay-b"], ids=["running on", "another"])
def test_samples_of_a_replay_that_goes_back_are_counted_and_reported_until_it_has_caught_up(producer: str) -> None:
    message = raw(at(0.0, 0.01), np.zeros(2))
    core = ResamplerCore(1, FIXED)
    core.step(stamped(message, "replay-a", 0))
    assert core.problem() == ""
    core.step(stamped(moved(message, -3600), producer, 1))
    core.step(stamped(moved(message, -3599), producer, 2))
    assert core.counters()["lost_clock_set_back"] == 4
    assert core.counters().get("out_of_order", 0) == 0
    assert core.problem() == (
        "the host clock was set back by 3600 s, or a replay was restarted: "
        "samples are refused until it has caught up; restart the stages"
    )
    core.step(stamped(moved(message, 1), producer, 3))
    assert core.problem() == ""


def test_health_says_when_messages_state_another_tacho_than_the_configuration() -> None:
    average = Tacho(kind="average", window_s=1.0, step_rad_s=0.1)
    core = ResamplerCore(2, ResamplerConfig(rate_hz=10.0), tachos=[average])
    message = replace(raw(at(0.0, 0.1), np.ones(2), fans=2), tachos=(StatedTacho.of(average),))
    core.step(message)
    assert core.problem() == ""
    core.step(replace(message, tachos=(StatedTacho.of(average), StatedTacho(TachoKind.PERIOD, pulses=2))))
    assert "for fan 1 period instead of average over 1 s, in steps of 0.1 rad/s: set tacho = " in core.problem()
    core.step(replace(message, tachos=(StatedTacho(TachoKind(99)),)))
    assert "a tacho that this version does not know" in core.problem()
    core.step(message)
    assert core.problem() == ""


SECOND_OF_A = replace(raw(at(*np.arange(0.0, 1.0, 0.01)), np.ones(100)), header=Header("acquisition-a-1", 0, ""))


def silent_for(core: ResamplerCore, seconds: float, *, is_complete: bool, from_s: float = 1.0) -> list[Grid]:
    made: list[Grid] = []
    for tick in range(round(seconds * 20)):
        core.confirm_input(is_complete=is_complete)
        made += core.tick(at(from_s + tick * 0.05).item())
    return made


def test_row_16_a_gap_of_the_link_is_no_gap_of_the_samples():
    times_s = np.arange(0.0, 20.0, 0.01)
    before, later = times_s[:100], times_s[100:]
    cut, whole = (ResamplerCore(1, FIXED) for _ in range(2))
    grids = [*cut.step(raw(at(*before), before)), *silent_for(cut, 10.0, is_complete=False)]
    assert "no raw samples for more than 0.5 s" in cut.problem()
    grids += [*cut.step(raw(at(*later), later)), *cut.close()]
    should = join([*whole.step(raw(at(*times_s), times_s)), *whole.close()])
    found = join(grids)
    assert np.array_equal(found.t_ns, should.t_ns)
    assert np.array_equal(found.speed_rad_s, should.speed_rad_s)
    assert found.valid.all()
    assert cut.counters().get("lost_too_late", 0) == 0


def test_row_16_a_gap_is_published_once_acquisition_shows_that_it_has_sent_nothing_or_after_too_long_a_doubt(
    monkeypatch,
):
    core = ResamplerCore(1, FIXED)
    monkeypatch.setattr("fantwin.stages.resampler.LINK_WAIT_S", 20.0)
    doubts = ResamplerCore(1, FIXED)
    for each in (core, doubts):
        each.step(raw(at(*np.arange(0.0, 1.0, 0.01)), np.ones(100)))
    assert silent_for(core, 3.0, is_complete=False) == []
    core.confirm_input(is_complete=True)
    found = join(core.tick(at(4.0).item()))
    assert not found.valid.any()
    assert found.t_ns[-1] == at(3.49), "up to the watermark before the time at which it is shown"
    assert silent_for(core, 2.0, is_complete=False, from_s=4.0) == []
    assert silent_for(doubts, 19.0, is_complete=False) == []
    found = join(silent_for(doubts, 3.0, is_complete=False, from_s=20.0))
    assert found.t_ns[-1] == at(0.99) + 5 * NS_PER_S, "the grid ends after five seconds"
    assert not found.valid.any()


@pytest.mark.parametrize(("cut_s", "step_s"), [(2.0, 0.05), (50.0, 0.1)])
def test_row_16_samples_of_the_next_session_that_are_not_admitted_yet_are_no_silence(cut_s: float, step_s: float):
    """The samples are over a second away from the earlier ones. All that was sent has arrived; more samples must
    decide."""
    core = ResamplerCore(1, FIXED)
    core.step(SECOND_OF_A)
    assert silent_for(core, cut_s, is_complete=False) == []
    grids: list[Grid] = []
    for number in range(40):
        times_s = 3.0 + step_s * number + np.arange(0.0, step_s, 0.01)
        new = raw(at(*times_s), np.ones(len(times_s)))
        grids += core.step(replace(new, header=Header("acquisition-a-2", number, "")))
        grids += silent_for(core, step_s, is_complete=True, from_s=1.0 + cut_s + step_s * number)
    assert "lost_too_late" not in core.counters()
    found = join(grids)
    assert seconds_of(found.t_ns[found.valid.all(axis=1)])[0] == pytest.approx(3.0)


@pytest.mark.parametrize(
    "times_s",
    [
        pytest.param(lambda number: [-100.0 + number * 1e-6], id="hardly any advance"),
        pytest.param(lambda number: [-100.0 + 6.0 * number], id="far apart"),
        pytest.param(lambda number: [-100.0 * (1 + number % 2), -99.9 * (1 + number % 2)], id="two producers by turns"),
    ],
)
def test_row_16_samples_of_another_time_do_not_hide_a_silence_of_the_line(times_s: Callable[[int], list[float]]):
    core = ResamplerCore(1, FIXED)
    core.step(SECOND_OF_A)
    grids: list[Grid] = []
    for number in range(40):
        sent = raw(at(*times_s(number)), np.ones(len(times_s(number))))
        grids += core.step(replace(sent, header=Header(f"acquisition-a-{2 + number % 2}", number // 2, "")))
        grids += silent_for(core, 0.2, is_complete=True, from_s=1.0 + 0.2 * number)
    found = join(grids)
    assert not found.valid[found.t_ns > at(1.0)].any()
    assert found.t_ns[-1] > at(3.0)
    assert "no raw samples for more than 0.5 s" in core.problem()

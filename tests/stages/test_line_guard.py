"""stages.resampler: samples of another time, backlogs, and host clocks that are set, on one line."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain, groupby, islice

import numpy as np
import pytest

from fantwin.schemas.blocks import join
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Grid, Raw
from fantwin.schemas.units import NS_PER_S
from fantwin.stages.resampler import ResamplerConfig, ResamplerCore

EPOCH_NS = 1_700_000_000_000_000_000
HZ = 100
FIXED = ResamplerConfig(rate_hz=HZ)
PERIOD_NS = NS_PER_S // HZ
RAD_S_PER_S = 10.0
"""the speed rises this fast, so that an error of time shows as an error of slope"""


def sample(number: int, *, delay_s: float = 0.001, producer: str = "acquisition-a", clock: bool = True) -> Raw:
    """Sample `number` of the device, measured at number / HZ seconds."""
    t_ns = EPOCH_NS + number * PERIOD_NS
    return Raw(
        header=Header(producer, number, "tray1"),
        fans=1,
        host_receive_t_ns=np.array([t_ns + round(delay_s * NS_PER_S)], np.int64),
        device_clock_us=np.array([number * 10_000 % 2**32] if clock else [], np.uint32),
        device_sequence=np.array([number % 2**32] if clock else [], np.uint32),
        command=np.full((1, 1), 50.0),
        speed_rad_s=np.full((1, 1), number / HZ * RAD_S_PER_S),
    )


def line(first_s: float, last_s: float, **more: object) -> Iterator[Raw]:
    return (sample(number, **more) for number in range(round(first_s * HZ), round(last_s * HZ)))  # type: ignore[arg-type]


def shifted(messages: Iterator[Raw], by_s: float) -> Iterator[Raw]:
    for message in messages:
        yield replace(message, host_receive_t_ns=message.host_receive_t_ns + round(by_s * NS_PER_S))


def after_stall(from_s: float, until_s: float, received_s: float | None = None) -> Iterator[Raw]:
    """What was measured in a stall, all received at its end."""
    received_t_ns = EPOCH_NS + round(((until_s if received_s is None else received_s) + 0.002) * NS_PER_S)
    for message in line(from_s, until_s):
        yield replace(message, host_receive_t_ns=np.array([received_t_ns], np.int64))


def core_of() -> ResamplerCore:
    return ResamplerCore(1, FIXED)


def grid_of(core: ResamplerCore, *parts: Iterable[Raw]) -> Grid:
    """The grid of these messages; those of one producer that follow one another are joined, which changes nothing."""
    grids: list[Grid] = []
    for _, of_one in groupby(chain(*parts), key=lambda message: message.header.producer):
        while block := list(islice(of_one, 64)):
            grids += core.step(join(block))
    return join([*grids, *core.close()])


def slopes(grid: Grid) -> np.ndarray:
    """Slopes of the speed between neighbouring valid samples of the grid, rad/s per second."""
    both = grid.valid[1:, 0] & grid.valid[:-1, 0]
    return (np.diff(grid.speed_rad_s[:, 0]) / np.diff(grid.t_ns) * NS_PER_S)[both]


def assert_restarts_are_marked(grid: Grid) -> None:
    """Where times do not continue, as the speed shows that grows by RAD_S_PER_S, a sample says so."""
    valid = np.flatnonzero(grid.valid[:, 0])
    offsets_s = grid.speed_rad_s[valid, 0] / RAD_S_PER_S - (grid.t_ns[valid] - EPOCH_NS) / NS_PER_S
    breaks = np.flatnonzero(np.abs(np.diff(offsets_s)) > 0.02)
    marks = np.flatnonzero(grid.invalid_reason[:, 0] == InvalidReason.CLOCK_RESTARTED)
    assert len(marks)
    for last, first in zip(valid[breaks], valid[breaks + 1], strict=True):
        assert ((last < marks) & (marks < first)).any()


def valid_after(grid: Grid, t_s: float) -> int:
    return int(grid.valid[grid.t_ns > EPOCH_NS + t_s * NS_PER_S, 0].sum())


# row 2


@pytest.mark.parametrize("ahead_s", [60.0, -3600.0])
@pytest.mark.parametrize("clock", [True, False], ids=["device clock", "no device clock"])
def test_row_02_a_message_of_another_time_from_another_producer_moves_nothing(ahead_s: float, clock: bool) -> None:
    (forged,) = shifted(iter([sample(1, producer="acquisition-forged", clock=clock)]), 20.0 + ahead_s)
    core, undisturbed = core_of(), core_of()
    grid = grid_of(core, line(0, 20, clock=clock), [forged], line(20, 40, clock=clock))
    expected = grid_of(undisturbed, line(0, 40, clock=clock))
    assert grid.t_ns.tolist() == expected.t_ns.tolist()
    assert grid.speed_rad_s.tobytes() == expected.speed_rad_s.tobytes()
    assert core.counters()["refused_other_time"] == 1
    assert core.counters().get("out_of_order", 0) == 0
    assert not [name for name in core.counters() if name.startswith("lost_")]
    side = "ahead of" if ahead_s > 0 else "behind"
    assert core.problem().startswith(f"raw samples of acquisition-forged are {abs(ahead_s):.0f} s {side} those of")


def test_row_02_acquisition_that_returns_after_some_time_is_the_line_again() -> None:
    core, away_s = core_of(), 5.0
    grid = grid_of(core, line(0, 20), line(20 + away_s, 40 + away_s, producer="acquisition-b"))
    assert valid_after(grid, 20 + away_s) >= 19.9 * HZ, "all of its samples, also the first"
    assert core.counters().get("refused_other_time", 0) == 0
    assert core.problem() == ""


# row 5


@pytest.mark.parametrize("stall_s", [6.0, 60.0])
def test_row_05_a_backlog_after_a_stall_of_any_length_keeps_its_times(stall_s: float) -> None:
    core = core_of()
    end_s = 20 + stall_s
    grid = grid_of(core, line(0, 20), after_stall(20, end_s), line(end_s, end_s + 15))
    np.testing.assert_allclose(slopes(grid), RAD_S_PER_S, rtol=0.03)
    assert grid.valid.all(), "nothing is missing: the samples were only late"
    assert core.counters()["clock_restarts"] == 0


def test_row_05_a_backlog_that_comes_after_the_grid_has_ended_continues_it() -> None:
    core = core_of()
    ticks = [grid for tenths in range(200, 300) for grid in core.tick(EPOCH_NS + tenths * NS_PER_S // 10)]
    assert not ticks, "nothing before the first sample"
    before = [grid for message in line(0, 20) for grid in core.step(message)]
    before += [grid for tenths in range(200, 300) for grid in core.tick(EPOCH_NS + tenths * NS_PER_S // 10)]
    grid = grid_of(core, after_stall(20, 30), line(30, 50))
    assert grid.t_ns[0] == join(before).t_ns[-1] + PERIOD_NS, (
        "five seconds were given up, and those that follow are not"
    )
    assert (grid.t_ns[0] - EPOCH_NS) / NS_PER_S == pytest.approx(25.0, abs=0.1)
    assert grid.valid.all()
    np.testing.assert_allclose(slopes(grid), RAD_S_PER_S, rtol=0.03)


@pytest.mark.parametrize(("kept", "valid_s"), [((20, 30), 44.9), ((1980, 2000), 33.0)], ids=["first", "last"])
def test_row_05_a_backlog_of_a_part_of_a_stall_of_half_an_hour_gives_no_false_slope(
    kept: tuple[int, int], valid_s: float
) -> None:
    core = core_of()
    grid = grid_of(core, line(0, 20), after_stall(*kept, received_s=2000), line(2000, 2015))
    np.testing.assert_allclose(slopes(grid), RAD_S_PER_S, rtol=0.03)
    assert int(grid.valid.sum()) >= valid_s * HZ
    assert kept[0] > 20 or core.counters()["clock_restarts"] == 0


def test_row_05_a_backlog_that_drains_slowly_is_no_clock_that_was_set() -> None:
    def draining() -> Iterator[Raw]:
        for message, number in zip(line(20, 80), range(6000), strict=True):
            at_s = max(20 + number / HZ, 28 + number / HZ / 1.3)
            yield replace(message, host_receive_t_ns=np.array([EPOCH_NS + round(at_s * NS_PER_S)], np.int64))

    core = core_of()
    grid = grid_of(core, line(0, 20), draining())
    np.testing.assert_allclose(slopes(grid), RAD_S_PER_S, rtol=0.03)
    assert core.counters()["clock_restarts"] == 0


def test_row_05_a_host_clock_set_forward_is_followed_within_seconds_without_a_false_slope() -> None:
    core = core_of()
    grid = grid_of(core, line(0, 20), shifted(line(20, 40), 3600.0))
    np.testing.assert_allclose(slopes(grid), RAD_S_PER_S, rtol=0.03)
    assert core.counters()["clock_restarts"] == 1
    assert valid_after(grid, 3600) > 13 * HZ
    assert_restarts_are_marked(grid)


def test_row_05_a_stall_just_after_the_host_clock_was_set_does_not_join_times_that_do_not_continue() -> None:
    """The new times begin in the backlog, are seconds late, and begin once more."""
    core, parts = core_of(), (line(20, 22), after_stall(22, 30), line(30, 60))
    grid = grid_of(core, line(0, 20), shifted(chain(*parts), 3600.0))
    np.testing.assert_allclose(slopes(grid), RAD_S_PER_S, rtol=0.03)
    assert core.counters()["clock_restarts"] >= 2
    assert_restarts_are_marked(grid)


def test_row_05_a_restarted_device_gives_no_false_slope() -> None:
    core = core_of()
    restarted = (
        replace(
            sample(number),
            device_clock_us=np.array([(number - 2050) * 10_000], np.uint32),
            device_sequence=np.array([number - 2050], np.uint32),
        )
        for number in range(2050, 4000)
    )
    grid = grid_of(core, line(0, 20), restarted)
    np.testing.assert_allclose(slopes(grid), RAD_S_PER_S, rtol=0.03)
    assert core.counters()["clock_restarts"] == 1
    assert_restarts_are_marked(grid)


# row 13


@pytest.mark.parametrize("clock", [True, False], ids=["device clock", "no device clock"])
@pytest.mark.parametrize("producer", ["acquisition-a", "acquisition-b"], ids=["running on", "restarted"])
def test_row_13_after_the_host_clock_was_set_back_an_hour_judging_continues(clock: bool, producer: str) -> None:
    core = core_of()
    grid = grid_of(core, line(0, 20, clock=clock), shifted(line(20, 40, clock=clock, producer=producer), -3600.0))
    assert (np.diff(grid.t_ns) > 0).all()
    assert valid_after(grid, 20) >= 19.9 * HZ
    np.testing.assert_allclose(slopes(grid), RAD_S_PER_S, rtol=0.05)
    assert core.counters()["host_clock_set_back"] == 1
    assert core.problem() == (
        "the host clock was set back by 3600 s: sample times continue without a step, 3600 s ahead of it, until the "
        "site is restarted"
    )


def test_row_13_a_host_clock_that_is_put_right_again_ends_the_shift() -> None:
    core = core_of()
    grid = grid_of(core, line(0, 20), shifted(line(20, 40), -3600.0), line(40, 60))
    assert valid_after(grid, 0) >= 59.9 * HZ
    np.testing.assert_allclose(slopes(grid), RAD_S_PER_S, rtol=0.03)
    assert grid.t_ns[-1] < EPOCH_NS + 60 * NS_PER_S

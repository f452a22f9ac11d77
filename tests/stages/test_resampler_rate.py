"""stages.resampler: without settings, rate, gap limit and watermark of the grid follow from the line."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from fantwin.pipeline.timebase.grid_timing import grid_rate_hz
from fantwin.schemas.blocks import join
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Array, Grid, Raw
from fantwin.schemas.units import NS_PER_S
from fantwin.stages.resampler import ResamplerConfig, ResamplerCore

EPOCH_NS = 1_700_000_000_000_000_000
CLOCK_START_US = 2**32 - 3_000_000  # it wraps while the rate is being measured


def samples(times_s: Array, *, clock: bool = True, producer: str = "p", first: int = 0) -> list[Raw]:
    """One sample a message, received up to 5 ms late, the first one the least."""
    delays_s = np.random.default_rng(1).uniform(0.001, 0.005, len(times_s)) if clock else np.zeros(len(times_s))
    delays_s[:1] = np.minimum(delays_s[:1], 0.001)
    return [
        Raw(
            header=Header(producer, first + k, "tray1"),
            fans=1,
            host_receive_t_ns=np.array([EPOCH_NS + round((t_s + delay_s) * NS_PER_S)]),
            device_clock_us=np.array([(CLOCK_START_US + round(t_s * 1e6)) % 2**32] if clock else [], np.uint32),
            command=np.array([[0.5]]),
            speed_rad_s=np.array([[100.0 + t_s]]),
        )
        for k, (t_s, delay_s) in enumerate(zip(times_s.tolist(), delays_s.tolist(), strict=True))
    ]


def times(rate_hz: float, seconds: float, jitter: float = 0.0) -> Array:
    """jitter: largest, in periods."""
    count = round(seconds * rate_hz)
    return (np.arange(count) + np.random.default_rng(2).uniform(-jitter, jitter, count)) / rate_hz


def grid_of(messages: Iterable[Raw], **config: float) -> tuple[Grid, ResamplerCore]:
    core = ResamplerCore(1, ResamplerConfig.model_validate(config))
    grids = [grid for message in messages for grid in core.step(message)]
    return join([*grids, *core.close()]), core


def test_a_first_sample_that_arrived_late_does_not_make_all_times_late() -> None:
    messages = samples(times(50, 20))
    late = [replace(m, host_receive_t_ns=np.maximum(m.host_receive_t_ns, EPOCH_NS + 400_000_000)) for m in messages]
    on_time, _ = grid_of(messages)
    grid, core = grid_of(late)
    assert core.counters()["clock_restarts"] == 0
    early_rad_s = np.interp(on_time.t_ns, grid.t_ns, grid.speed_rad_s[:, 0]) - on_time.speed_rad_s[:, 0]
    assert np.abs(early_rad_s[1:-1]).max() < 0.006  # the speed rises by 1 rad/s each second: 6 ms
    given, _ = grid_of(late, rate_hz=50.0)
    assert given.t_ns[0] > grid.t_ns[0] + 300_000_000


def test_what_a_line_had_kept_before_it_was_opened_is_on_the_grid_with_its_own_times() -> None:
    messages = samples(times(100, 25))
    on_time, _ = grid_of(messages)
    opened_ns, bytes_per_s = EPOCH_NS + 15 * NS_PER_S, 100_000
    kept = [
        replace(m, host_receive_t_ns=np.maximum(m.host_receive_t_ns, opened_ns + k * 40 * NS_PER_S // bytes_per_s))
        for k, m in enumerate(messages)
    ]
    grid, core = grid_of(kept)
    assert not [name for name, count in core.counters().items() if name.startswith("lost_") and count]
    assert core.counters()["clock_restarts"] == 0
    assert len(grid.t_ns) >= len(on_time.t_ns) - 2
    off_rad_s = np.interp(on_time.t_ns, grid.t_ns, grid.speed_rad_s[:, 0]) - on_time.speed_rad_s[:, 0]
    assert np.abs(off_rad_s[5:-5]).max() < 0.006  # the speed rises by 1 rad/s each second: 6 ms
    _, given = grid_of(kept, rate_hz=100.0)
    assert given.counters()["lost_out_of_order"] > 1000, "no settings: no wait for the line; what that costs is counted"


def test_a_device_whose_clock_runs_far_too_fast_is_not_waited_for_without_end() -> None:
    messages = samples(times(100, 100))
    squeezed = [replace(m, host_receive_t_ns=EPOCH_NS + (m.host_receive_t_ns - EPOCH_NS) // 100) for m in messages]
    _, core = grid_of(squeezed)
    counts = core.counters()
    assert counts["grid_samples"] > 5000
    assert counts["lost_out_of_order"] > 3000
    left_out = counts["lost_out_of_order"] + counts["dropped_after_clock_restart"]
    assert counts["grid_samples"] + left_out >= 0.99 * len(messages), "what is not on the grid is counted"


@pytest.mark.parametrize("clock", [True, False], ids=["clock", "no clock"])
@pytest.mark.parametrize(
    ("line_hz", "jitter", "grid_hz"),
    [(1, 0.05, 1), (2.1, 0.3, 2), (64, 0.3, 50), (1000, 0.2, 100)],
)
def test_the_grid_has_the_rate_of_the_line_and_no_sample_of_it_is_a_gap(
    line_hz: float, jitter: float, grid_hz: int, clock: bool
) -> None:
    line_s = times(line_hz, 30 if line_hz < 1000 else 6, jitter)
    grid, core = grid_of(samples(line_s, clock=clock))
    assert grid.period_ns == NS_PER_S // grid_hz
    assert grid.valid.all()
    assert core.counters().get("gaps", 0) == 0
    assert core.counters()["samples_in"] == len(line_s)
    assert core.problem() == ""
    assert f"grid of {grid_hz} Hz (the line sends " in core.notes()[0]
    # nothing is lost at the beginning: the grid starts with the first sample and has its values
    first_s, last_s = (grid.t_ns[[0, -1]] - EPOCH_NS) / NS_PER_S
    assert first_s - line_s[0] < 1 / grid_hz + 0.01
    assert line_s[-1] - last_s < 1 / grid_hz + 0.01
    np.testing.assert_allclose(grid.speed_rad_s[:, 0] - 100.0, (grid.t_ns - EPOCH_NS) / NS_PER_S, atol=0.012)


@pytest.mark.parametrize(("line_hz", "bridged_s"), [(1, 4.0), (100, 0.09)])
def test_a_real_gap_is_still_one(line_hz: float, bridged_s: float) -> None:
    line_s = times(line_hz, 60)
    lost = (line_s > 20) & (line_s < 20 + 8 / line_hz + 0.1)
    short = (line_s > 40) & (line_s < 40 + bridged_s)
    grid, core = grid_of(samples(line_s[~lost & ~short]))
    in_gap = np.isin(grid.invalid_reason[:, 0], (InvalidReason.GAP, InvalidReason.STALE))
    assert core.counters()["gaps"] == 1
    assert in_gap.sum() >= 7
    at_s = (grid.t_ns - EPOCH_NS) / NS_PER_S
    assert (at_s[in_gap] > 19.9).all()
    assert (at_s[in_gap] < 30).all()


def test_a_restarted_resampler_comes_to_the_same_rate_wherever_it_begins() -> None:
    for line_hz, seconds in ((1, 60), (4.8, 30), (20, 20), (100, 10)):
        messages = samples(times(line_hz, seconds, 0.3))
        starts = range(0, len(messages) // 2, max(1, len(messages) // 10))
        periods = {grid_of(messages[start:])[0].period_ns for start in starts}
        assert periods == {NS_PER_S // grid_rate_hz(line_hz)}, line_hz


def test_lost_samples_and_pauses_while_it_is_measured_do_not_change_the_rate() -> None:
    rng = np.random.default_rng(4)
    for line_hz, seconds in ((1, 60), (10, 20), (100, 10)):
        line_s = times(line_hz, seconds)
        line_s = line_s[rng.random(len(line_s)) > 0.15]
        line_s[3:] += 1.5  # acquisition had to connect again
        grid, _ = grid_of(samples(line_s))
        assert grid.period_ns == NS_PER_S // line_hz


def test_a_session_of_acquisition_that_ends_before_there_is_a_rate_is_counted() -> None:
    messages = [*samples(times(10, 0.9), producer="a"), *samples(times(10, 20) + 100.0, producer="b")]
    grid, core = grid_of(messages)
    assert grid.period_ns == NS_PER_S // 10
    assert grid.t_ns[0] > EPOCH_NS + 100 * NS_PER_S
    assert (core.counters()["samples_in"], core.counters()["lost_before_rate"]) == (200, 9)


def test_a_line_too_slow_to_be_judged_is_named_and_nothing_of_it_is_bridged() -> None:
    core = ResamplerCore(1, ResamplerConfig())
    grids = [grid for message in samples(times(0.01, 2400)) for grid in core.step(message)]
    assert core.problem() == (
        "samples arrive about every 100 s: too slow to be judged; let the device send one a minute"
    )
    assert join(grids).valid.mean() < 0.7  # only at the samples themselves
    slow, core = grid_of(samples(times(0.2, 120)), rate_hz=0.2)  # asked for: the limits follow from that
    assert slow.valid.all()
    assert core.problem() == ""


def test_a_line_that_does_not_fit_the_configured_grid_is_named() -> None:
    grid, core = grid_of(samples(times(10, 20, 0.2)), rate_hz=100.0)
    assert not grid.valid.all()
    assert core.problem() == (
        "samples arrive about 10 times a second, too few for gap_limit_s = 0.1: "
        "leave out rate_hz and gap_limit_s of [resampler], they follow from the line"
    )
    assert core.notes()[0].startswith("grid of 100 Hz; gaps longer than 0.1 s: ")


def test_a_line_that_becomes_faster_or_slower_is_named() -> None:
    slow, fast = samples(times(10, 20)), samples(times(100, 20) + 20, first=200)
    _, core = grid_of([*slow, *fast])
    assert core.problem() == (
        "samples arrive about 100 times a second, and the grid has 10 Hz since they were fewer: restart the resampler"
    )
    _, core = grid_of(
        [*fast, *[replace(m, header=Header("p", 9000 + k, "tray1")) for k, m in enumerate(samples(times(2, 40) + 40))]]
    )
    assert core.problem().endswith("too few for gap_limit_s = 0.1: restart the resampler")

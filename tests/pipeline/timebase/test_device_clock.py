"""pipeline.timebase.device_clock: the host time of samples from a drifting, wrapping clock and delayed receipts.

Units: ns unless the name ends in us. A simulated device has its own clock; the true time is host time of the sample.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from fantwin.pipeline.timebase.device_clock import UINT32, DeviceClock
from fantwin.schemas.units import NS_PER_S

EPOCH_NS = 1_700_000_000_000_000_000
MS, US = 1_000_000, 1_000
STEP_NS = 10 * MS
SMALLEST_DELAY_NS = 300 * US
AWAY_US = UINT32 + 30_000_000
"""a silence after which the clock looks as if half a minute had passed"""


@dataclass(frozen=True)
class ClockReadings:
    """The clock readings of a device, their host times of receipt, and the true times, which only the test knows."""

    true_t_ns: NDArray[np.int64]
    clock_us: NDArray[np.int64]
    receive_t_ns: NDArray[np.int64]

    def mapped(self, clock: DeviceClock | None = None) -> NDArray[np.int64]:
        clock = clock or DeviceClock()
        pairs = zip(self.clock_us.tolist(), self.receive_t_ns.tolist(), strict=True)
        return np.array([clock.to_host_ns(us, t_ns) for us, t_ns in pairs])

    def error_ns(self, clock: DeviceClock | None = None) -> NDArray[np.int64]:
        """Error against the true time plus the smallest delay, which the host cannot know."""
        return self.mapped(clock) - self.true_t_ns - SMALLEST_DELAY_NS


def sampled(
    duration_s: float,
    *,
    drift: float = 0.0,
    jitter_ms: float = 1.0,
    stall_share: float = 0.0,
    clock_starts_us: int = 0,
    starts_ns: int = EPOCH_NS,
    seed: int = 1,
) -> ClockReadings:
    """100 Hz; delays are exponential, some a 30 ms stall. A positive drift is a clock that runs slow."""
    rng = np.random.default_rng(seed)
    n = round(duration_s * 100)
    true_t_ns = starts_ns + np.arange(n) * STEP_NS
    clock_us = clock_starts_us + np.rint((true_t_ns - starts_ns) * (1 - drift) / US).astype(np.int64)
    delay_ns = SMALLEST_DELAY_NS + rng.exponential(jitter_ms * MS, n) + 30 * MS * (rng.random(n) < stall_share)
    receive_t_ns = np.maximum.accumulate(true_t_ns + delay_ns.astype(np.int64))
    return ClockReadings(true_t_ns, clock_us % UINT32, receive_t_ns)


def joined(*lines: ClockReadings) -> ClockReadings:
    return ClockReadings(
        *(np.concatenate([getattr(line, name) for line in lines]) for name in ClockReadings.__dataclass_fields__)
    )


@pytest.mark.parametrize("drift", [-200e-6, 5e-3])
def test_a_drift_over_ten_minutes_leaves_a_small_error(drift: float) -> None:
    clock = DeviceClock()
    error_ns = sampled(600, drift=drift, jitter_ms=2.0, stall_share=0.02).error_ns(clock)
    assert np.abs(error_ns[-30_000:]).max() < 100 * US
    assert clock.drift == pytest.approx(drift / (1 - drift), abs=3e-6)  # per second of the device
    assert clock.segments == 1


def test_neighbouring_samples_keep_their_distance_within_a_few_ppm() -> None:
    line = sampled(300, jitter_ms=2.0, stall_share=0.02)
    stretch = np.diff(line.mapped()) / STEP_NS - 1
    assert np.abs(stretch[6_000:]).max() < 60e-6  # two minutes of a better line arriving are over
    assert np.abs(stretch).max() < 500e-6


def test_times_approach_a_new_line_and_never_jump_to_it() -> None:
    late = ClockReadings(
        *(np.array([v]) for v in (EPOCH_NS, 0, EPOCH_NS + 400 * MS))
    )  # the first sample hung in a buffer
    line = sampled(120, jitter_ms=0.1, starts_ns=EPOCH_NS + STEP_NS, clock_starts_us=10_000)
    error_ns = joined(late, line).error_ns()
    assert error_ns[1] > 390 * MS
    assert np.abs(np.diff(error_ns)).max() <= 1.01 * STEP_NS * 0.01
    assert np.abs(error_ns[-1_000:]).max() < 20 * MS


@pytest.mark.parametrize(
    ("before", "after", "segments"),
    [
        pytest.param(sampled(30, jitter_ms=0.1, clock_starts_us=UINT32 - 15_000_000), None, 1, id="the clock wraps"),
        *(
            pytest.param(
                sampled(20, jitter_ms=0.1, clock_starts_us=uptime_us),
                sampled(20, jitter_ms=0.1, starts_ns=EPOCH_NS + 25 * NS_PER_S),
                2,
                id=f"the device restarts after {uptime_us // 1_000_000} s",
            )
            for uptime_us in (5_000_000, 3_000_000_000)
        ),
        pytest.param(
            sampled(20, jitter_ms=0.1),
            sampled(20, jitter_ms=0.1, starts_ns=EPOCH_NS + AWAY_US * US, clock_starts_us=AWAY_US),
            2,
            id="a silence in which it may have wrapped",
        ),
    ],
)
def test_times_are_right_when_the_clock_wraps_and_a_new_segment_begins_when_it_may_not_continue(
    before: ClockReadings, after: ClockReadings | None, segments: int
) -> None:
    clock = DeviceClock()
    error_ns = (joined(before, after) if after else before).error_ns(clock)
    assert clock.segments == segments
    assert np.abs(error_ns).max() < 1 * MS


def test_a_correction_does_not_grow_while_no_samples_arrive() -> None:
    late = ClockReadings(*(np.array([v]) for v in (EPOCH_NS, 0, EPOCH_NS + 400 * MS)))
    before = sampled(5, jitter_ms=0.1, starts_ns=EPOCH_NS + STEP_NS, clock_starts_us=10_000)
    after = sampled(5, jitter_ms=0.1, starts_ns=EPOCH_NS + 300 * NS_PER_S, clock_starts_us=300_000_000)
    error_ns = joined(late, before, after).error_ns()
    assert error_ns[501] - error_ns[500] < 0
    assert error_ns[501] > error_ns[500] - 11 * MS  # the drift of one bucket, not of 300 s


@pytest.mark.parametrize("set_by_s", [30, -3600])
def test_a_host_clock_that_is_set_begins_a_new_segment(set_by_s: int) -> None:
    line = sampled(60, jitter_ms=0.1)
    shift_ns = np.where(np.arange(6000) >= 3000, set_by_s * NS_PER_S, 0)
    moved = ClockReadings(line.true_t_ns + shift_ns, line.clock_us, line.receive_t_ns + shift_ns)
    clock = DeviceClock()
    error_ns = moved.error_ns(clock)
    assert clock.segments == 2
    assert np.abs(error_ns[-2_000:]).max() < 1 * MS


def test_old_samples_that_come_again_change_nothing() -> None:
    line = sampled(30, jitter_ms=0.1)
    clock = DeviceClock()
    times = line.mapped(clock)
    old = ClockReadings(line.true_t_ns[-1500:], line.clock_us[-1500:], line.receive_t_ns[-1500:]).mapped(clock)
    assert np.abs(old - times[-1500:]).max() < 100 * US
    assert clock.segments == 1
    assert clock.to_host_ns(int(line.clock_us[-1]) + 10_000, int(line.receive_t_ns[-1]) + STEP_NS) == pytest.approx(
        int(times[-1]) + STEP_NS, abs=10 * US
    )


@settings(max_examples=40, deadline=None)
@given(
    drift=st.floats(-1e-3, 1e-3),
    jitter_ms=st.floats(0.0, 5.0),
    stall_share=st.floats(0.0, 0.2),
    clock_starts_us=st.integers(0, UINT32 - 1),
    seed=st.integers(0, 1000),
)
def test_times_rise_and_never_stray_beyond_the_delays(
    drift: float, jitter_ms: float, stall_share: float, clock_starts_us: int, seed: int
) -> None:
    line = sampled(
        20, drift=drift, jitter_ms=jitter_ms, stall_share=stall_share, clock_starts_us=clock_starts_us, seed=seed
    )
    clock = DeviceClock()
    error_ns = line.error_ns(clock)
    assert clock.segments == 1
    assert (np.diff(line.mapped()) > 0).all()
    first_delay_ns = line.receive_t_ns[0] - line.true_t_ns[0] - SMALLEST_DELAY_NS
    assert np.abs(error_ns).max() <= first_delay_ns + 25 * MS

"""The rate of a tray's line, measured from its first samples."""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from fantwin.schemas.messages import Array, Raw

MIN_SAMPLES = 6
LONGEST_WAIT_US = 5_000_000  # after this MIN_SAMPLES are enough: a slow line must not wait for long
ENOUGH_SAMPLES = 26
SHORTEST_WAIT_US = 1_000_000  # a host that stalls delivers the samples of a tenth of a second at once
MAX_SAMPLES = 2000
MOST_KEPT = 6000
"""samples for a line to catch up: a minute at 100 Hz. If it needs more, its clock runs too fast"""
PACE_US = 250_000
"""time of the device from one look to the next at whether its line is catching up"""
MOST_PERIODS = 5  # a longer pause says nothing about the period
MIN_USED_SHARE = 0.5  # of the steps
MOST_UNEVEN = 0.15  # mean distance of steps from whole periods, in periods; a quarter where there is no period
LEAST_RECEIVED_US = 30_000  # a shorter step between times of receipt may be that of the host
UINT32 = 1 << 32


class SampleTimes:
    """The times of a line's newest samples: of the device's clock, or of receipt if it has none.

    They start again with another session of acquisition, and where a clock goes back.
    """

    def __init__(self, most: int) -> None:
        """most: number of times that are kept."""
        self._source: tuple[str, bool] | None = None  # producer, and whether its device has a clock
        self._most = most
        self._times_us: deque[int] = deque(maxlen=most)

    def add(self, message: Raw) -> None:
        """Add the samples of a message."""
        for us in self.times_of(message)[-self._most :]:
            self.add_time(us)

    def times_of(self, message: Raw) -> list[int]:
        """The times of a message that follows, for `add_time`."""
        has_clock = len(message.device_clock_us) > 0
        if self._source != (message.header.producer, has_clock):
            self._source = message.header.producer, has_clock
            self._times_us.clear()
        return message.device_clock_us.tolist() if has_clock else (message.host_receive_t_ns // 1000).tolist()

    def add_time(self, us: int) -> None:
        """Add the time of one sample."""
        times_us, has_clock = self._times_us, self._has_clock
        if not times_us:
            times_us.append(us)
            return
        step_us = us - times_us[-1]
        if has_clock:
            step_us = (step_us + UINT32 // 2) % UINT32 - UINT32 // 2
        if step_us < 0:
            times_us.clear()
            times_us.append(us)
        elif step_us > 0 or not has_clock:  # samples that are read together have one time of receipt
            times_us.append(times_us[-1] + step_us)

    @property
    def _has_clock(self) -> bool:
        return self._source is not None and self._source[1]

    @property
    def count(self) -> int:
        """Number of times."""
        return len(self._times_us)

    @property
    def span_us(self) -> int:
        """Time from the first to the last."""
        return self._times_us[-1] - self._times_us[0] if self._times_us else 0

    @property
    def line_hz(self) -> float:
        """Samples a second: the median over spans of a quarter of the samples; infinite if no time passed."""
        steps = max(1, self.count // 4)
        times_us = np.array(self._times_us, np.int64)
        spans_us = times_us[steps:] - times_us[:-steps]
        median_us = float(np.median(spans_us)) / steps if len(spans_us) else 0.0
        return 1e6 / median_us if median_us > 0.0 else math.inf

    @property
    def sent_hz(self) -> float:
        """Samples a second that the device sends, however many of them are lost: a loss makes a step of two periods or
        more. `line_hz` where the steps are no such multiples.
        """
        period_us = common_period_us(np.diff(np.array(self._times_us, np.int64)))
        if period_us is None or not (self._has_clock or period_us >= LEAST_RECEIVED_US):
            return self.line_hz
        return max(self.line_hz, 1e6 / period_us)


def common_period_us(steps_us: Array) -> float | None:
    """Find the period of which steps are multiples, most of them small ones; None if there is none, or too few steps.

    It begins with the shorter steps, and is the mean over all that are at most a few periods long.
    """
    if len(steps_us) < MIN_SAMPLES - 1 or not steps_us.all():  # some were read together
        return None
    period_us = float(np.median(steps_us[steps_us <= 1.5 * np.quantile(steps_us, 0.25)]))
    periods, used = np.rint(steps_us / period_us), np.ones(len(steps_us), np.bool_)
    for _ in range(3):
        used = (periods >= 1) & (periods <= MOST_PERIODS)
        if used.mean() < MIN_USED_SHARE:
            return None
        period_us = float(steps_us[used].sum() / periods[used].sum())
        periods = np.rint(steps_us / period_us)
    uneven = np.abs(steps_us / period_us - periods)[used].mean()
    return period_us if uneven <= MOST_UNEVEN else None


class LineRate:
    """Measures the rate of a line from its first samples, and how late the first one was.

    A line that delivers what it had kept before it was opened is measured until it has caught up. The result depends on
    the samples only, and not on how they are divided into messages.
    """

    def __init__(self) -> None:
        self._times = SampleTimes(MOST_KEPT)
        self._seen = 0
        self._first_t_ns = self._last_t_ns = 0
        self._last_span_us: float = 0
        self._is_catching_up = False
        """whether the line delivers samples faster than its device measures them"""
        self._paced = (0, 0)
        """time of the device since the first sample, us, and `first_lateness_ns`, at the last such look"""
        self.first_lateness_ns = 0
        """delay of the first sample beyond that of the least delayed one of the first second, or of the time until the
        line had caught up; 0 if the device has no clock"""

    def add(self, message: Raw) -> bool:
        """Add the samples of a message; returns whether they are enough for `line_hz`."""
        for us, t_ns in zip(self._times.times_of(message), message.host_receive_t_ns.tolist(), strict=True):
            if self.is_enough:
                break
            self._seen += 1
            if not self._times.count:
                self._first_t_ns = self._last_t_ns = t_ns
                self._last_span_us = self.first_lateness_ns = 0
                self._is_catching_up, self._paced = False, (0, 0)
            self._times.add_time(us)
            if len(message.device_clock_us):
                self._compare_delay(t_ns)
        return self.is_enough

    def _compare_delay(self, t_ns: int) -> None:
        """Compare the delay of the newest sample, received at t_ns, with that of the first."""
        span_us = self._times.span_us  # it falls where the clock of the device went back
        is_early = span_us <= SHORTEST_WAIT_US or self._is_catching_up
        if self._last_span_us <= span_us and is_early and t_ns >= self._last_t_ns:
            self._last_span_us, self._last_t_ns = span_us, t_ns
            self.first_lateness_ns = max(self.first_lateness_ns, self._first_t_ns + span_us * 1000 - t_ns)
            passed_us = span_us - self._paced[0]
            if passed_us >= PACE_US:
                gained_ns = self.first_lateness_ns - self._paced[1]
                self._is_catching_up = 2 * gained_ns > 1000 * passed_us  # on the host, less than half of that passed
                self._paced = span_us, self.first_lateness_ns
        else:
            self._last_span_us, self._is_catching_up = math.inf, False  # a later sample says nothing about the first

    @property
    def is_enough(self) -> bool:
        """Return whether there are enough samples. After very many without a usable time, there are."""
        if self._is_catching_up and self._seen < MOST_KEPT:
            return False
        count, span_us = self._times.count, self._times.span_us
        return (
            (count >= ENOUGH_SAMPLES and span_us >= SHORTEST_WAIT_US)
            or (count >= MIN_SAMPLES and span_us >= LONGEST_WAIT_US)
            or self._seen >= MAX_SAMPLES
        )

    @property
    def line_hz(self) -> float:
        """Samples a second that the device sends."""
        return self._times.sent_hz

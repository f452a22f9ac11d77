"""Device clock: from its wrapping 32-bit counter to the host time of a sample.

The host time of receipt is the time of the sample plus a delay that is never negative, often milliseconds, sometimes
far more. The offset `receipt - device clock` is therefore bounded from below by a straight line. Its slope is the drift
of the device clock, its height the smallest delay. It is estimated as the edge of the lower convex hull below the mean
of the points: of all lines below all points, this one is highest on average (Moon, Skelly and Towsley, Estimation and
removal of clock skew from network delay measurements, INFOCOM 1999; by hull: Zhang, Liu and Xia, INFOCOM 2002). The
points are those of a sliding window, one (the least delayed sample) per bucket.

Times never jump to a new line. They approach it slowly, so that the time between neighbouring samples stays that of
the device clock. docs/explanation/time.md has measurements.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from fantwin.schemas.units import NS_PER_S

UINT32 = 1 << 32
LARGEST_GAP = 1 << 24
"""Samples; 46 h at 100 Hz. A larger step of the sequence is a restart of the device."""
NS_PER_US = 1_000

BUCKET_NS = NS_PER_S  # device time of one bucket: it keeps its least delayed sample; the line is fitted at its end
WINDOW_BUCKETS = 60  # long enough to estimate a drift of a few ppm, short enough to follow the temperature
DRIFT_SPAN_NS = 10 * NS_PER_S  # points that span less do not determine the drift
MAX_DRIFT = 0.02  # a ceramic resonator is within 0.5 %, an RC oscillator within 2 %
SLEW_TIME_NS = 20 * NS_PER_S  # time constant with which times approach the line
MAX_SLEW = 0.01  # largest relative correction
JUMP_NS = NS_PER_S  # a larger disagreement means a clock that was set or restarted, not a delay
LATE_BUCKETS = 5  # if every sample is equally late for this many buckets, the host clock was set forward
LATENESS_JITTER_NS = NS_PER_S // 10  # by which samples may be less late than before, beside a drift
LONGEST_SILENCE_NS = 600 * NS_PER_S  # after this the 32-bit clock may have wrapped unnoticed
WRAP_NS = UINT32 * NS_PER_US  # 71.6 minutes
WRAP_TOLERANCE_NS = 5 * NS_PER_S  # of a sample that is on time after the clock has wrapped

Point = tuple[int, int]
"""Device time and offset (receipt - device time), both ns."""


class DeviceClock:
    """Maps the clock of one device to host time, sample by sample, so that message sizes make no difference.

    A *segment* is a period of uninterrupted device time; within it, times are continuous. It ends when the device
    restarts, when either clock is set by more than a second, or after ten minutes without samples.

    A *backlog* is what a line delivers late, after it has stalled: the device clock continues, and the samples are less
    late from one to the next. It belongs to the segment before the stall, however long that was.
    """

    def __init__(self) -> None:
        self.segments = 0
        """Number of segments so far; 1 if nothing was interrupted."""
        self.drift = 0.0
        """Relative slowness of the device clock against host time: 1e-6 is 1 ppm."""
        self._last_us = 0  # of the newest sample, as received
        self._device_ns = 0  # the same, unwrapped, from the start of the segment
        self._receive_t_ns = 0
        self._points: deque[Point] = deque(maxlen=WINDOW_BUCKETS)
        self._lowest: Point = (0, 0)  # of the bucket being filled
        self._late_buckets = 0
        self._first_lateness: Point = (0, 0)  # device time and lateness of the first of them
        self._from_device_ns = 0  # start of the current piece of the mapping
        self._from_t_ns = 0
        self._slew = 0.0

    def to_host_ns(self, device_clock_us: int, receive_t_ns: int, *, follows: bool = False) -> int:
        """Host time (ns since the epoch) at which the sample was measured, plus the smallest delay.

        device_clock_us: modulo 2^32. follows: the device's own numbers say that it has not restarted since the newest
        sample. A sample that is not newer than the newest one gets its time from the current mapping and does not
        change it.
        """
        if self.segments == 0:
            return self._begin(device_clock_us, receive_t_ns)
        step_us = self._step_us(device_clock_us)
        device_ns = self._device_ns + step_us * NS_PER_US
        t_ns = self._map(device_ns)
        if receive_t_ns - self._receive_t_ns > LONGEST_SILENCE_NS:
            late_ns = (receive_t_ns - t_ns + WRAP_TOLERANCE_NS) % WRAP_NS - WRAP_TOLERANCE_NS
            is_backlog = step_us > 0 and (follows or step_us * NS_PER_US <= JUMP_NS) and late_ns > WRAP_TOLERANCE_NS
            if not is_backlog:
                return self._begin(device_clock_us, receive_t_ns)
        if step_us <= 0:
            is_old = -step_us * NS_PER_US < JUMP_NS or receive_t_ns < self._receive_t_ns
            return t_ns if is_old else self._begin(device_clock_us, receive_t_ns)
        if t_ns - receive_t_ns > JUMP_NS:  # measured long after its receipt: another clock
            return self._begin(device_clock_us, receive_t_ns)
        self._last_us, self._device_ns, self._receive_t_ns = device_clock_us, device_ns, receive_t_ns
        if device_ns - self._from_device_ns >= BUCKET_NS:
            self._end_bucket(device_ns, t_ns)
            if self._late_buckets >= LATE_BUCKETS:
                return self._begin(device_clock_us, receive_t_ns)
            self._lowest = (device_ns, receive_t_ns - device_ns)
        elif receive_t_ns - device_ns < self._lowest[1]:
            self._lowest = (device_ns, receive_t_ns - device_ns)
        return t_ns

    def expected_host_ns(self, device_clock_us: int) -> int | None:
        """The host time of a sample if the device has not restarted; None if its clock shows that it has."""
        step_us = self._step_us(device_clock_us)
        if self.segments == 0 or not 0 < step_us * NS_PER_US <= LONGEST_SILENCE_NS:
            return None
        return self._map(self._device_ns + step_us * NS_PER_US)

    def _step_us(self, device_clock_us: int) -> int:
        return (device_clock_us - self._last_us + UINT32 // 2) % UINT32 - UINT32 // 2

    def _begin(self, device_clock_us: int, receive_t_ns: int) -> int:
        self.segments += 1
        self._last_us, self._device_ns, self._receive_t_ns = device_clock_us, 0, receive_t_ns
        self._points.clear()
        self._lowest = (0, receive_t_ns)
        self._late_buckets = 0
        self._from_device_ns, self._from_t_ns, self._slew = 0, receive_t_ns, 0.0
        return receive_t_ns

    def _map(self, device_ns: int) -> int:
        elapsed_ns = device_ns - self._from_device_ns
        # The slew is meant for one bucket; it must not grow while no samples arrive.
        correction_ns = self.drift * elapsed_ns + self._slew * min(elapsed_ns, BUCKET_NS)
        return self._from_t_ns + elapsed_ns + round(correction_ns)

    def _end_bucket(self, device_ns: int, t_ns: int) -> None:
        """Start a new segment of the mapping at this sample, without a jump, with the slope of the new line."""
        lowest_device_ns, lowest_offset_ns = self._lowest
        lateness_ns = lowest_offset_ns + lowest_device_ns - self._map(lowest_device_ns)
        late, follows_late = lateness_ns > JUMP_NS, self._late_buckets > 0
        if late and (self._late_buckets == 0 or self._is_shrinking(lowest_device_ns, lateness_ns)):
            self._late_buckets, self._first_lateness = 1, (lowest_device_ns, lateness_ns)
        else:
            self._late_buckets = self._late_buckets + 1 if late else 0
        self._slew = 0.0
        if not (late or follows_late):  # the end of a backlog is late, too
            self._points.append(self._lowest)
            while self._points[0][0] < device_ns - WINDOW_BUCKETS * BUCKET_NS and len(self._points) > 1:
                self._points.popleft()
            self.drift, line_offset_ns = line_below(self._points, device_ns, self.drift)
            error_ns = line_offset_ns - (t_ns - device_ns)
            self._slew = _clamp(error_ns / SLEW_TIME_NS, MAX_SLEW)
        self._from_device_ns, self._from_t_ns = device_ns, t_ns

    def _is_shrinking(self, device_ns: int, lateness_ns: int) -> bool:
        """Return whether late samples become less late, as those of a backlog do and those after a set clock do not."""
        since_ns, first_ns = device_ns - self._first_lateness[0], self._first_lateness[1]
        return lateness_ns < first_ns - LATENESS_JITTER_NS - MAX_DRIFT * since_ns


def line_below(points: Sequence[Point], at_ns: int, drift: float) -> tuple[float, float]:
    """The line below all points that is highest at their mean: slope, and height (ns) at device time `at_ns`.

    points: at least one, by rising device time. If they span too little time, the slope is `drift`.
    """
    first_ns, base_ns = points[0]
    x = [float(device_ns - first_ns) for device_ns, _ in points]
    y = [float(offset_ns - base_ns) for _, offset_ns in points]
    if x[-1] < DRIFT_SPAN_NS:
        height = min(yi - drift * xi for xi, yi in zip(x, y, strict=True))
        return drift, base_ns + height + drift * (at_ns - first_ns)
    hull = _lower_hull(x, y)
    mean = sum(x) / len(x)
    right = next(k for k in range(1, len(hull)) if hull[k][0] >= mean)
    (xa, ya), (xb, yb) = hull[right - 1 : right + 1]
    slope = _clamp((yb - ya) / (xb - xa), MAX_DRIFT)
    return slope, base_ns + ya + slope * (at_ns - first_ns - xa)


def _lower_hull(x: list[float], y: list[float]) -> list[tuple[float, float]]:
    """The corners of the line below all points that turns up at each of them; x rising (Andrew's monotone chain)."""
    hull: list[tuple[float, float]] = []
    for xc, yc in zip(x, y, strict=True):
        while len(hull) > 1:
            (xa, ya), (xb, yb) = hull[-2], hull[-1]
            if (yb - ya) * (xc - xb) < (yc - yb) * (xb - xa):
                break
            hull.pop()
        hull.append((xc, yc))
    return hull


def _clamp(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)

"""Guard of the line: samples of another time must not change the line's time.

A line has one producer at a time, and its times of receipt advance. Samples of another producer whose times are
more than a second away are *apart*. They come from a second acquisition whose clock is wrong, or from the next session
of acquisition, after a pause or after the host clock was set. Samples of the line's own producer that go back are apart
too. Samples that are apart are held until one side has gone on for some time while the other was silent. Then the line
continues with them, or they are refused and counted. A line that stalls and goes on is never apart from itself.

Grid times cannot go back. If the line continues with earlier times, because the host clock was set back, a shift is
added to them: times then continue as the device clock says, ahead of the host clock.

Decisions follow from the samples alone, one by one: a replay makes the same, however they are divided into messages.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from fantwin.pipeline.timebase.device_clock import DeviceClock
from fantwin.schemas.blocks import cut
from fantwin.schemas.messages import Raw
from fantwin.schemas.units import NS_PER_S

APART_NS = NS_PER_S
ESTABLISHED_NS = 3 * NS_PER_S // 2  # by which one side must have gone on: longer than a message of acquisition spans
ESTABLISHED_STEPS = 3  # and by this many steps of the line, if these are longer
LONGEST_STEP_NS = 5 * NS_PER_S
MAX_HELD = 10_000  # samples; of more, the oldest are lost
SHOWN_NS = 60 * NS_PER_S  # how long health shows what happened


class LineGuard:
    """Admits the raw samples of one tray's line, in order."""

    def __init__(self, clock: DeviceClock, period_ns: int) -> None:
        """clock: of the line's device. period_ns: of the grid; samples without a device clock continue after it."""
        self._clock = clock
        self._period_ns = period_ns
        self.producer: str | None = None
        """producer of the line; None before the first sample"""
        self._newest_t_ns = 0  # time of receipt of the line's newest sample, as sent
        self._steps_ns: tuple[int, ...] = (0, 0)  # between the line's last three samples
        self._shift_ns = 0
        self._held: deque[Raw] = deque()  # one sample each, of one producer
        self._line_moved_ns = self._held_moved_ns = 0  # since samples are held, and since the line's last one
        self._apart_ns = 0  # how far they are from the line
        self._advance_ns: int | None = None
        self._report, self._report_until_t_ns = "", 0
        self.counts: Counter[str] = Counter()
        """`refused_other_time`: samples that were refused; `lost_other_time`: too many were held;
        `host_clock_set_back`: how often it was"""

    def admit(self, message: Raw, *, is_of_ended: bool = False) -> Iterator[Raw]:
        """The samples to process now; none while it is undecided whether they belong to the line.

        Each is to be processed before the next is asked for: the clock of the device takes part in the decisions.

        is_of_ended: from a producer that another one has followed. What it still sends near the line does not make it
        the line's producer again.
        """
        t_ns = message.host_receive_t_ns
        if not len(t_ns):
            yield message
            return
        if self.producer is None:
            self._newest_t_ns = int(t_ns[0])
        if len(t_ns) == 1:
            yield from self._admit_sample(message, is_of_ended)
            return
        own = self.producer in (None, message.header.producer)
        steps_ns = np.diff(t_ns, prepend=self._newest_t_ns)
        apart = steps_ns < -APART_NS if own and not self._shift_ns else np.abs(steps_ns) > APART_NS
        if self._held or apart.any():
            for row in range(len(t_ns)):
                yield from self._admit_sample(cut(message, row, row + 1), is_of_ended)
            return
        if not is_of_ended:
            self._steps_ns = (*self._steps_ns, *np.clip(steps_ns[-2:], 0, LONGEST_STEP_NS).tolist())[-2:]
            self.producer, self._newest_t_ns = message.header.producer, int(t_ns[-1])
        yield self._shifted(message)

    def close(self) -> list[Raw]:
        """Release the samples that are still held and may be of the line: those whose time goes forward."""
        held = self._taken()
        if held and _time_of(held[0]) > self._newest_t_ns:
            return held
        self._refuse(held)
        return []

    @property
    def advance_ns(self) -> int | None:
        """Time that the samples held since the line's last one cover, limited to what decides whether samples are the
        next ones of the line; None: none were held."""
        return None if self._advance_ns is None else min(self._advance_ns, self._established_ns)

    def problem(self) -> str:
        """Event of the last minute of the line, in one line."""
        return self._report if self._newest_t_ns < self._report_until_t_ns else ""

    def _admit_sample(self, sample: Raw, is_of_ended: bool) -> list[Raw]:
        step_ns = _time_of(sample) - self._newest_t_ns
        own = self.producer in (None, sample.header.producer)
        # An earlier sample of the same message may have made its producer the line's again.
        if abs(step_ns) <= APART_NS and is_of_ended and not own:
            return [self._shifted(sample)]
        if (own and step_ns >= -APART_NS) or abs(step_ns) <= APART_NS:
            return [self._of_line(sample)]
        return self._hold(sample)

    def _of_line(self, sample: Raw) -> Raw:
        t_ns, self._advance_ns = _time_of(sample), None
        moved_ns = min(max(t_ns - self._newest_t_ns, 0), LONGEST_STEP_NS)
        self._steps_ns = (self._steps_ns[-1], moved_ns)
        if self._held:
            self._held_moved_ns = 0
            self._line_moved_ns += moved_ns
            if self._line_moved_ns >= self._established_ns:
                self._refuse(self._taken())
        if self._shift_ns and t_ns - self._newest_t_ns > APART_NS and self._is_put_right(sample):
            self._shift_ns = 0
        self.producer, self._newest_t_ns = sample.header.producer, t_ns
        return self._shifted(sample)

    def _hold(self, sample: Raw) -> list[Raw]:
        if self._held:
            moved_ns = _time_of(sample) - _time_of(self._held[-1])
            if self._held[-1].header.producer == sample.header.producer and abs(moved_ns) <= LONGEST_STEP_NS:
                self._held_moved_ns += max(moved_ns, 0)
                self._advance_ns = (self._advance_ns or 0) + max(moved_ns, 0)
            else:
                self._refuse(self._taken())
        if not self._held:
            self._line_moved_ns = self._held_moved_ns = 0
            self._apart_ns = _time_of(sample) - self._newest_t_ns
            self._advance_ns = self._advance_ns or 0
        self._held.append(sample)
        if len(self._held) > MAX_HELD:
            self._held.popleft()
            self.counts["lost_other_time"] += 1
        return self._continue_with(self._taken()) if self._held_moved_ns >= self._established_ns else []

    def _taken(self) -> list[Raw]:
        held = list(self._held)
        self._held.clear()
        return held

    @property
    def _established_ns(self) -> int:
        return max(ESTABLISHED_NS, ESTABLISHED_STEPS * min(self._steps_ns))

    def _continue_with(self, held: Sequence[Raw]) -> list[Raw]:
        """The line goes on with these samples."""
        first, self._advance_ns = held[0], None
        back_ns = self._newest_t_ns - _time_of(first)
        self.producer, self._newest_t_ns = first.header.producer, _time_of(held[-1])
        if back_ns > 0:
            before_ns, by_device = self._shift_ns, self._by_device(first)
            continued_ns = self._shift_ns + back_ns + self._period_ns
            self._shift_ns = continued_ns if by_device is None else by_device - _time_of(first)
            self.counts["host_clock_set_back"] += 1
            self._show(
                f"the host clock was set back by {(self._shift_ns - before_ns) / NS_PER_S:.0f} s: sample times "
                f"continue without a step, {self._shift_ns / NS_PER_S:.0f} s ahead of it, until the site is restarted"
            )
        return [self._shifted(sample) for sample in held]

    def _is_put_right(self, sample: Raw) -> bool:
        """Return whether the host clock was set forward again: with the shift, the times would be ahead by all of
        it."""
        expected_t_ns = self._by_device(sample)
        if expected_t_ns is None:
            expected_t_ns = self._newest_t_ns + self._shift_ns + self._period_ns
        return abs(_time_of(sample) - expected_t_ns) <= APART_NS

    def _by_device(self, sample: Raw) -> int | None:
        """The time of a sample as its device clock says, ns; None where that says nothing."""
        clock_us = sample.device_clock_us
        return self._clock.expected_host_ns(int(clock_us[0])) if len(clock_us) else None

    def _refuse(self, held: Sequence[Raw]) -> None:
        if not held:
            return
        self.counts["refused_other_time"] += len(held)
        side = "ahead of" if self._apart_ns > 0 else "behind"
        self._show(
            f"raw samples of {held[0].header.producer} are {abs(self._apart_ns) / NS_PER_S:.0f} s {side} those of "
            f"{self.producer}: refused; stop the one that is wrong, or correct its host's clock"
        )

    def _show(self, report: str) -> None:
        self._report, self._report_until_t_ns = report, self._newest_t_ns + SHOWN_NS

    def _shifted(self, message: Raw) -> Raw:
        if not self._shift_ns:
            return message
        return replace(message, host_receive_t_ns=message.host_receive_t_ns + self._shift_ns)


def _time_of(sample: Raw) -> int:
    return int(sample.host_receive_t_ns[0])

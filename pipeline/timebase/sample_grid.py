"""The uniform grid of one tray: irregular raw samples in, samples at equal intervals of time out.

Content depends on sample times only. Host time, in `tick`, decides only when grid samples of a gap are published. See
docs/explanation/time.md.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from fantwin.pipeline.timebase.device_clock import LARGEST_GAP, UINT32, DeviceClock
from fantwin.pipeline.timebase.grid_timing import GridTiming
from fantwin.pipeline.timebase.interpolation import (
    NEVER_NS,
    SETTLED_NS,
    SLOW_NS,
    LastReadings,
    Samples,
    all_true,
    held_commands,
    interpolate_auxiliary,
    interpolate_samples,
)
from fantwin.pipeline.timebase.line_guard import LineGuard
from fantwin.pipeline.timebase.stage_clock import is_of_replay
from fantwin.schemas.blocks import cut, join, present_columns
from fantwin.schemas.channels import CHANNELS, measured_columns
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.messages import Array, Grid, Raw
from fantwin.schemas.tacho import Tacho
from fantwin.schemas.topics import most_samples
from fantwin.schemas.units import NS_PER_S

LONGEST_TICK_NS = NS_PER_S // 10  # a longer pause between ticks is a host that stalled, not a silent source
SET_BACK_NS = NS_PER_S  # a new sample this much older than the newest: a replay was restarted
MAX_ENDED_PRODUCERS = 64
GAP, STALE, NO_SPEED, CLOCK_RESTARTED = (
    np.uint8(reason)
    for reason in (InvalidReason.GAP, InvalidReason.STALE, InvalidReason.NO_SPEED, InvalidReason.CLOCK_RESTARTED)
)


def first_grid_time(t_ns: int, period_ns: int) -> int:
    """The first multiple of `period_ns` at or after `t_ns`."""
    return -(-t_ns // period_ns) * period_ns


class SampleGrid:
    """The grid of one tray. Samples that are dropped and gaps are counted."""

    def __init__(
        self,
        tachos: Sequence[Tacho],
        timing: GridTiming,
        link_wait_ns: int = 0,
    ) -> None:
        """tachos: one for each fan; readings that a tacho shows until the next one are held. link_wait_ns: how long a
        gap is not published because its samples may still come."""
        self._fans = fans = len(tachos)
        is_slow, settles = timing.period_ns >= SLOW_NS, timing.period_ns >= SETTLED_NS
        shows = np.array([tacho.held_s > 0.0 for tacho in tachos])
        self._is_held = settles | (shows & (not is_slow))
        self._repeats = settles | shows
        """fans whose newest reading is repeated where no sample has come since the grid time before"""
        self._holds = bool(self._repeats.any())
        self._period_ns = timing.period_ns
        self._gap_limit_ns = timing.gap_limit_ns
        self._watermark_ns = timing.watermark_ns
        self._stale_for_ns = timing.stale_for_ns
        self._restarts_t_ns: deque[int] = deque()  # of first samples after restarts whose grid samples are not made yet
        self._clock = DeviceClock()
        self._guard = LineGuard(self._clock, self._period_ns)
        self._last_readings = LastReadings(fans, self._gap_limit_ns, self._is_held)
        # The last raw sample at or before the next grid time, and all later ones.
        nothing = np.zeros((0, fans))
        self._held = Samples(np.zeros(0, np.int64), nothing, nothing, np.zeros((0, 0, fans)))
        self._auxiliary: dict[str, int] = {}
        """the columns beside command and speed that the source has given, and their places in the samples"""
        self._newest_t_ns = NEVER_NS
        self._next_t_ns = NEVER_NS
        self._not_before_t_ns = NEVER_NS  # earlier samples are not accepted: the clock has restarted
        self._pending: list[Grid] = []  # not yet published
        self._in_gap = False
        self._link_wait_ns = link_wait_ns
        self._silence_ns = 0
        self._shown_silence_ns = 0
        """silence of the source, as far as its producer has shown that it has sent nothing"""
        self._tick_t_ns: int | None = None
        self._set_back_ns = 0  # by how much the host clock was set back, until it has caught up
        self._producer = ""
        self._sequence = -1  # of the newest message of this producer
        self._ended_producers: dict[str, None] = {}  # the latest that another one has followed
        self._device_sequence: int | None = None  # of the newest raw sample
        self._counts: Counter[str] = Counter()

    def step(self, item: Raw) -> list[Grid]:
        """Add raw samples; return the grid that they determine."""
        self._counts["samples_in"] += len(item.host_receive_t_ns)
        if is_of_replay(item.header.producer) or self._is_repeated(item):
            self._add(item, self._is_new(item))
            return self._published()
        before_ns = self._guard.advance_ns
        for message in self._guard.admit(item, is_of_ended=item.header.producer in self._ended_producers):
            self._add(message, is_new=message.header.producer == self._guard.producer)
        self._end_silence(before_ns, self._guard.advance_ns)
        return self._published()

    def tick(self, now_ns: int, *, is_complete: bool = True) -> list[Grid]:
        """Add up how long no samples have arrived; past the watermark, publish the grid without them.

        is_complete: all that was sent until now has arrived. Otherwise the link may be cut, and the samples be kept.
        """
        if self._tick_t_ns is not None:
            self._silence_ns += min(max(now_ns - self._tick_t_ns, 0), LONGEST_TICK_NS)
        self._tick_t_ns = now_ns
        if is_complete or self._silence_ns > self._link_wait_ns:
            self._shown_silence_ns = self._silence_ns
        if self._shown_silence_ns < self._watermark_ns:
            return []
        return self.publish_until(self._newest_t_ns + self._shown_silence_ns - self._watermark_ns)

    def publish_until(self, t_ns: int) -> list[Grid]:
        """Publish the grid up to `t_ns` without waiting for more samples."""
        self._fill(t_ns, final=True)
        return self._published()

    def close(self) -> list[Grid]:
        """Publish the grid up to the newest raw sample."""
        for message in self._guard.close():
            self._add(message, is_new=True)
        self._silence_ns = 0  # a line that ended before its resampler is no problem of the last health
        return self.publish_until(self._newest_t_ns)

    def counters(self) -> Mapping[str, int]:
        """docs/explanation/time.md explains each counter."""
        return {**self._counts, **self._guard.counts, "clock_restarts": max(0, self._clock.segments - 1)}

    def problem(self) -> str:
        """Problem of the line: no samples, or a host clock that was set back."""
        if self._silence_ns >= self._watermark_ns:
            return (
                f"no raw samples for more than {self._watermark_ns / NS_PER_S:g} s: see acquisition in `fantwin status`"
            )
        if self._set_back_ns:
            return (
                f"the host clock was set back by {self._set_back_ns / NS_PER_S:.0f} s, or a replay was restarted: "
                "samples are refused until it has caught up; restart the stages"
            )
        return self._guard.problem()

    def _add(self, item: Raw, is_new: bool) -> None:
        """Add the samples of a message of the line; is_new: neither repeated nor one of an ended session."""
        self._silence_ns = self._shown_silence_ns = 0
        times, restarts = self._times(item, is_new)
        accepted = [k for k, t_ns in enumerate(times) if self._is_accepted(t_ns, is_new, after_restart=k in restarts)]
        if accepted:
            samples = Samples(np.array(times, np.int64), item.command, item.speed_rad_s, self._auxiliary_of(item))
            self._held = self._held.extended(samples if len(accepted) == len(times) else samples.rows(accepted))
            self._fill(self._newest_t_ns, final=False)

    def _end_silence(self, before_ns: int | None, advance_ns: int | None) -> None:
        """Samples that are held may be the next ones of the line. The silence before the first of them has ended, and
        the time that they cover is none. Those whose time does not advance must not hide that the line is silent."""
        if advance_ns is None:
            return
        ended_ns = self._silence_ns if before_ns is None else max(0, advance_ns - before_ns)
        self._silence_ns = max(0, self._silence_ns - ended_ns)
        self._shown_silence_ns = min(self._shown_silence_ns, self._silence_ns)

    def _auxiliary_of(self, item: Raw) -> Array:
        """The columns of a message beside command and speed, as Samples has them."""
        given = measured_columns(item)
        self._auxiliary |= {column.name: place for place, column in enumerate(CHANNELS) if column.name in given}
        values = np.full((len(item.command), len(CHANNELS) if self._auxiliary else 0, self._fans), np.nan)
        for name, column in given.items():
            values[:, self._auxiliary[name]] = column
        return values

    def _is_repeated(self, item: Raw) -> bool:
        """Return whether the bus has delivered a message of the present producer again."""
        return item.header.producer == self._producer and item.header.sequence <= self._sequence

    def _is_new(self, item: Raw) -> bool:
        """Return whether a message is newer than all before: neither repeated nor one of an ended session."""
        return item.header.producer not in self._ended_producers and not self._is_repeated(item)

    def _times(self, item: Raw, is_new: bool) -> tuple[list[int], set[int]]:
        """Host time of each sample, ns, and the rows at which the clock of the device has restarted."""
        times, clock_us, restarts = item.host_receive_t_ns.tolist(), item.device_clock_us.tolist(), set[int]()
        for row, us in enumerate(clock_us):
            segments = self._clock.segments
            times[row] = self._clock.to_host_ns(us, times[row], follows=row > 0 or self._follows(item))
            if self._clock.segments != segments:
                restarts.add(row)
            if row == 0 and is_new:
                self._follow_device(item, same_device_run=not restarts)
        if times and not clock_us and is_new:
            self._follow_device(item, same_device_run=True)
        return times, restarts

    def _follows(self, item: Raw) -> bool:
        """Return whether the device has not restarted since the newest sample, by its own numbers."""
        sequence = item.device_sequence
        if not len(sequence) or self._device_sequence is None:
            return False
        return 0 < (int(sequence[0]) - self._device_sequence) % UINT32 < LARGEST_GAP

    def _follow_device(self, item: Raw, same_device_run: bool) -> None:
        """Count what the device sent while acquisition was down, from the first sample of its next session."""
        sequence = item.device_sequence
        if item.header.producer != self._producer and len(sequence) and self._device_sequence is not None:
            missing = (int(sequence[0]) - self._device_sequence) % UINT32 - 1
            if same_device_run and 0 < missing < LARGEST_GAP:
                self._counts["lost_between_sessions"] += missing
        if item.header.producer != self._producer:
            self._ended_producers[self._producer] = None
            self._ended_producers.pop(item.header.producer, None)
            if len(self._ended_producers) > MAX_ENDED_PRODUCERS:
                del self._ended_producers[next(iter(self._ended_producers))]
        self._producer, self._sequence = item.header.producer, item.header.sequence
        self._device_sequence = int(sequence[-1]) if len(sequence) else None

    def _is_accepted(self, t_ns: int, is_new: bool, *, after_restart: bool) -> bool:
        """Return whether a sample is newer than all before; counts the reason if not."""
        behind_ns = self._newest_t_ns - t_ns
        if after_restart and self._newest_t_ns != NEVER_NS:
            # Two segments of the device clock are not compared: a gap lies between, and nothing is interpolated.
            self._not_before_t_ns = self._newest_t_ns + self._gap_limit_ns + 1
            self._restarts_t_ns.append(max(t_ns, self._not_before_t_ns))
        if behind_ns < 0 and t_ns < self._not_before_t_ns:
            self._counts["dropped_after_clock_restart"] += 1
            return False
        if is_new and behind_ns > SET_BACK_NS:
            self._counts["lost_clock_set_back"] += 1
            self._set_back_ns = self._set_back_ns or behind_ns
            return False
        if behind_ns >= 0:
            reason = "lost_out_of_order" if is_new else "out_of_order"
            self._counts[reason if behind_ns else "repeated"] += 1
            return False
        self._set_back_ns = 0
        if self._newest_t_ns == NEVER_NS:
            self._next_t_ns = first_grid_time(t_ns, self._period_ns)
        elif t_ns <= self._next_t_ns - self._period_ns:  # its grid samples were published without it
            self._counts["lost_too_late"] += 1
        self._newest_t_ns = t_ns
        return True

    def _fill(self, until_t_ns: int, final: bool) -> None:
        """Add grid samples up to a time. `final`: without waiting for more readings."""
        while True:
            self._release_samples()
            times = self._held.t_ns
            if not len(times) or self._next_t_ns > until_t_ns:
                return
            last_t_ns = times.item(0)
            next_raw_t_ns = times.item(1) if len(times) > 1 else None
            in_gap = next_raw_t_ns is None or next_raw_t_ns - last_t_ns > self._gap_limit_ns
            if self._next_t_ns == last_t_ns or not in_gap:
                if not self._fill_between(until_t_ns, final):
                    return
            elif self._next_t_ns - last_t_ns <= self._stale_for_ns:
                end_t_ns = until_t_ns if next_raw_t_ns is None else min(until_t_ns, next_raw_t_ns - 1)
                self._fill_gap(min(end_t_ns, last_t_ns + self._stale_for_ns))
            elif next_raw_t_ns is None:
                return
            else:
                skipped_t_ns, self._next_t_ns = self._next_t_ns, first_grid_time(next_raw_t_ns, self._period_ns)
                skipped = (self._next_t_ns - skipped_t_ns) // self._period_ns
                self._count_gap(skipped)
                self._counts["grid_samples_skipped"] += skipped

    def _release_samples(self) -> None:
        """Keep only the last of the samples at or before the next grid time."""
        last = self._held.t_ns.searchsorted(self._next_t_ns, "right").item() - 1
        if last > 0:
            self._last_readings.update(self._held, last)
            self._held = self._held.rows(slice(last, None))

    def _fill_between(self, until_t_ns: int, final: bool) -> bool:
        """Add grid samples up to the next gap. Returns False if the rest has to wait for a reading."""
        samples = self._held
        if samples.t_ns.item(-1) - samples.t_ns.item(0) > self._gap_limit_ns:
            gaps = np.flatnonzero(np.diff(samples.t_ns) > self._gap_limit_ns)
            samples = samples.rows(slice(gaps[0] + 1)) if len(gaps) else samples
        t_ns = self._grid_times(min(until_t_ns, samples.t_ns.item(-1)))
        at = samples.t_ns.searchsorted(t_ns, "right") - 1
        waits = False
        has = np.isfinite(samples.speed_rad_s)
        if all_true(has):
            speed = interpolate_samples(t_ns, at, samples, self._is_held)
        elif all_true(has == has[0]) and all_true(has[0] | self._last_readings.too_old(t_ns[0])):
            speed = np.where(has[0], interpolate_samples(t_ns, at, samples, self._is_held), np.nan)
        else:
            speed, may_arrive = self._last_readings.interpolate(t_ns, at, samples, self._newest_t_ns)
            waiting = may_arrive.any(axis=1)
            if not final and waiting.any():
                waits, known = True, slice(np.argmax(waiting))
                t_ns, at, speed = t_ns[known], at[known], speed[known]
        if len(t_ns):
            self._in_gap = False
            auxiliary = interpolate_auxiliary(t_ns, at, samples) if self._auxiliary else samples.auxiliary
            is_late = t_ns - samples.t_ns.take(at) >= self._period_ns
            if self._holds:
                here = samples.speed_rad_s.take(at, axis=0)
                speed = np.where(is_late[:, np.newaxis] & self._repeats & np.isfinite(here), here, speed)
            command = held_commands(t_ns, at, samples, self._period_ns)
            self._append(t_ns, command, speed, NO_SPEED, ~has.take(at, axis=0), is_late, auxiliary)
        return not waits

    def _fill_gap(self, until_t_ns: int) -> None:
        """Add grid samples without speeds, with the last command."""
        t_ns = self._grid_times(until_t_ns)
        shape = (len(t_ns), self._fans)
        reason = np.where(t_ns - self._held.t_ns[0] <= self._watermark_ns, GAP, STALE)
        self._count_gap(len(t_ns))
        command, nothing = np.broadcast_to(self._held.command[0], shape), np.zeros(shape, np.bool_)
        auxiliary = np.full((len(t_ns), len(CHANNELS), self._fans), np.nan)
        self._append(t_ns, command, np.full(shape, np.nan), reason[:, np.newaxis], nothing, nothing[:, 0], auxiliary)

    def _count_gap(self, samples: int) -> None:
        self._counts["gaps"] += not self._in_gap
        self._counts["grid_samples_in_gaps"] += samples
        self._in_gap = True

    def _grid_times(self, until_t_ns: int) -> Array:
        return np.arange(self._next_t_ns, until_t_ns + 1, self._period_ns)

    def _append(
        self,
        t_ns: Array,
        command: Array,
        speed: Array,
        reason: Array | np.uint8,
        reading_missing: Array,
        is_late: Array,
        auxiliary: Array,
    ) -> None:
        """Append grid samples, at least one. reason: invalid_reason of those without a speed; is_late: (n,) whether no
        raw sample has come since the grid time before."""
        valid = np.isfinite(speed)
        invalid_reason = np.zeros(speed.shape, np.uint8)
        if not all_true(valid):
            np.copyto(invalid_reason, reason, where=~valid)
        while self._restarts_t_ns and t_ns[-1] >= self._restarts_t_ns[0]:
            first = t_ns.searchsorted(self._restarts_t_ns.popleft())
            valid[first], invalid_reason[first] = False, CLOCK_RESTARTED
        columns: dict[str, Any] = {
            name: auxiliary[:, place].astype(np.float32) for name, place in self._auxiliary.items()
        }
        grid = Grid(
            fans=self._fans,
            period_ns=self._period_ns,
            t_ns=t_ns,
            command=command,
            speed_rad_s=speed,
            valid=valid,
            invalid_reason=invalid_reason,
            reading_missing=reading_missing,
            reading_repeated=is_late[:, np.newaxis] & self._repeats if self._holds else np.zeros(0),
            **columns,
        )
        self._pending.append(grid)
        self._counts["grid_samples"] += len(t_ns)
        self._next_t_ns = t_ns.item(-1) + self._period_ns

    def _published(self) -> list[Grid]:
        if not self._pending:
            return []
        # Those before a source has given a column for the first time do not have it.
        grids = [join([*group]) for _, group in groupby(self._pending, key=present_columns)]
        self._pending = []
        most = most_samples(self._fans)  # those of a long gap are published at once
        return [piece for grid in grids for piece in _cut(grid, most)]


def _cut(grid: Grid, most: int) -> list[Grid]:
    rows = len(grid.t_ns)
    if rows <= most:
        return [grid]
    return [cut(grid, first, min(first + most, rows)) for first in range(0, rows, most)]

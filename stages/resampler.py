"""Resampler: irregular samples in, the same samples on a uniform grid of time out.

Reads: topic `raw` (device clock us, host's time of receipt ns, command, speed rad/s).
Writes: topic `grid`: `rate_hz` samples a second at absolute multiples of the step (t_ns % period_ns == 0), speed
interpolated linearly, command held (that of the last sample at or before the grid's time).
Timing: a grid sample leaves as soon as a raw sample at or after its time has come. Where one fan has no reading, all
wait for its next one, `gap_limit_s` at most. Where nothing comes at all, `watermark_s` at most.

Gaps longer than `gap_limit_s` are never bridged: their grid samples are not valid, GAP up to `watermark_s` after the
last raw sample and STALE from there on, and `stale_for_s` after it the grid ends until the line returns. All of that
depends on the samples' times only; the host's time, in `tick`, merely decides that it is said while it lasts. So a
replay gives the same grid. See docs/explanation/time.md.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple, Self

import numpy as np
from pydantic import Field, model_validator

from pipeline.devices.device_clock import UINT32, DeviceClock
from pipeline.devices.device_sequence import LARGEST_GAP
from pipeline.runtime.stage import Context, Core, Parts, Stage, StageConfig
from schemas.blocks import cut, join
from schemas.messages import Array, Grid, InvalidReason, Raw
from schemas.units import NS_PER_S

LONGEST_TICK_NS = 100_000_000  # a longer pause between ticks is the host's own, and says nothing of the line
LONG_AGO_NS = -(1 << 62)
SET_BACK_NS = NS_PER_S  # a new sample so much older than the newest: the host's clock was set back
GAP, STALE, NO_SPEED = (np.uint8(why) for why in (InvalidReason.GAP, InvalidReason.STALE, InvalidReason.NO_SPEED))


class ResamplerConfig(StageConfig):
    """Section `[resampler]`."""

    rate_hz: float = Field(default=100.0, gt=0, le=100_000, description="samples a second on the grid")
    block_size: int = Field(default=1, ge=1, le=4096, description="samples a message; 1 has the lowest latency")
    gap_limit_s: float = Field(default=0.1, gt=0, description="neighbours further apart are never bridged")
    watermark_s: float = Field(default=0.5, gt=0, description="how long a silent line is waited for")
    stale_for_s: float = Field(default=5.0, gt=0, description="how long a silent line is shown before the grid ends")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if not self.gap_limit_s <= self.watermark_s <= self.stale_for_s:
            raise ValueError("gap_limit_s, watermark_s and stale_for_s must rise in this order")
        return self


class Samples(NamedTuple):
    """Raw samples at their own, rising times. t_ns: (n,). command, speed_rad_s: (n, fans)."""

    t_ns: Array
    command: Array
    speed_rad_s: Array

    def followed_by(self, t_ns: Array, command: Array, speed_rad_s: Array) -> Samples:
        """These, and later ones."""
        return Samples(
            np.concatenate((self.t_ns, t_ns)),
            np.concatenate((self.command, command)),
            np.concatenate((self.speed_rad_s, speed_rad_s)),
        )

    def rows(self, wanted: slice) -> Samples:
        """Some of them."""
        return Samples(self.t_ns[wanted], self.command[wanted], self.speed_rad_s[wanted])


def first_grid_time(t_ns: int, period_ns: int) -> int:
    """The first multiple of the step at or after `t_ns`."""
    return -(-t_ns // period_ns) * period_ns


def _all(mask: Array) -> bool:
    return np.count_nonzero(mask) == mask.size  # a few times quicker than mask.all() where the mask is small


def between_samples(t_ns: Array, at: Array, samples: Samples) -> Array:
    """Speeds (n, fans) at t_ns (n,), where every fan has a reading in every sample.

    at: (n,), the last sample at or before each time.
    """
    after = at + 1
    here_t_ns, here = samples.t_ns.take(at), samples.speed_rad_s.take(at, axis=0)
    since_ns = t_ns - here_t_ns
    span_ns = samples.t_ns.take(after, mode="clip") - here_t_ns
    share = since_ns / np.maximum(span_ns, 1)
    between = here + share[:, np.newaxis] * (samples.speed_rad_s.take(after, axis=0, mode="clip") - here)
    return np.where((since_ns == 0)[:, np.newaxis], here, between)


class Readings:
    """The last reading of each fan before the samples that are held."""

    def __init__(self, fans: int, limit_ns: int) -> None:
        self._limit_ns = limit_ns
        self._fans = np.arange(fans)
        self._t_ns = np.full(fans, LONG_AGO_NS, np.int64)
        self._speed_rad_s = np.full(fans, np.nan)

    def pass_by(self, samples: Samples, count: int) -> None:
        """Take the first samples, `count` of them, that will be held no more."""
        has = np.isfinite(samples.speed_rad_s[:count])
        last = count - 1
        if _all(has[last]):
            self._t_ns, self._speed_rad_s = np.full(len(self._fans), samples.t_ns[last]), samples.speed_rad_s[last]
            return
        rows = last - has[::-1].argmax(axis=0)
        found = has[rows, self._fans]
        self._t_ns = np.where(found, samples.t_ns.take(rows), self._t_ns)
        self._speed_rad_s = np.where(found, samples.speed_rad_s[rows, self._fans], self._speed_rad_s)

    def none_near(self, t_ns: int) -> Array:
        """Whose last reading (fans,) is too long ago."""
        return t_ns - self._t_ns > self._limit_ns

    def between(self, t_ns: Array, at: Array, samples: Samples, newest_t_ns: int) -> tuple[Array, Array]:
        """Speeds (n, fans) at t_ns (n,), each fan's from its own neighbours; NaN where those are missing or too far.

        at: (n,), the last sample at or before each time. newest_t_ns: of all samples that have come. The second array,
        (n, fans), says where a fan's next reading may still come in time.
        """
        # What was read before these samples is row 0, so that every fan has a row before each time.
        fans = self._fans
        own_t_ns = np.concatenate(
            (self._t_ns[np.newaxis], np.broadcast_to(samples.t_ns[:, np.newaxis], samples.speed_rad_s.shape))
        )
        speed = np.concatenate((self._speed_rad_s[np.newaxis], samples.speed_rad_s))
        rows, missing = np.arange(len(speed))[:, np.newaxis], len(speed)
        has = np.isfinite(speed)
        before = np.maximum.accumulate(np.where(has, rows, 0))[at + 1]
        coming = np.minimum.accumulate(np.where(has, rows, missing)[::-1])[::-1]
        after = np.concatenate((coming, np.full((1, len(fans)), missing)))[at + 2]
        none = after == missing
        after = np.where(none, before, after)
        here_t_ns, here = own_t_ns[before, fans], speed[before, fans]
        since_ns = t_ns[:, np.newaxis] - here_t_ns
        span_ns = own_t_ns[after, fans] - here_t_ns
        near = ~none & (span_ns <= self._limit_ns)
        between = here + since_ns / np.where(near, span_ns, 1) * (speed[after, fans] - here)
        found = np.where(since_ns == 0, here, np.where(near, between, np.nan))
        may_come = none & (since_ns > 0) & (newest_t_ns - here_t_ns <= self._limit_ns)
        return found, may_come


class ResamplerCore(Core):
    """One tray's grid. Everything that is dropped or not bridged is counted."""

    def __init__(self, fans: int, config: ResamplerConfig) -> None:
        self._fans = fans
        self._block_size = config.block_size
        self._step_ns = round(NS_PER_S / config.rate_hz)
        self._gap_limit_ns = round(config.gap_limit_s * NS_PER_S)
        self._watermark_ns = round(config.watermark_s * NS_PER_S)
        self._stale_for_ns = round(config.stale_for_s * NS_PER_S)
        self._clock = DeviceClock()
        self._readings = Readings(fans, self._gap_limit_ns)
        # The last raw sample at or before the grid's time, and those after it.
        self._held = Samples(np.zeros(0, np.int64), np.zeros((0, fans)), np.zeros((0, fans)))
        self._newest_t_ns = LONG_AGO_NS
        self._next_t_ns = LONG_AGO_NS
        self._made: list[Grid] = []  # not yet given
        self._made_rows = 0
        self._in_gap = False
        self._silence_ns = 0
        self._tick_t_ns: int | None = None
        self._wrong_fans = 0
        self._set_back_ns = 0  # by how much the host's clock was set back, while that lasts
        self._producer = ""
        self._sequence = -1  # of this producer's newest message
        self._ended: set[str] = set()  # producers that another one has followed
        self._device_sequence: int | None = None  # of the newest raw sample
        self._counts: Counter[str] = Counter()

    def step(self, item: Raw) -> list[Grid]:
        """Take raw samples; give the grid as far as it is known."""
        if item.fans != self._fans:
            self._wrong_fans = item.fans
            self._counts["lost_wrong_fan_count"] += len(item.host_receive_t_ns)
            return []
        self._wrong_fans = 0
        self._silence_ns = 0
        is_new = self._is_new(item)
        times = self._times(item, is_new)
        self._counts["samples_in"] += len(times)
        taken = [k for k, t_ns in enumerate(times) if self._take(t_ns, is_new)]
        if taken:
            t_ns, command, speed = np.array(times, np.int64), item.command, item.speed_rad_s
            if len(taken) < len(times):
                t_ns, command, speed = t_ns[taken], command[taken], speed[taken]
            self._held = self._held.followed_by(t_ns, command, speed)
            self._fill(self._newest_t_ns, final=False)
        return self._blocks()

    def tick(self, now_ns: int) -> list[Grid]:
        """Note how long the line has been silent; past the watermark, say what is known without it."""
        if self._tick_t_ns is not None:
            self._silence_ns += min(max(now_ns - self._tick_t_ns, 0), LONGEST_TICK_NS)
        self._tick_t_ns = now_ns
        if self._silence_ns < self._watermark_ns:
            return []
        return self.give_up_until(self._newest_t_ns + self._silence_ns - self._watermark_ns)

    def give_up_until(self, t_ns: int) -> list[Grid]:
        """Wait for nothing before `t_ns`: give the grid up to there with what is known."""
        self._fill(t_ns, final=True)
        return self._blocks(flush=True)

    def close(self) -> list[Grid]:
        """Give what is held, up to the newest raw sample."""
        return self.give_up_until(self._newest_t_ns)

    def counters(self) -> Mapping[str, int]:
        """docs/explanation/time.md says what each counts."""
        return {**self._counts, "clock_restarts": max(0, self._clock.segments - 1)}

    def problem(self) -> str:
        """A silent line, one with another number of fans, or a host whose clock went back."""
        if self._wrong_fans:
            return f"raw samples of {self._wrong_fans} fans, [[tray]] says fans = {self._fans}: correct one of them"
        if self._silence_ns >= self._watermark_ns:
            return f"no raw samples for {self._watermark_ns / NS_PER_S:g} s and more: look at acquisition"
        if self._set_back_ns:
            return (
                f"the host's clock was set back by {self._set_back_ns / NS_PER_S:.0f} s, or a replay began anew: "
                "samples are refused until it has caught up; restart the stages"
            )
        return ""

    def _is_new(self, item: Raw) -> bool:
        """Whether a message is later than all before; the bus may hand one again, or late from an ended session."""
        producer, sequence = item.header.producer, item.header.sequence
        if producer in self._ended:
            return False
        return producer != self._producer or sequence > self._sequence

    def _times(self, item: Raw, is_new: bool) -> list[int]:
        """The host's time of each sample."""
        times, clock_us = item.host_receive_t_ns.tolist(), item.device_clock_us.tolist()
        segments = self._clock.segments
        if clock_us:
            times[0] = self._clock.to_host_ns(clock_us[0], times[0])
        if times and is_new:
            self._follow_device(item, same_device_run=self._clock.segments == segments)
        return [*times[:1], *map(self._clock.to_host_ns, clock_us[1:], times[1:])] if clock_us else times

    def _follow_device(self, item: Raw, same_device_run: bool) -> None:
        """Count what the device sent while acquisition was dead: only the next session's samples show that."""
        sequence = item.device_sequence
        if item.header.producer != self._producer and len(sequence) and self._device_sequence is not None:
            missing = (int(sequence[0]) - self._device_sequence) % UINT32 - 1
            if same_device_run and 0 < missing < LARGEST_GAP:
                self._counts["lost_between_sessions"] += missing
        if item.header.producer != self._producer:
            self._ended.add(self._producer)
        self._producer, self._sequence = item.header.producer, item.header.sequence
        self._device_sequence = int(sequence[-1]) if len(sequence) else None

    def _take(self, t_ns: int, is_new: bool) -> bool:
        """Whether a sample is newer than all before; counts why not."""
        behind_ns = self._newest_t_ns - t_ns
        if is_new and behind_ns > SET_BACK_NS:
            self._counts["lost_clock_set_back"] += 1
            self._set_back_ns = self._set_back_ns or behind_ns
            return False
        if behind_ns >= 0:
            self._counts["out_of_order" if behind_ns else "repeated"] += 1
            return False
        self._set_back_ns = 0
        if self._newest_t_ns == LONG_AGO_NS:
            self._next_t_ns = first_grid_time(t_ns, self._step_ns)
        elif t_ns <= self._next_t_ns - self._step_ns:  # its grid samples were given up
            self._counts["lost_too_late"] += 1
        self._newest_t_ns = t_ns
        return True

    def _fill(self, until_t_ns: int, final: bool) -> None:
        """Make grid samples up to a time. `final`: with what is there, nothing more is waited for."""
        while True:
            self._let_go()
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
                skipped_t_ns, self._next_t_ns = self._next_t_ns, first_grid_time(next_raw_t_ns, self._step_ns)
                self._note_gap((self._next_t_ns - skipped_t_ns) // self._step_ns)

    def _let_go(self) -> None:
        """Of the samples that the grid has come to, hold the last one only."""
        last = self._held.t_ns.searchsorted(self._next_t_ns, "right").item() - 1
        if last > 0:
            self._readings.pass_by(self._held, last)
            self._held = self._held.rows(slice(last, None))

    def _fill_between(self, until_t_ns: int, final: bool) -> bool:
        """Make grid samples up to the next gap. False: those that are left wait for a reading."""
        samples = self._held
        if samples.t_ns.item(-1) - samples.t_ns.item(0) > self._gap_limit_ns:
            gaps = np.flatnonzero(np.diff(samples.t_ns) > self._gap_limit_ns)
            samples = samples.rows(slice(gaps[0] + 1)) if len(gaps) else samples
        t_ns = self._grid_times(min(until_t_ns, samples.t_ns.item(-1)))
        at = samples.t_ns.searchsorted(t_ns, "right") - 1
        waits = False
        has = np.isfinite(samples.speed_rad_s)
        if _all(has):
            speed = between_samples(t_ns, at, samples)
        elif _all(has == has[0]) and _all(has[0] | self._readings.none_near(t_ns[0])):
            speed = np.where(has[0], between_samples(t_ns, at, samples), np.nan)
        else:
            speed, may_come = self._readings.between(t_ns, at, samples, self._newest_t_ns)
            waiting = may_come.any(axis=1)
            if not final and waiting.any():
                waits, known = True, slice(np.argmax(waiting))
                t_ns, at, speed = t_ns[known], at[known], speed[known]
        if len(t_ns):
            self._in_gap = False
            self._make(t_ns, samples.command.take(at, axis=0), speed, NO_SPEED)
        return not waits

    def _fill_gap(self, until_t_ns: int) -> None:
        """Make grid samples of which nothing is known but the command held."""
        t_ns = self._grid_times(until_t_ns)
        shape = (len(t_ns), self._fans)
        why = np.where(t_ns - self._held.t_ns[0] <= self._watermark_ns, GAP, STALE)
        self._note_gap(len(t_ns))
        self._make(t_ns, np.broadcast_to(self._held.command[0], shape), np.full(shape, np.nan), why[:, np.newaxis])

    def _note_gap(self, samples: int) -> None:
        self._counts["gaps"] += not self._in_gap
        self._counts["grid_samples_in_gaps"] += samples
        self._in_gap = True

    def _grid_times(self, until_t_ns: int) -> Array:
        return np.arange(self._next_t_ns, until_t_ns + 1, self._step_ns)

    def _make(self, t_ns: Array, command: Array, speed: Array, why: Array | np.uint8) -> None:
        """Grid samples, at least one; `why` those that have no speed are not valid."""
        valid = np.isfinite(speed)
        invalid_reason = np.zeros(speed.shape, np.uint8)
        if not _all(valid):
            np.copyto(invalid_reason, why, where=~valid)
        grid = Grid(
            fans=self._fans,
            period_ns=self._step_ns,
            t_ns=t_ns,
            command=command,
            speed_rad_s=speed,
            valid=valid,
            invalid_reason=invalid_reason,
        )
        self._made.append(grid)
        self._made_rows += len(t_ns)
        self._next_t_ns = t_ns.item(-1) + self._step_ns

    def _blocks(self, flush: bool = False) -> list[Grid]:
        size, rows = self._block_size, self._made_rows
        given = rows if flush else rows - rows % size
        if not given:
            return []
        made = join(self._made)
        self._made = [cut(made, given, rows)] if given < rows else []
        self._made_rows = rows - given
        return [made] if rows == size else [cut(made, k, min(k + size, given)) for k in range(0, given, size)]


def build(context: Context) -> Parts:
    """The core of one tray."""
    return Parts(ResamplerCore(context.tray.fans, context.config))


STAGE = Stage(
    name="resampler",
    about="irregular device time to a uniform grid",
    reads=("raw",),
    writes=("grid",),
    config=ResamplerConfig,
    build=build,
)

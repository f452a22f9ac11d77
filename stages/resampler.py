"""Resampler: irregular samples in, the same samples on a uniform grid of time out.

Reads: topic `raw` (device clock us, host's time of receipt ns, command, speed rad/s).
Writes: topic `grid`: `rate_hz` samples a second at absolute multiples of the step (t_ns % step_ns == 0), speed
interpolated linearly, command held (that of the last sample at or before the grid's time).
Timing: a grid sample leaves as soon as a raw sample at or after its time has come. Where one fan has no reading, all
wait for its next one, `gap_limit_s` at most. Where nothing comes at all, `watermark_s` at most.

Gaps longer than `gap_limit_s` are never bridged: their grid samples are not valid, GAP up to `watermark_s` after the
last raw sample and STALE from there on, and `stale_for_s` after it the grid ends until the line returns. All of that
depends on the samples' times only; the host's time, in `tick`, merely decides that it is said while it lasts. So a
replay gives the same grid. See docs/time.md.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from pipeline.device_time import NS_PER_S, UINT32, DeviceClock
from pipeline.stage import Context, Core, Parts, Stage, StageConfig
from schemas.messages import Array, Grid, Raw, WhyNot

LONGEST_TICK_NS = 100_000_000  # a longer pause between ticks is the host's own, and says nothing of the line
LONG_AGO_NS = -(1 << 62)
SET_BACK_NS = NS_PER_S  # a new sample so much older than the newest: the host's clock was set back
LARGEST_GAP = 1 << 24  # samples; a larger step of the device's sequence is a device that began anew


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


@dataclass(frozen=True, slots=True)
class Sample:
    """One raw sample at its own time. command and speed_rad_s: (fans,)."""

    t_ns: int
    command: Array
    speed_rad_s: Array


@dataclass(frozen=True, slots=True)
class Row:
    """One grid sample. All arrays (fans,)."""

    t_ns: int
    command: Array
    speed_rad_s: Array
    valid: Array
    why_not: Array


def first_grid_time(t_ns: int, step_ns: int) -> int:
    """The first multiple of the step at or after `t_ns`."""
    return -(-t_ns // step_ns) * step_ns


class Readings:
    """The last reading of each fan at or before the grid's time; with the next one it gives the speed in between."""

    def __init__(self, fans: int, limit_ns: int) -> None:
        self._limit_ns = limit_ns
        self._t_ns = np.full(fans, LONG_AGO_NS, np.int64)
        self._speed_rad_s = np.full(fans, np.nan)

    def pass_by(self, sample: Sample) -> None:
        """The grid has come to this sample."""
        has = np.isfinite(sample.speed_rad_s)
        self._t_ns[has] = sample.t_ns
        self._speed_rad_s[has] = sample.speed_rad_s[has]

    def at(self, t_ns: int, ahead: deque[Sample], newest_t_ns: int, final: bool) -> Array | None:
        """Speeds (fans,) at `t_ns`, NaN where neighbours are missing or too far apart.

        ahead: the samples after `t_ns`. None means: a fan's next reading may still come in time. `final`: it will not.
        """
        speed = np.where(self._t_ns == t_ns, self._speed_rad_s, np.nan)
        open_ = (self._t_ns != t_ns) & (t_ns - self._t_ns <= self._limit_ns)
        for sample in ahead:
            if not open_.any():
                break
            here = open_ & np.isfinite(sample.speed_rad_s)
            span_ns = sample.t_ns - self._t_ns
            share = (t_ns - self._t_ns) / span_ns
            between = self._speed_rad_s + share * (sample.speed_rad_s - self._speed_rad_s)
            speed = np.where(here & (span_ns <= self._limit_ns), between, speed)
            open_ &= ~here
        if not final and (open_ & (newest_t_ns - self._t_ns <= self._limit_ns)).any():
            return None
        return speed


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
        self._last: Sample | None = None  # the last raw sample at or before the grid's time
        self._ahead: deque[Sample] = deque()  # those after it
        self._newest_t_ns = LONG_AGO_NS
        self._next_t_ns = LONG_AGO_NS
        self._rows: list[Row] = []
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
        receive_t_ns = item.host_receive_t_ns.tolist()
        clock_us = item.device_clock_us.tolist()
        for k, received in enumerate(receive_t_ns):
            segments = self._clock.segments
            t_ns = self._clock.to_host_ns(clock_us[k], received) if clock_us else received
            if k == 0 and is_new:
                self._follow_device(item, same_device_run=self._clock.segments == segments)
            self._take(Sample(t_ns, item.command[k], item.speed_rad_s[k]), is_new)
        return self._blocks()

    def tick(self, now_ns: int) -> list[Grid]:
        """Note how long the line has been silent; past the watermark, say what is known without it."""
        if self._tick_t_ns is not None:
            self._silence_ns += min(max(now_ns - self._tick_t_ns, 0), LONGEST_TICK_NS)
        self._tick_t_ns = now_ns
        if self._silence_ns < self._watermark_ns:
            return []
        self._fill(self._newest_t_ns + self._silence_ns - self._watermark_ns, final=True)
        return self._blocks(flush=True)

    def close(self) -> list[Grid]:
        """Give what is held, up to the newest raw sample."""
        self._fill(self._newest_t_ns, final=True)
        return self._blocks(flush=True)

    def counters(self) -> Mapping[str, int]:
        """docs/time.md says what each counts."""
        return {**self._counts, "clock_restarts": max(0, self._clock.segments - 1)}

    def problem(self) -> str:
        """A silent line, one with another number of fans, or a host whose clock went back."""
        if self._wrong_fans:
            return f"raw samples of {self._wrong_fans} fans, [[tray]] says fans = {self._fans}: correct one of them"
        if self._silence_ns >= self._watermark_ns:
            return f"no raw samples for {self._watermark_ns / NS_PER_S:g} s and more: look at acquisition"
        if self._set_back_ns:
            return (
                f"the host's clock was set back by {self._set_back_ns / NS_PER_S:.0f} s: "
                "samples are refused until it has caught up; restart the stages"
            )
        return ""

    def _is_new(self, item: Raw) -> bool:
        """Whether a message is later than all before; the bus may hand one again, or late from an ended session."""
        producer, sequence = item.header.producer, item.header.sequence
        if producer in self._ended:
            return False
        return producer != self._producer or sequence > self._sequence

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

    def _take(self, sample: Sample, is_new: bool) -> None:
        self._counts["samples_in"] += 1
        behind_ns = self._newest_t_ns - sample.t_ns
        if is_new and behind_ns > SET_BACK_NS:
            self._counts["lost_clock_set_back"] += 1
            self._set_back_ns = self._set_back_ns or behind_ns
            return
        if sample.t_ns <= self._newest_t_ns:
            self._counts["repeated" if sample.t_ns == self._newest_t_ns else "out_of_order"] += 1
            return
        self._set_back_ns = 0
        if self._newest_t_ns == LONG_AGO_NS:
            self._next_t_ns = first_grid_time(sample.t_ns, self._step_ns)
        elif sample.t_ns <= self._next_t_ns - self._step_ns:  # its grid samples were given up by `tick`
            self._counts["lost_too_late"] += 1
        self._newest_t_ns = sample.t_ns
        self._ahead.append(sample)
        self._fill(sample.t_ns, final=False)

    def _fill(self, until_t_ns: int, final: bool) -> None:
        """Make grid samples up to a time. `final`: with what is there, nothing more is waited for."""
        while self._next_t_ns <= until_t_ns:
            t_ns = self._next_t_ns
            while self._ahead and self._ahead[0].t_ns <= t_ns:
                self._last = self._ahead.popleft()
                self._readings.pass_by(self._last)
            if self._last is None:
                return
            silent_ns = t_ns - self._last.t_ns
            if silent_ns > 0 and self._is_gap(self._last):
                if silent_ns > self._stale_for_ns:
                    if not self._ahead:
                        return
                    self._next_t_ns = first_grid_time(self._ahead[0].t_ns, self._step_ns)
                    self._note_gap((self._next_t_ns - t_ns) // self._step_ns)
                    continue
                why = WhyNot.GAP if silent_ns <= self._watermark_ns else WhyNot.STALE
                speed = np.full(self._fans, np.nan)
                self._note_gap(1)
            else:
                held = self._readings.at(t_ns, self._ahead, self._newest_t_ns, final)
                if held is None:
                    return
                speed, why = held, WhyNot.NO_SPEED
                self._in_gap = False
            valid = np.isfinite(speed)
            why_not = np.where(valid, WhyNot.NONE, why).astype(np.uint8)
            self._rows.append(Row(t_ns, self._last.command, speed, valid, why_not))
            self._next_t_ns += self._step_ns

    def _is_gap(self, last: Sample) -> bool:
        return not self._ahead or self._ahead[0].t_ns - last.t_ns > self._gap_limit_ns

    def _note_gap(self, samples: int) -> None:
        self._counts["gaps"] += not self._in_gap
        self._counts["grid_samples_in_gaps"] += samples
        self._in_gap = True

    def _blocks(self, flush: bool = False) -> list[Grid]:
        blocks = []
        while len(self._rows) >= self._block_size or (flush and self._rows):
            rows, self._rows = self._rows[: self._block_size], self._rows[self._block_size :]
            blocks.append(
                Grid(
                    fans=self._fans,
                    step_ns=self._step_ns,
                    t_ns=np.array([row.t_ns for row in rows], np.int64),
                    command=np.array([row.command for row in rows]),
                    speed_rad_s=np.array([row.speed_rad_s for row in rows]),
                    valid=np.array([row.valid for row in rows]),
                    why_not=np.array([row.why_not for row in rows]),
                )
            )
        return blocks


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

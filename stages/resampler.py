"""Resampler: puts irregular raw samples on a uniform time grid.

Reads: topic `raw` (device clock us, host time of receipt ns, command, speed rad/s).
Writes: topic `grid`: samples at absolute multiples of the period (t_ns % period_ns == 0), speed interpolated linearly,
command held (that of the last sample at or before the grid time). The readings of a counting tacho are held, too.
Supply voltage, current and temperature are interpolated where the samples on both sides have them, else held until the
next sample, and unknown in gaps.
Timing: a grid sample is published as soon as a raw sample at or after its time has arrived, in one message with the
others that the same raw message completes. If one fan has no reading, all fans wait for its next one, at most
`gap_limit_s`. If no samples arrive, the wait is at most `watermark_s`.

Without `rate_hz`, the rate of the grid follows from the line: samples are kept until its rate is known, after one to
five seconds, and are then put on the grid. The rate stays until the resampler is started again. Of the samples that are
kept, the least delayed one says how late the first one was.

Gaps longer than `gap_limit_s` are never bridged. Their grid samples are not valid: GAP up to `watermark_s` after the
last raw sample, then STALE; after five seconds, or twice `watermark_s`, the grid ends until samples arrive again.
Content depends on sample times only. Host time, in `tick`, decides only when grid samples of a gap are published, so
that a replay gives the same grid. They are not published while the samples may still come because only the link to
acquisition is cut. See docs/explanation/time.md.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Self

from pydantic import Field, model_validator

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.runtime.stage import BuiltStage, Context, Core, Stage, StageConfig
from fantwin.pipeline.timebase.grid_timing import (
    GridTiming,
    grid_rate_hz,
    grid_timing,
    is_too_slow,
    leaves_gaps,
)
from fantwin.pipeline.timebase.line_rate import ENOUGH_SAMPLES, LONGEST_WAIT_US, MIN_SAMPLES, LineRate, SampleTimes
from fantwin.pipeline.timebase.sample_grid import SampleGrid
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.messages import Grid, Raw, StatedTacho
from fantwin.schemas.tacho import INSTANTANEOUS, Tacho, tacho_of_each_fan
from fantwin.schemas.units import NS_PER_S, period_in_words

FASTER = 2.0  # a line that sends this many times the samples of its grid has changed


LINK_WAIT_S = 900.0
"""longest wait, before a gap is published, for acquisition to confirm that it has sent nothing; if the link is cut, the
samples come later"""


class ResamplerConfig(StageConfig):
    """Section `[resampler]`. What is not given follows from the line."""

    rate_hz: float | None = Field(
        default=None,
        gt=0,
        le=100_000,
        description="samples a second on the grid; without it that of the line, rounded, at most 100",
    )
    gap_limit_s: float | None = Field(
        default=None,
        gt=0,
        description="no interpolation between samples further apart; without it five periods, at least 0.1 s",
    )
    watermark_s: float | None = Field(
        default=None,
        gt=0,
        description="how long to wait before a gap is published; without it 0.5 s, or gap_limit_s if longer",
    )

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if self.gap_limit_s is not None and self.watermark_s is not None and self.gap_limit_s > self.watermark_s:
            raise ValueError("watermark_s must not be shorter than gap_limit_s")
        return self

    def timing(self, rate_hz: float) -> GridTiming:
        """The times of a grid of this rate."""
        return grid_timing(rate_hz, self.gap_limit_s, self.watermark_s)


class ResamplerCore(Core):
    """The grid of one tray, at the rate of the configuration or at that of its line."""

    def __init__(
        self,
        fans: int,
        config: ResamplerConfig,
        *,
        tachos: Sequence[Tacho] = INSTANTANEOUS,
        names: FanNames = NO_NAMES,
    ) -> None:
        """tachos: how the speed is measured, one for all fans or one for each."""
        self._fans, self._names = fans, names
        self._tachos = tacho_of_each_fan(tachos, fans)
        self._stated: tuple[StatedTacho, ...] = ()
        """tachos stated by the newest message"""
        self._other_tachos = ""
        self._config = config
        self._line = LineRate()
        self._line_hz: float | None = None
        """rate of the line as found; None: not yet, or not asked for"""
        self._waiting: list[Raw] = []
        """samples that wait until the rate of the line is known"""
        self._newest = SampleTimes(ENOUGH_SAMPLES)
        self._wrong_fans = 0
        self._input_is_complete = True
        self._counts: Counter[str] = Counter()
        self._grid: SampleGrid | None = None
        self._timing: GridTiming | None = None
        if config.rate_hz is not None:
            self._start(config.rate_hz)

    def step(self, item: Raw) -> list[Grid]:
        """Add raw samples; return the grid that they determine."""
        if item.fans != self._fans:
            self._wrong_fans = item.fans
            self._counts["lost_wrong_fan_count"] += len(item.host_receive_t_ns)
            return []
        self._wrong_fans = 0
        if item.tachos != self._stated:
            self._stated, self._other_tachos = item.tachos, self._difference(item.tachos)
        self._newest.add(item)
        if self._grid is not None:
            return self._grid.step(item)
        if self._waiting and self._waiting[-1].header.producer != item.header.producer:
            # the recording says of the first grid what it was made from: messages of one session of acquisition
            self._counts["lost_before_rate"] += sum(len(each.host_receive_t_ns) for each in self._waiting)
            self._waiting.clear()
        self._waiting.append(item)
        return list(self._grid_of_line()) if self._line.add(item) else []

    def tick(self, now_ns: int) -> list[Grid]:
        """Past the watermark, publish the grid without samples, unless they may still come."""
        return self._grid.tick(now_ns, is_complete=self._input_is_complete) if self._grid else []

    def confirm_input(self, *, is_complete: bool) -> None:
        """Note whether acquisition has shown since the last tick that all of its samples have arrived."""
        self._input_is_complete = is_complete

    def publish_until(self, t_ns: int) -> list[Grid]:
        """Publish the grid up to `t_ns` without waiting for more samples, as a session did that then ended."""
        grids = [*self._grid_of_line()] if self._waiting and t_ns > 0 else []
        return [*grids, *self._grid.publish_until(t_ns)] if self._grid else grids

    def close(self) -> list[Grid]:
        """Publish the grid up to the newest raw sample, however few there are."""
        grids = [*self._grid_of_line()] if self._waiting else []
        return [*grids, *self._grid.close()] if self._grid else grids

    def counters(self) -> Mapping[str, int]:
        """docs/explanation/time.md explains each counter."""
        return {**(self._grid.counters() if self._grid else {}), **self._counts}

    def notes(self) -> list[str]:
        """The rate of the grid and where it comes from, and how much of the grid lies in gaps."""
        if self._grid is None or self._timing is None:
            waiting = sum(len(item.host_receive_t_ns) for item in self._waiting)
            return [f"the rate of the line is being measured ({waiting} samples so far)"] if waiting else []
        is_known = self._line_hz is not None and math.isfinite(self._line_hz)
        line = f" (the line sends {self._line_hz:.3g} samples a second)" if is_known else ""
        counts = self._grid.counters()
        samples = counts.get("grid_samples", 0) + counts.get("grid_samples_skipped", 0)
        share = 100 * counts.get("grid_samples_in_gaps", 0) / samples if samples else 0.0
        gaps = f"gaps longer than {self._timing.gap_limit_ns / NS_PER_S:g} s: {counts.get('gaps', 0)}"
        return [f"grid of {self._timing.rate_hz:.3g} Hz{line}; {gaps}, {share:.1f} % of the time"]

    def problem(self) -> str:
        """Problem: no samples, those of another number of fans or other tachos, a line that does not fit the grid, or a
        host clock that was set back."""
        if self._wrong_fans:
            return f"raw samples of {self._wrong_fans} fans, [[tray]] says fans = {self._fans}: correct one of them"
        return "; ".join(filter(None, (self._other_tachos, self._problem_of_times())))

    def _difference(self, stated: tuple[StatedTacho, ...]) -> str:
        """Words on the tachos that a message states, where the configuration says otherwise."""
        try:
            tachos = tacho_of_each_fan([each.tacho for each in stated], self._fans) if stated else self._tachos
        except ValueError:
            return "raw messages state a tacho that this version does not know: use the version that acquisition runs"
        others = [fan for fan, its in enumerate(tachos) if its != self._tachos[fan]]
        if not others:
            return ""
        fan, more = others[0], f" (and {len(others) - 1} more)" if len(others) > 1 else ""
        return (
            f"raw messages state another tacho than this configuration, for {self._names.label(fan)}{more} "
            f"{tachos[fan]} instead of {self._tachos[fan]}: set tacho = {tachos[fan].as_toml} in [[tray]], or correct "
            "the source"
        )

    def _problem_of_times(self) -> str:
        if self._grid is None or self._timing is None:
            return ""
        return self._grid.problem() or self._misfit(self._timing)

    def _misfit(self, timing: GridTiming) -> str:
        """Why the newest samples do not fit the grid."""
        newest = self._newest
        if newest.count < MIN_SAMPLES or (newest.count < ENOUGH_SAMPLES and newest.span_us < LONGEST_WAIT_US):
            return ""
        line_hz = newest.line_hz
        about = float(f"{line_hz:.1g}")  # a text that changes would be reported each time
        apart = f"samples arrive about {about:g} times a second"
        if line_hz < 1.0:
            apart = f"samples arrive about every {period_in_words(float(f'{1.0 / line_hz:.1g}'))}"
        if self._config.rate_hz is None and is_too_slow(line_hz):
            return f"{apart}: too slow to be judged; let the device send one a minute"
        if leaves_gaps(line_hz, timing):
            what = "rate_hz and gap_limit_s" if self._config.rate_hz or self._config.gap_limit_s else ""
            todo = f"leave out {what} of [resampler], they follow from the line" if what else "restart the resampler"
            return f"{apart}, too few for gap_limit_s = {timing.gap_limit_ns / NS_PER_S:g}: {todo}"
        if self._config.rate_hz is None and grid_rate_hz(line_hz) >= FASTER * timing.rate_hz:
            return f"{apart}, and the grid has {timing.rate_hz:.3g} Hz since they were fewer: restart the resampler"
        return ""

    def _grid_of_line(self) -> Iterator[Grid]:
        """Start the grid at the rate of the line, and put the samples that have waited on it."""
        self._line_hz = self._line.line_hz
        grid = self._start(grid_rate_hz(self._line_hz))
        waiting, self._waiting = self._waiting, []
        waiting[0] = _received_earlier(waiting[0], self._line.first_lateness_ns)
        for item in waiting:
            yield from grid.step(item)

    def _start(self, rate_hz: float) -> SampleGrid:
        config = self._config
        if self._line_hz is not None and is_too_slow(self._line_hz):
            config = config.model_copy(update={"gap_limit_s": config.gap_limit_s or 1.0 / rate_hz})
        self._timing = config.timing(rate_hz)
        self._grid = SampleGrid(self._tachos, self._timing, round(LINK_WAIT_S * NS_PER_S))
        return self._grid


def _received_earlier(message: Raw, lateness_ns: int) -> Raw:
    """The same, its first sample received earlier: all times of the device follow from that."""
    t_ns = message.host_receive_t_ns.copy()
    t_ns[:1] -= lateness_ns
    return replace(message, host_receive_t_ns=t_ns)


def build(context: Context) -> BuiltStage:
    """The core of one tray."""
    tray = context.tray
    return BuiltStage(ResamplerCore(tray.fans, context.config, tachos=tray.tachos, names=tray.names))


STAGE = Stage(
    row=STAGES["resampler"],
    about="irregular raw samples to a uniform time grid",
    config=ResamplerConfig,
    build=build,
)

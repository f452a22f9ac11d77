"""The last hour of every fan, a row every few seconds: what a page draws before its live samples begin.

A row of a small site has the least, mean and largest value of all samples since the row before; of a large one, whose
samples are not all read, it is one sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.messages import Array, Score
from fantwin.schemas.units import NS_PER_S

HISTORY_S = 3600
FINE_STEP_S, COARSE_STEP_S = 0.5, 5.0
"""the second where a site has more than FINE_UP_TO fans: 5,000 fans then take 86 MB"""
FINE_UP_TO = 64
CURVES = (
    "measured_speed_rad_s",
    "predicted_speed_rad_s",
    "band_half_width_rad_s",
    "torque_balance_command",
    "score",
    "command",
)
"""of a fan, in the order of the last axis, before its channels; NaN where nothing was measured or judged"""
DEVIATION = "deviation_rad_s"
SERIES = (DEVIATION, *CURVES, *(each.name for each in CHANNELS))
"""the same with all channels and, first, how far the measured speed is above the twin's"""
COLUMNS = (
    "command",
    "measured_speed_rad_s",
    "predicted_speed_rad_s",
    "band_variance",
    "torque_balance_command",
    "score",
    "state",
    "valid",
    "invalid_reason",
    *(each.name for each in CHANNELS),
)
"""of a score, from which the curves and the state of a fan are made"""


@dataclass(frozen=True, eq=False)
class Curves:
    """A stretch of one fan: t_ns (n,) int64 and values (n, len(CURVES) + len(channels)) float32."""

    t_ns: Array
    values: Array
    channels: tuple[str, ...] = ()


def curves_of(score: Score, fan: int) -> Curves:
    """Those of a score with `COLUMNS`."""
    channels = channels_of(score)
    return Curves(score.t_ns, values_of(score, channels, np.s_[:, fan]), channels)


def channels_of(score: Score) -> tuple[str, ...]:
    """The channels that a score has."""
    return tuple(each.name for each in CHANNELS if len(getattr(score, each.name)))


class FanHistory:
    """Of all fans of a site, in a ring for each tray.

    Attributes:
        is_complete: each row stands for all samples since the one before.
        step_ns: between two rows.
    """

    def __init__(self, trays: Sequence[TrayConfig]) -> None:
        self.is_complete = sum(tray.fans for tray in trays) <= FINE_UP_TO
        self.step_ns = round((FINE_STEP_S if self.is_complete else COARSE_STEP_S) * NS_PER_S)
        kind = _FineRing if self.is_complete else _Ring
        self._rings = {tray.name: kind(tray.fans, self.step_ns) for tray in trays}

    def add(self, score: Score) -> None:
        """Keep a score with `COLUMNS`; where not all are kept, its last sample if the one before is a step older. Time
        that goes back, as in a replay that begins again, empties the ring."""
        self._rings[score.header.tray].add(score)

    def of(self, tray: str, fan: int, since_t_ns: int) -> Curves:
        """What is kept of a fan, oldest first."""
        return self._rings[tray].of(fan, since_t_ns)

    def series(self, tray: str, fan: int) -> tuple[Array, Array, Array, Array]:
        """All that is kept of a fan, oldest first: times (n,), and least, mean and largest values (n, len(SERIES))."""
        return self._rings[tray].series(fan)


class _Ring:
    """Single samples."""

    def __init__(self, fans: int, step_ns: int) -> None:
        self._step_ns = step_ns
        self._points = HISTORY_S * NS_PER_S // step_ns
        self._t_ns = np.zeros(self._points, np.int64)
        self._values = np.full((self._points, fans, len(CURVES)), np.nan, np.float32)
        self._count = 0
        """all that were added"""
        self._began_t_ns: int | None = None
        """time of the first score in the newest row"""
        self.channels: tuple[str, ...] = ()

    def add(self, score: Score) -> None:
        t_ns, new = int(score.t_ns[-1]), tuple(name for name in channels_of(score) if name not in self.channels)
        if new:
            self.channels = (*self.channels, *new)
            self.widen(len(new))
        if self._count and t_ns < self._t_ns[(self._count - 1) % self._points]:
            self._count, self._began_t_ns = 0, None
        begins = self._began_t_ns is None or t_ns - self._began_t_ns >= self._step_ns
        if begins:
            self._count, self._began_t_ns = self._count + 1, t_ns
        self.keep(score, (self._count - 1) % self._points, begins=begins)

    def widen(self, channels: int) -> None:
        """Room for channels that are measured for the first time."""
        self._values = _widened(self._values, channels)

    def keep(self, score: Score, row: int, *, begins: bool) -> None:
        if begins:
            self._t_ns[row], self._values[row] = score.t_ns[-1], values_of(score, self.channels, -1)

    def of(self, fan: int, since_t_ns: int) -> Curves:
        order = self._order()
        order = order[self._t_ns[order] >= since_t_ns]
        return Curves(self._t_ns[order], self._values[order, fan], self.channels)

    def series(self, fan: int) -> tuple[Array, Array, Array, Array]:
        order = self._order()
        values = in_series(self._values[order, fan], self.channels)
        return self._t_ns[order], values, values, values

    def _order(self) -> Array:
        return np.arange(max(0, self._count - self._points), self._count) % self._points


class _FineRing(_Ring):
    """The mean of all samples as values, and the extremes."""

    def __init__(self, fans: int, step_ns: int) -> None:
        super().__init__(fans, step_ns)
        shape = self._points, fans, 1 + len(CURVES)
        self._low, self._high = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
        self._total, self._samples = np.zeros((2, fans, len(CURVES)))
        """of the newest row"""

    def widen(self, channels: int) -> None:
        super().widen(channels)
        self._low, self._high = _widened(self._low, channels), _widened(self._high, channels)
        self._total, self._samples = (np.pad(each, ((0, 0), (0, channels))) for each in (self._total, self._samples))

    def keep(self, score: Score, row: int, *, begins: bool) -> None:
        values = values_of(score, self.channels, np.s_[:])
        with_deviation = np.concatenate((_deviation(values), values), axis=-1)
        low, high = np.fmin.reduce(with_deviation), np.fmax.reduce(with_deviation)
        if begins:
            self._total[:], self._samples[:] = 0.0, 0.0
        else:
            low, high = np.fmin(low, self._low[row]), np.fmax(high, self._high[row])
        self._total += np.nan_to_num(values).sum(axis=0)
        self._samples += np.isfinite(values).sum(axis=0)
        with np.errstate(invalid="ignore"):
            self._values[row] = self._total / np.where(self._samples, self._samples, np.nan)
        self._t_ns[row], self._low[row], self._high[row] = score.t_ns[-1], low, high

    def series(self, fan: int) -> tuple[Array, Array, Array, Array]:
        order = self._order()
        low, high = (_with_channels(each[order, fan], self.channels) for each in (self._low, self._high))
        mean = in_series(self._values[order, fan], self.channels)
        return self._t_ns[order], low, np.fmin(np.fmax(mean, low), high), high


def _widened(values: Array, channels: int) -> Array:
    room = np.full((*values.shape[:-1], channels), np.nan, np.float32)
    return np.concatenate((values, room), axis=-1)


def _deviation(values: Array) -> Array:
    return values[..., :1] - values[..., 1:2]


def in_series(values: Array, channels: Sequence[str]) -> Array:
    """Curves and these channels (n, ...) as columns of `SERIES`."""
    return _with_channels(np.concatenate((_deviation(values), values), axis=-1), channels)


def _with_channels(values: Array, channels: Sequence[str]) -> Array:
    """Columns of `SERIES`, of which those of other channels are NaN."""
    found = np.full((len(values), len(SERIES)), np.nan, np.float32)
    found[:, [*range(1 + len(CURVES)), *map(SERIES.index, channels)]] = values
    return found


def values_of(score: Score, channels: Sequence[str], at: Any) -> Array:
    """The curves in a score with `COLUMNS`, (..., len(CURVES) + len(channels)) float32.

    at: the samples and fans, as an index of its columns (n, fans).
    """
    valid = score.valid[at]
    unknown = np.full(valid.shape, np.nan)

    def judged(values: Array) -> Array:
        return np.where(valid, values[at], np.nan)

    columns = (
        score.measured_speed_rad_s[at],
        judged(score.predicted_speed_rad_s),
        judged(np.sqrt(score.band_variance)),
        judged(score.torque_balance_command) if len(score.torque_balance_command) else unknown,
        judged(score.score) if len(score.score) else unknown,
        score.command[at],
        *(values[at] if len(values := getattr(score, name)) else unknown for name in channels),
    )
    return np.stack(columns, axis=-1).astype(np.float32)

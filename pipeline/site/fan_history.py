"""The last hour of every fan, a sample every few seconds: what a page draws before its live samples begin."""

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
    """Of all fans of a site, in a ring for each tray."""

    def __init__(self, trays: Sequence[TrayConfig]) -> None:
        step_s = FINE_STEP_S if sum(tray.fans for tray in trays) <= FINE_UP_TO else COARSE_STEP_S
        self._rings = {tray.name: _Ring(tray.fans, step_s) for tray in trays}

    def add(self, score: Score) -> None:
        """Keep the last sample of a score with `COLUMNS`, if the one before is a step older. Time that goes back, as in
        a replay that begins again, empties the ring."""
        ring = self._rings[score.header.tray]
        ring.have(channels_of(score))
        ring.add(int(score.t_ns[-1]), values_of(score, ring.channels, -1))

    def of(self, tray: str, fan: int, since_t_ns: int) -> Curves:
        """What is kept of a fan, oldest first."""
        return self._rings[tray].of(fan, since_t_ns)


class _Ring:
    def __init__(self, fans: int, step_s: float) -> None:
        self._step_ns = round(step_s * NS_PER_S)
        self._points = round(HISTORY_S / step_s)
        self._t_ns = np.zeros(self._points, np.int64)
        self._values = np.full((self._points, fans, len(CURVES)), np.nan, np.float32)
        self._count = 0
        """all that were added"""
        self.channels: tuple[str, ...] = ()

    def have(self, channels: tuple[str, ...]) -> None:
        """Room for channels that are measured for the first time."""
        new = tuple(name for name in channels if name not in self.channels)
        if new:
            room = np.full((*self._values.shape[:2], len(new)), np.nan, np.float32)
            self._values, self.channels = np.concatenate((self._values, room), axis=-1), (*self.channels, *new)

    def add(self, t_ns: int, values: Array) -> None:
        newest_t_ns = int(self._t_ns[(self._count - 1) % self._points]) if self._count else None
        if newest_t_ns is not None and t_ns < newest_t_ns:
            self._count, newest_t_ns = 0, None
        if newest_t_ns is None or t_ns - newest_t_ns >= self._step_ns:
            self._t_ns[self._count % self._points], self._values[self._count % self._points] = t_ns, values
            self._count += 1

    def of(self, fan: int, since_t_ns: int) -> Curves:
        order = np.arange(max(0, self._count - self._points), self._count) % self._points
        order = order[self._t_ns[order] >= since_t_ns]
        return Curves(self._t_ns[order], self._values[order, fan], self.channels)


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

"""Torque balance: the command given minus the command that a healthy fan needs for the measured motion.

A healthy fan needs J w' + alpha w + C_D w|w| + friction. The difference is filtered by 1 / (1 + s / lambda), so that no
speed is differentiated: the filter turns J w' into J lambda (w - filtered w), as the filtering operator of Peng and
Chen does (their equations 13 to 18). A speed controller cannot hide a fault from it: the command that it adds to hold
the speed appears here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.scoring.column_state import ColumnState


@dataclass(frozen=True, eq=False)
class BalanceModel:
    """A healthy fan's balance, (fans,) each, in the tray's command unit."""

    inertia: Array
    viscous: Array
    drag: Array
    friction: Array
    lag_s: Array
    filter_rate_per_s: float
    lowest_speed_rad_s: Array
    """speed below which friction is undefined, and there is no balance"""
    highest_speed_rad_s: float
    """speed above which the command of a healthy fan is not known"""
    off_below: Array | None = None
    """(fans,) command below which the drive is off; None: where friction is not overcome"""


class TorqueBalance(ColumnState):
    """The balance of a tray's fans, block by block. The result does not depend on how samples are cut into blocks.

    It starts with the first two known samples of a fan, and again after unknown samples, after the drive was off, and
    after the fan was too slow.
    """

    def __init__(self, model: BalanceModel) -> None:
        self._model = model
        of_friction = np.where(model.friction > 0.0, model.friction, -np.inf)
        self._off_below = of_friction if model.off_below is None else model.off_below
        fans = len(model.inertia)
        self._speed = np.full(fans, np.nan)
        self._command = np.full(fans, np.nan)
        self._lagged = np.full(fans, np.nan)
        self._lag_step_s = np.nan
        self._lag_shares = (np.zeros(fans), np.zeros(fans))
        self._filtered = np.zeros(fans)
        self._weight = np.zeros(fans)

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {
            "speed": self._speed,
            "command": self._command,
            "lagged": self._lagged,
            "filtered": self._filtered,
            "weight": self._weight,
        }

    def reset(self) -> None:
        """Start again: samples are missing."""
        self._speed[:] = self._command[:] = self._lagged[:] = np.nan

    def update(self, period_s: float, command: Array, speed_rad_s: Array, known: Array) -> Array:
        """The balance at each sample, NaN where it is not settled. All (n, fans); command: held to the next sample."""
        model = self._model
        drives = command >= self._off_below  # a drive that is off may brake or coast, which the model does not cover
        turns = np.abs(speed_rad_s) >= model.lowest_speed_rad_s
        speed = np.where(known & drives & turns, speed_rad_s, np.nan)
        before, given = np.vstack((self._speed, speed))[:-1], np.vstack((self._command, command))[:-1]
        self._speed, self._command = speed[-1].copy(), command[-1].copy()
        linked = np.isfinite(before) & np.isfinite(speed) & np.isfinite(given)
        acting = self._acting(period_s, given)
        mean = 0.5 * (before + speed)
        drag = (model.viscous + model.drag * np.abs(mean)) * mean
        excess = acting - model.inertia * (speed - before) / period_s - drag - model.friction
        keep = float(np.exp(-model.filter_rate_per_s * period_s))
        filtered, weight = self._filter(excess, linked, keep)
        self._filtered, self._weight = filtered[-1].copy(), weight[-1].copy()
        settled = linked & (weight >= SETTLED) & (np.abs(speed) <= model.highest_speed_rad_s)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(settled, filtered / weight, np.nan)

    def _filter(self, excess: Array, linked: Array, keep: float) -> tuple[Array, Array]:
        filtered, weight = np.zeros_like(excess), np.zeros_like(excess)
        if by_rows(*excess.shape):
            before, weight_before = self._filtered, self._weight
            for row, is_linked in enumerate(linked):
                before = filtered[row] = np.where(is_linked, (1.0 - keep) * excess[row] + keep * before, 0.0)
                weight_before = weight[row] = np.where(is_linked, (1.0 - keep) + keep * weight_before, 0.0)
            return filtered, weight
        for fan in np.flatnonzero(linked.any(axis=0)).tolist():
            state = np.array([[self._filtered[fan], self._weight[fan]]])
            for rows in unbroken_rows(linked[:, fan]):
                if rows.start > 0:
                    state = np.zeros((1, 2))
                pair = np.column_stack((excess[rows, fan], np.ones(rows.stop - rows.start)))
                made = filter_rows(keep, pair, keep * state)
                filtered[rows, fan], weight[rows, fan] = made.T
        return filtered, weight

    def _acting(self, period_s: float, given: Array) -> Array:
        """The command that acts over the step before each sample, after the electrical lag: lag i' + i = command."""
        lag_s = self._model.lag_s
        if not lag_s.any():
            return given
        if by_rows(*given.shape):
            return np.array([self._acting_once(period_s, row) for row in given])
        acting = given.copy()
        keeps, shares = self._lagging(period_s)
        for fan in np.flatnonzero(lag_s).tolist():
            keep, share = float(keeps[fan]), float(shares[fan])
            lagged = self._lagged[fan : fan + 1]
            for rows in unbroken_rows(np.isfinite(given[:, fan])):
                held = given[rows, fan]
                # a lag that has long settled, where nothing is known from before
                start = held[:1] if np.isnan(lagged[0]) or rows.start > 0 else lagged
                after = filter_rows(keep, held[:, np.newaxis], keep * start[np.newaxis])
                before = np.concatenate((start, after[:-1, 0]))
                acting[rows, fan] = held + (before - held) * share
                lagged = after[-1:, 0]
            self._lagged[fan] = lagged[0] if np.isfinite(given[-1, fan]) else np.nan
        return acting

    def _acting_once(self, period_s: float, given: Array) -> Array:
        """Filter one sample, (fans,): all fans at once."""
        keep, share = self._lagging(period_s)
        start = np.where(np.isnan(self._lagged), given, self._lagged)
        after = (1.0 - keep) * given + keep * start
        self._lagged = np.where(np.isfinite(given), after, np.nan)
        return np.where(self._model.lag_s > 0.0, given + (start - given) * share, given)

    def _lagging(self, period_s: float) -> tuple[Array, Array]:
        """The rest of a deviation after a step, and its mean over the step, (fans,) each, as shares of it."""
        if period_s != self._lag_step_s:
            steps = period_s / np.where(self._model.lag_s > 0.0, self._model.lag_s, 1.0)
            self._lag_step_s, self._lag_shares = period_s, (np.exp(-steps), -np.expm1(-steps) / steps)
        return self._lag_shares


FEW_ROWS, ROWS_OF_FAN = 8, 2
"""filtered row by row, all fans at once: up to so many rows it costs no more than to filter fan by fan"""
SETTLED = 0.6
"""weight of the samples in the filter from which on the balance is valid: one time constant"""


def by_rows(rows: int, fans: int) -> bool:
    """Return whether to filter row by row, all fans at once, instead of fan by fan."""
    return rows <= max(FEW_ROWS, ROWS_OF_FAN * fans)


def filter_rows(keep: float, rows: Array, state: Array) -> Array:
    """Filter along the first axis, y[k] = (1 - keep) x[k] + keep y[k-1], by samples, so that cuts change nothing.

    In plain numbers, because `scipy.signal` takes two seconds to import.

    rows: (n, m). state: (1, m), keep times the y before the first. Returns y (n, m).
    """
    right = (1.0 - keep) * rows
    right[0] += state[0]
    columns = (accumulate(column, lambda y, x: x + keep * y) for column in right.T.tolist())
    return np.array([list(column) for column in columns]).T


def unbroken_rows(flags: Array) -> Sequence[slice]:
    """Rows where flags (n,) are set without interruption."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], flags.astype(np.int8), [0]))))
    return [slice(start, stop) for start, stop in edges.reshape(-1, 2).tolist()]

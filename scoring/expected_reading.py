"""Expected reading: what a tacho may show of a predicted speed, and the command that belongs to its readings.

A counting tacho shows the mean speed over its window, and keeps showing it until the next count is complete. When its
windows begin is not known. At any time it may therefore show any of the means whose windows ended within the last
`held_s`; a reading is compared with the range of these.

For a linear fan, the mean of the speed is the response to the mean of the command. The torque balance of readings is
taken with the command averaged in the same way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.schemas.tacho import Tacho
from fantwin.scoring.column_state import ColumnState


class ExpectedReading:
    """The readings that the tachos of a tray may show, however samples are cut into blocks."""

    def __init__(self, tachos: Sequence[Tacho], period_s: float) -> None:
        """tachos: one for each fan. period_s: of the grid."""
        self._means = [
            (
                fans,
                _WindowMean(len(fans), tacho.window_s, tacho.delay_s, period_s),
                _Range(len(fans), tacho.held_s / period_s),
            )
            for tacho, fans in _averaging(tachos)
        ]

    @property
    def states(self) -> list[ColumnState]:
        """All that is kept of each fan that has a tacho which averages."""
        return [state for _, *states in self._means for state in states]

    def start(self, fans: Array, speed_rad_s: Array) -> None:
        """Start again for some fans, (fans,) of bool, as if each had turned at this speed, (fans,), for long."""
        for columns, mean, possible in self._means:
            mean.start(fans[columns], speed_rad_s[columns])
            possible.start(fans[columns], speed_rad_s[columns])

    def update(self, speed_rad_s: Array) -> tuple[Array, Array]:
        """The middle of the readings that the tachos may show, and half of their range. All (n, fans), rad/s.

        Both are NaN where the speed is; a fan has to be started after that.
        """
        middle = speed_rad_s.copy()
        half_range = np.where(np.isfinite(speed_rad_s), 0.0, np.nan)
        for columns, mean, possible in self._means:
            speed = speed_rad_s[:, columns]
            low, high = possible.update(mean.update(np.nan_to_num(speed)))
            middle[:, columns] = np.where(np.isfinite(speed), (low + high) / 2, np.nan)
            half_range[:, columns] += (high - low) / 2
        return middle, half_range


class AveragedCommand(ColumnState):
    """The command of each fan, averaged over the window of its tacho and over the unknown age of a reading."""

    def __init__(self, tachos: Sequence[Tacho], period_s: float) -> None:
        """tachos: one for each fan. period_s: of the grid."""
        self._means = [
            (
                fans,
                _WindowMean(len(fans), tacho.window_s, tacho.delay_s, period_s),
                _WindowMean(len(fans), tacho.held_s, 0.0, period_s),
            )
            for tacho, fans in _averaging(tachos)
        ]
        self._memory_rows = np.zeros(len(tachos), np.int64)
        for columns, over_window, over_age in self._means:
            self._memory_rows[columns] = over_window.depth + over_age.depth
        self._known_rows = np.zeros(len(tachos), np.int64)
        """(fans,) number of samples in a row for which the command has been known"""

    @property
    def states(self) -> list[ColumnState]:
        """All that is kept of each fan."""
        return [self, *(state for _, *states in self._means for state in states)]

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {"known_rows": self._known_rows}

    def reset(self) -> None:
        """Start again: samples are missing."""
        self._known_rows[:] = 0

    def update(self, command: Array) -> Array:
        """The averaged command, NaN until all that it is averaged over is known. (n, fans), NaN where not known."""
        known = np.isfinite(command)
        averaged = np.where(known, command, 0.0)
        for columns, over_window, over_age in self._means:
            averaged[:, columns] = over_age.update(over_window.update(averaged[:, columns]))
        rows = np.arange(1, len(command) + 1)[:, np.newaxis]
        unknown_at = np.maximum.accumulate(np.where(known, 0, rows), axis=0)
        known_rows = rows - unknown_at + np.where(unknown_at == 0, self._known_rows, 0)
        self._known_rows = known_rows[-1].copy()
        return np.where(known_rows > self._memory_rows, averaged, np.nan)


class _WindowMean(ColumnState):
    """The mean of the last `window_s`, `delay_s` ago, of columns that are linear between samples."""

    def __init__(self, columns: int, window_s: float, delay_s: float, period_s: float) -> None:
        self._end, self._begin = delay_s / period_s, (delay_s + window_s) / period_s  # in samples before the present
        self.depth = math.ceil(self._begin)
        """number of past samples that it needs"""
        self._integral = np.zeros((self.depth + 1, columns))
        """integral at the last samples, in units times samples; it grows as long as the stage runs, a double is fine
        enough"""
        self._last = np.zeros(columns)

    def columns(self) -> dict[str, Array]:
        return {"integral": self._integral, "last": self._last}

    def start(self, fans: Array, value: Array) -> None:
        past = np.arange(-self.depth, 1.0)[:, np.newaxis] * value
        self._integral = np.where(fans, past, self._integral)
        self._last = np.where(fans, value, self._last)

    def update(self, values: Array) -> Array:
        before = np.vstack((self._last, values))
        growth = (before[:-1] + before[1:]) / 2
        new = np.cumsum(np.vstack((self._integral[-1:], growth)), axis=0)[1:]
        integral = np.vstack((self._integral, new))
        self._integral, self._last = integral[-(self.depth + 1) :], values[-1].copy()
        return (_ago(integral, len(values), self._end) - _ago(integral, len(values), self._begin)) / (
            self._begin - self._end
        )


class _Range(ColumnState):
    """The smallest and the largest of the last `length` samples of columns that are linear between samples."""

    def __init__(self, columns: int, length: float) -> None:
        self._length = length
        self._past = np.full((math.ceil(length) + 1, columns), np.nan)
        """NaN before the first sample"""

    def columns(self) -> dict[str, Array]:
        return {"past": self._past}

    def start(self, fans: Array, value: Array) -> None:
        self._past = np.where(fans, value, self._past)

    def update(self, values: Array) -> tuple[Array, Array]:
        self.start(np.isnan(self._past[-1]), values[0])
        both = np.vstack((self._past, values))
        oldest = _ago(both, len(values), self._length)
        rows = np.lib.stride_tricks.sliding_window_view(both, math.floor(self._length) + 1, axis=0)[-len(values) :]
        self._past = both[-len(self._past) :]
        return np.minimum(rows.min(axis=-1), oldest), np.maximum(rows.max(axis=-1), oldest)


def _ago(past_and_new: Array, count: int, samples: float) -> Array:
    """Interpolate the values `samples` before each of the last `count` rows, (count, columns)."""
    whole = math.floor(samples)
    share, end = samples - whole, len(past_and_new) - whole
    near = past_and_new[end - count : end]
    return near if share == 0.0 else near + share * (past_and_new[end - count - 1 : end - 1] - near)


def _averaging(tachos: Sequence[Tacho]) -> list[tuple[Tacho, Array]]:
    """Each different tacho that averages, with the fans that have it, (k,) of int."""
    return [
        (tacho, np.array([fan for fan, each in enumerate(tachos) if each == tacho]))
        for tacho in dict.fromkeys(tachos)
        if tacho.window_s > 0.0
    ]

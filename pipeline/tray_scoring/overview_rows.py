"""The overview of a tray: its scores, second by second.

A row is complete with the last sample of its second on the grid, whatever the blocks in which scores are made, so a
replay makes the same rows. A message has the rows of MESSAGE_NS. What is not published yet is no part of a snapshot:
it is published with it instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from operator import attrgetter

import numpy as np

from fantwin.schemas.messages import OVERVIEW_ROW_NS, Array, Overview, Score

MESSAGE_NS = 10 * OVERVIEW_ROW_NS
HELD_VALUES = 16_384
"""fan-samples of a row that wait to be added up together, since each time costs as much as some thousand of them"""
_COLUMNS = attrgetter(
    *("t_ns", "valid", "measured_speed_rad_s", "predicted_speed_rad_s", "band_variance", "score"),
)


@dataclass
class _Row:
    """The samples of one second so far, (values, fans).

    total, samples: of predicted speed, half width and residual. lowest: of the residual. highest: of it and the score.
    """

    t_ns: int
    total: Array
    samples: Array
    lowest: Array
    highest: Array

    def add(self, later: _Row) -> None:
        """Add later samples of the same second."""
        self.t_ns = later.t_ns
        self.total, self.samples = self.total + later.total, self.samples + later.samples
        self.lowest, self.highest = np.fmin(self.lowest, later.lowest), np.fmax(self.highest, later.highest)

    @property
    def values(self) -> Array:
        """Those of the columns of an Overview, in their order, (columns, fans)."""
        mean = self.total / np.where(self.samples > 0, self.samples, np.nan)
        return np.concatenate((mean, self.lowest, self.highest)).astype(np.float32)


class OverviewRows:
    """Makes the overview of one tray from its scores."""

    def __init__(self) -> None:
        self._waiting: list[tuple[Array, ...]] = []
        """_COLUMNS of scores whose samples are in no row yet"""
        self._values = self._period_ns = 0
        """fan-samples that wait; between two samples of the newest score"""
        self._complete: list[_Row] = []
        """rows of the next message"""
        self._open: _Row | None = None
        """the row to which more samples may come"""

    def add(self, score: Score) -> list[Overview]:
        """Add a block; returns the messages that it completes."""
        self._waiting.append(_COLUMNS(score))
        self._values += score.valid.size
        self._period_ns = score.period_ns
        first_t_ns, next_t_ns = self._waiting[0][0].item(0), score.t_ns.item(-1) + score.period_ns
        goes_on = next_t_ns // OVERVIEW_ROW_NS == first_t_ns // OVERVIEW_ROW_NS
        return [] if goes_on and self._values < HELD_VALUES else self._add_up()

    def so_far(self) -> list[Overview]:
        """What is not published yet, the open row included, to which more samples may still come."""
        made = self._add_up()
        rows = [*self._complete, *filter(None, [self._open])]
        self._complete = []
        return [*made, _message(rows)] if rows else made

    def _add_up(self) -> list[Overview]:
        """Add what waits to rows; returns the messages that are complete."""
        made: list[Overview] = []
        if not self._waiting:
            return made
        for row in _rows_of(self._waiting):
            if self._open and self._open.t_ns // OVERVIEW_ROW_NS != row.t_ns // OVERVIEW_ROW_NS:
                self._complete_row()  # samples are missing at its end
            if self._complete and self._complete[-1].t_ns // MESSAGE_NS != row.t_ns // MESSAGE_NS:
                made += self._completed()
            if self._open:
                self._open.add(row)
            else:
                self._open = row
            next_t_ns = row.t_ns + self._period_ns
            if next_t_ns // OVERVIEW_ROW_NS != row.t_ns // OVERVIEW_ROW_NS:
                self._complete_row()
            if next_t_ns // MESSAGE_NS != row.t_ns // MESSAGE_NS:
                made += self._completed()
        self._waiting, self._values = [], 0
        return made

    def _complete_row(self) -> None:
        self._complete += filter(None, [self._open])
        self._open = None

    def _completed(self) -> list[Overview]:
        rows, self._complete = self._complete, []
        return [_message(rows)] if rows else []


def _rows_of(blocks: list[tuple[Array, ...]]) -> list[_Row]:
    """The rows of _COLUMNS of blocks, of which the first and the last may be parts."""
    joined = blocks[0] if len(blocks) == 1 else map(np.concatenate, zip(*blocks, strict=True))
    times, valid, measured, predicted, variance, score = joined
    values = [predicted, np.sqrt(variance), measured - predicted, score]
    if not valid.all():
        values = [np.where(valid, each, np.nan) for each in values]
    seconds = times // OVERVIEW_ROW_NS
    firsts = np.flatnonzero(np.diff(seconds, prepend=seconds[0] - 1)).tolist()
    return [
        _row(int(times[end - 1]), *(each[first:end] for each in values))
        for first, end in zip(firsts, [*firsts[1:], len(times)], strict=True)
    ]


def _row(t_ns: int, predicted: Array, half_width: Array, residual: Array, score: Array) -> _Row:
    """The row of samples, (n, fans)."""
    means = predicted, half_width, residual
    total = np.array([np.add.reduce(each) for each in means])
    samples = np.full(total.shape, len(score))
    if not np.isfinite(total).all():
        known = np.isfinite(means)
        total, samples = (
            np.add.reduce(np.where(known, means, 0.0), axis=1),
            np.add.reduce(known, axis=1, dtype=np.int64),
        )
    highest = np.array([np.fmax.reduce(residual), np.fmax.reduce(score)])
    return _Row(t_ns, total, samples, np.fmin.reduce(residual)[np.newaxis], highest)


def _message(rows: list[_Row]) -> Overview:
    values = np.stack([row.values for row in rows], axis=1)
    predicted, half_width, residual, lowest, highest, score = values
    return Overview(
        fans=values.shape[2],
        t_ns=np.array([row.t_ns for row in rows], np.int64),
        predicted_speed_rad_s=predicted,
        band_half_width_rad_s=half_width,
        residual_rad_s=residual,
        lowest_residual_rad_s=lowest,
        highest_residual_rad_s=highest,
        highest_score=score,
    )

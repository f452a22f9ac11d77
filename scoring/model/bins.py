"""Bins of the predictions of one tray: all that the model sees of them.

A bin is a fixed interval of time since the epoch, so how samples are cut into messages changes nothing. Within a bin of
several samples, one far from their median is marked as wrong. It does not count unless later readings agree with it
(scoring.model.wrong_readings).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.messages import Array, Prediction
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.samples import BALANCE_COUNTS, NO_SPEED, among, reading_missing_of, reading_repeated_of
from fantwin.scoring.saved import Saved
from fantwin.scoring.unseen_error import UnseenError

SHORTEST_S = 0.1
WRONG_SHARE = 0.05
"""share of the top speed: a reading that is farther from the median of its bin is marked as wrong"""
FASTEST = 10.0
"""multiple of the top speed to which readings are clipped"""
LARGEST_COMMAND = 1e9
"""value to which commands and torque balances are clipped"""
HAIR = 1e-3
"""share of a reading by which two samples must differ to be two readings"""
RANKED_FROM = 4
"""least number of samples in a bin among which wrong ones are looked for"""
VALUES = ("measured", "predicted", "half_range", "unseen", "unseen_balance", "command", "balance")
FLAGS = ("counts", "another", "missing", "after_missing", "pair")
"""columns that are collected of samples, (n, fans) each"""
READS = (int(InvalidReason.NONE), int(InvalidReason.WARMING_UP), NO_SPEED)
"""states in which a tacho should give readings"""


@dataclass(frozen=True, eq=False)
class Bin:
    """Bin of the fans of a tray. All (fans,) but where it says so. t_ns: of its end."""

    t_ns: int
    row: int
    """row of the sample with which it ended, in its block"""
    judged: Array
    """true where a reading or a torque balance is compared with the twin"""
    deviations_rad_s: Array
    """(n, fans) distance of each reading from the free run; NaN where it cannot be compared"""
    balances_command: Array
    """(n, fans) torque balance of each sample, or NaN"""
    wrong: Array
    """(n, fans) readings far from the others of the bin"""
    half_ranges_rad_s: Array
    """(n, fans) half of the range of readings that the tacho may show of the predicted speed"""
    readings: Array
    """number of readings that can be compared with the free run"""
    deviation_rad_s: Array
    """their mean distance from it"""
    predicted_rad_s: Array
    """mean of the free run, or of the readings without one; NaN where neither is known"""
    measured_rad_s: Array
    """mean of the readings; NaN without one"""
    newest_rad_s: Array
    """the newest reading; NaN without one"""
    another: Array
    """(n, fans) true where a reading is another than the one before"""
    balances: Array
    """number of samples with a torque balance"""
    balance_command: Array
    """their mean"""
    half_range_rad_s: Array
    """half of the range of readings that the tacho may show of the predicted speed"""
    unseen_rad_s: Array
    """standard deviation of the twin's error where it was not trained"""
    unseen_balance_command: Array
    """standard deviation of the error of the torque balance there"""
    command: Array
    missing: Array
    """(fans, 4) readings after a reading, and those of them that are missing; after a missing one, and missing"""


class Bins(Saved):
    """Collects the samples of one tray."""

    KEPT = ("_open_t_ns", "_open", "_before", "_newest_rad_s")

    def __init__(self, bin_ns: int, top_rad_s: Array, reads_balance: Array, unseen: UnseenError | None) -> None:
        """Begin without a sample. top_rad_s: (fans,); reads_balance: (fans,) as in `Fans`."""
        self._bin_ns, self._top, self._reads_balance, self._unseen = bin_ns, top_rad_s, reads_balance, unseen
        self._open_t_ns = 0
        """beginning of the open bin"""
        self._open = self._unknown(0)
        """its samples, (n, fans) each"""
        self.unseen_rad_s: Array | float = 0.0
        """(n, fans) error of the twin where it was not trained, in the samples of the last block"""
        self._before = np.zeros((2, len(top_rad_s)), np.bool_)
        """(2, fans) state of the newest sample: the reading was missing, and there should have been one"""
        self._newest_rad_s = np.full(len(top_rad_s), np.nan)
        """(fans,) newest reading; NaN: there was none"""

    def take(self, block: Prediction) -> Iterator[Bin]:
        """The bins that end with a sample of a block, or before it."""
        columns, begins_ns = self._columns(block), block.t_ns // self._bin_ns * self._bin_ns
        for rows in np.split(np.arange(len(begins_ns)), np.flatnonzero(np.diff(begins_ns)) + 1):
            begin_ns = int(begins_ns[rows[0]])
            if len(self._open["measured"]) and begin_ns != self._open_t_ns:
                yield self._close(int(rows[0]))
            self._open_t_ns = begin_ns
            self._open = {name: np.concatenate((self._open[name], column[rows])) for name, column in columns.items()}
            if int(block.t_ns[rows[-1]]) + block.period_ns >= begin_ns + self._bin_ns:
                yield self._close(int(rows[-1]))

    def restore(self, stored: Mapping[str, Array]) -> None:
        """See Saved."""
        measured = stored["_open.measured"]
        self._open = self._unknown(len(measured) if measured.size else 0)
        super().restore(stored)

    def _unknown(self, rows: int) -> dict[str, Array]:
        """Columns of samples of which nothing is known."""
        shape = (rows, len(self._top))
        return {name: np.full(shape, np.nan) for name in VALUES} | {name: np.zeros(shape, np.bool_) for name in FLAGS}

    def _columns(self, block: Prediction) -> dict[str, Array]:
        fastest, reason = FASTEST * self._top, block.invalid_reason
        measured = block.measured_speed_rad_s.clip(-fastest, fastest)
        predicted = block.predicted_speed_rad_s.clip(-fastest, fastest)
        nothing = np.zeros(measured.shape)
        missing = reading_missing_of(block) | (reason == NO_SPEED)
        is_repeated, reads = reading_repeated_of(block), among(reason, *READS)
        before = np.concatenate((self._before[:, np.newaxis], np.stack((missing, reads))), axis=1)[:, :-1]
        self._before = np.stack((missing[-1], reads[-1]))
        unseen, unseen_balance = map(np.nan_to_num, self._unseen.of(block)) if self._unseen else (nothing, nothing)
        self.unseen_rad_s = unseen
        return {
            "measured": measured,
            "predicted": predicted,
            "half_range": np.nan_to_num(block.reading_range_rad_s if len(block.reading_range_rad_s) else nothing).clip(
                0.0, fastest
            ),
            "unseen": unseen,
            "unseen_balance": unseen_balance,
            "command": np.nan_to_num(block.command).clip(-LARGEST_COMMAND, LARGEST_COMMAND),
            "balance": np.where(
                among(reason, *BALANCE_COUNTS) & self._reads_balance,
                block.torque_balance_command.clip(-LARGEST_COMMAND, LARGEST_COMMAND),
                np.nan,
            ),
            "counts": block.valid & np.isfinite(measured) & np.isfinite(predicted) & ~(missing | is_repeated),
            "another": self._another(measured),
            "missing": missing,
            "after_missing": before[0],
            "pair": reads & before[1] & ~is_repeated,
        }

    def _another(self, measured: Array) -> Array:
        """Return where each reading, NaN where there is none, is another than the one before, (n, fans)."""
        known, readings = np.isfinite(measured), np.concatenate((self._newest_rad_s[np.newaxis], measured))
        rows = np.where(known, np.arange(1, len(readings))[:, np.newaxis], 0)
        newest = np.take_along_axis(readings, np.maximum.accumulate(rows, axis=0), axis=0)
        before, self._newest_rad_s = np.concatenate((readings[:1], newest[:-1])), newest[-1]
        return known & differ(before, measured)

    def _close(self, row: int) -> Bin:
        rows, self._open = self._open, self._unknown(0)
        deviation = np.where(rows["counts"], rows["measured"] - rows["predicted"], np.nan)
        wrong = self._wrong(deviation, rows["half_range"])
        counts = rows["counts"] & ~wrong
        measured, predicted = np.isfinite(rows["measured"]), np.isfinite(rows["predicted"])
        has_balance = np.isfinite(rows["balance"]) & measured & ~wrong
        speed = np.where(measured.any(axis=0), mean(rows["measured"], measured), np.nan)
        pair, after, missing = rows["pair"], rows["after_missing"], rows["missing"]
        transitions = (pair & ~after, pair & ~after & missing, pair & after, pair & after & missing)
        return Bin(
            t_ns=self._open_t_ns + self._bin_ns,
            row=row,
            judged=np.asarray((rows["counts"] | has_balance).any(axis=0)),
            deviations_rad_s=deviation,
            balances_command=np.where(measured, rows["balance"], np.nan),
            wrong=wrong,
            half_ranges_rad_s=rows["half_range"],
            readings=counts.sum(axis=0),
            deviation_rad_s=mean(deviation, counts),
            predicted_rad_s=np.where(predicted.any(axis=0), mean(rows["predicted"], predicted), speed),
            measured_rad_s=speed,
            newest_rad_s=newest(rows["measured"], measured),
            another=rows["another"],
            balances=has_balance.sum(axis=0),
            balance_command=mean(rows["balance"], has_balance),
            half_range_rad_s=mean(rows["half_range"], counts),
            unseen_rad_s=mean(rows["unseen"], counts),
            unseen_balance_command=mean(rows["unseen_balance"], has_balance),
            command=rows["command"].mean(axis=0),
            missing=np.stack([each.sum(axis=0) for each in transitions], axis=1),
        )

    def _wrong(self, deviation: Array, half_range: Array) -> Array:
        """Find readings far from the others of a bin, where these are more, (n, fans)."""
        if len(deviation) < RANKED_FROM:
            return np.zeros(deviation.shape, np.bool_)
        count = np.isfinite(deviation).sum(axis=0)
        middle = np.take_along_axis(np.sort(deviation, axis=0), np.maximum(count - 1, 0)[np.newaxis] // 2, axis=0)
        with np.errstate(invalid="ignore"):
            wrong = np.abs(deviation - middle) > WRONG_SHARE * self._top + half_range
        found: Array = wrong & (3 * wrong.sum(axis=0) <= np.maximum(count, 3))
        return found


def mean(values: Array, counts: Array) -> Array:
    """Mean of those values that count, (n, fans), as (fans,); 0 where none does."""
    total: Array = np.where(counts, values, 0.0).sum(axis=0)
    return total / np.maximum(counts.sum(axis=0), 1)


def differ(before_rad_s: Array, newest_rad_s: Array) -> Array:
    """Return where a tacho has not repeated its reading; not where one of them is missing (NaN)."""
    found: Array = np.abs(newest_rad_s - before_rad_s) > HAIR * np.maximum(np.abs(newest_rad_s), np.abs(before_rad_s))
    return found


def newest(values: Array, counts: Array) -> Array:
    """Last of those values that count, (n, fans), as (fans,); NaN where none does."""
    last = len(values) - 1 - counts[::-1].argmax(axis=0)
    found: Array = np.where(counts.any(axis=0), values[last, np.arange(values.shape[1])], np.nan)
    return found


def bin_ns_of(period_ns: int, held_s: float) -> int:
    """Length of a bin: SHORTEST_S, or as long as a tacho holds a reading, in whole samples."""
    return max(1, round(max(SHORTEST_S, held_s) * NS_PER_S / period_ns)) * period_ns

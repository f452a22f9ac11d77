"""Fans that stand or turn against their command. Their alarm stays until they have done as commanded for a while."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fantwin.schemas.messages import Array, Prediction
from fantwin.schemas.standstill import Standstill
from fantwin.schemas.tacho import Tacho
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.as_commanded import runs_on, stands_still
from fantwin.scoring.as_commanded.runs_on import RunsOn
from fantwin.scoring.as_commanded.stands_still import StandsStill
from fantwin.scoring.as_commanded.time_limits import Durations
from fantwin.scoring.column_state import NEVER_NS
from fantwin.scoring.diagnosis.standstill_causes import Standing
from fantwin.scoring.samples import arrived
from fantwin.scoring.saved import Saved

CERTAIN = 2.0
"""score of a fan that does not do as commanded"""
OBEYS_S = 2.0
"""time for which a fan does as commanded until its alarm is over"""
KINDS = (None, *Standing)


class AgainstCommand(Saved):
    """Check of each fan of a tray against its command. Samples that show neither obeying nor disobeying change
    nothing."""

    KEPT = ("_arrived_t_ns", "_obeyed_ns", "_is_against", "_stands", "_runs")

    def __init__(self, healthy: Standstill, tachos: Sequence[Tacho]) -> None:
        """Begin without knowledge of the fans. tachos: of each fan."""
        self._stands, self._runs = StandsStill(healthy, tachos), RunsOn(healthy, tachos)
        count = len(tachos)
        self._arrived_t_ns = np.full(count, NEVER_NS, np.int64)
        self._obeyed_ns = np.zeros((2, count), np.int64)
        """(2, fans) time for which each has obeyed a command to turn, and one to stop, since it did not"""
        self._is_against = np.zeros((2, count), np.bool_)
        self.active = np.zeros((0, count), np.bool_)
        """(n, fans) true where a fan acts against its command, in the samples of the last block"""
        self.score = np.zeros((0, count))
        """(n, fans) longest time against a command, in multiples of what is healthy; CERTAIN above 1"""
        self.kind = np.zeros((0, count), np.int64)
        """(n, fans) number in KINDS, 0 where a fan does as commanded"""

    def take(self, block: Prediction) -> None:
        """Judge a block of samples."""
        is_here, speed = arrived(block.invalid_reason), block.measured_speed_rad_s
        n = len(block.t_ns)
        self.active, self.score = np.zeros(speed.shape, np.bool_), np.zeros(speed.shape)
        self.kind = np.zeros(speed.shape, np.int64)
        is_ahead = self._arrived_t_ns > block.t_ns[0]  # of a clock that was set back since: how long ago is not known
        if is_ahead.any():
            self._arrived_t_ns[is_ahead] = NEVER_NS
            self._stands.forget(is_ahead)
            self._runs.forget(is_ahead)
        missed_ns = self._missed_ns(block.t_ns, block.period_ns, is_here)
        ends = [*np.flatnonzero((missed_ns > 0).any(axis=1)).tolist(), n]
        begin = 0
        for end in ends:
            if end > begin:
                rows = slice(begin, end)
                self._judge(rows, block.command[rows], speed[rows], Durations(is_here[rows], block.period_ns))
            if end < n:
                self._stands.forget(missed_ns[end] > self._stands.memory_s * NS_PER_S)
                self._runs.forget(missed_ns[end] > 0)  # the fan may have been started and stopped within it
            begin = end

    def forget(self, fans: Array) -> None:
        """Begin again for some fans, (fans,) of bool."""
        self._stands.forget(fans)
        self._runs.forget(fans)
        self._is_against[:, fans] = False

    def _judge(self, rows: slice, command: Array, speed: Array, counts: Durations) -> None:
        kinds = (stands_still.KINDS, runs_on.KINDS)
        for number, each in enumerate((self._stands, self._runs)):
            ratio, obeys, kind = each.update(command, speed, counts)
            against = ratio > 1.0
            was = self._is_against[number].copy()
            obeyed_ns = counts.of(obeys & ~against, against, self._obeyed_ns[number])
            has_been = np.logical_or.accumulate(against, axis=0) | was
            active = has_been & (obeyed_ns < OBEYS_S * NS_PER_S)
            self._is_against[number] = active[-1]
            of_kind = np.array([KINDS.index(standing) for standing in kinds[number]])[kind]
            self.kind[rows] = np.where(against, of_kind, self.kind[rows])
            self.active[rows] |= active
            self.score[rows] = np.maximum(self.score[rows], np.where(against, CERTAIN, ratio))

    def _missed_ns(self, t_ns: Array, period_ns: int, is_here: Array) -> Array:
        """Time (n, fans) without samples before a sample that arrived; 0 where nothing was missed."""
        seen = np.where(is_here, t_ns[:, np.newaxis], NEVER_NS)
        latest = np.maximum.accumulate(np.vstack((self._arrived_t_ns, seen)), axis=0)
        self._arrived_t_ns = latest[-1]
        missed = t_ns[:, np.newaxis] - latest[:-1] - period_ns
        return np.where(is_here & (latest[:-1] != NEVER_NS), missed, 0).clip(0)

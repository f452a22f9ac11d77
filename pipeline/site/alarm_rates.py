"""The observed rate of alarms: for how long fans were judged, which alarms were raised then, and what operators said of
them.

The rate is kept in the file of the history of alarms, and goes on after a restart.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import astuple, dataclass, replace

import numpy as np

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.site.alarm_history import AlarmHistory
from fantwin.schemas.enums import Feedback, Transition
from fantwin.schemas.messages import Alarm, Score
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_state import GIVES_FEEDBACK
from fantwin.scoring.calibration.calibration import ObservedRate

LONGEST_STEP_NS = 5 * NS_PER_S
"""between two scores of a stretch; after a longer pause another one begins"""
LONGEST_PERIODS = 3
"""and so long where samples come more slowly than that"""
SAVED_EVERY_NS = 10 * NS_PER_S
LEARNED = "learned"
"""names the twins of a tray that learns them: each version continues the time of the one before"""


@dataclass(frozen=True)
class JudgedStretch:
    """A time in which the fans of a tray were judged by one twin, or by learned ones.

    Attributes:
        fan_ns: judged time, summed over fans.
        declared_per_day: false alarms per fan and day that the twin declares; None: none.
    """

    tray: str
    twin: str
    first_t_ns: int
    last_t_ns: int
    fan_ns: int
    declared_per_day: float | None = None


class JudgedTime:
    """The stretch of each tray that is growing.

    Of a large site some scores of each tray are decoded, and not every one; so a score stands for the time since the
    one before.
    """

    def __init__(self) -> None:
        self._growing: dict[str, JudgedStretch] = {}
        self._saved_t_ns: dict[str, int] = {}

    def add(self, score: Score, twin: str, declared_per_day: float | None) -> list[JudgedStretch]:
        """A score of a tray has come. twin, declared_per_day: as in JudgedStretch. Returns what is to be kept now."""
        tray, t_ns = score.header.tray, int(score.t_ns[-1])
        before = self._growing.get(tray)
        step_ns = t_ns - before.last_t_ns if before else -1
        longest_ns = max(LONGEST_STEP_NS, LONGEST_PERIODS * score.period_ns)
        if before is None or before.twin != twin or not 0 <= step_ns <= longest_ns:
            self._growing[tray] = JudgedStretch(tray, twin, t_ns, t_ns, 0, declared_per_day)
            self._saved_t_ns[tray] = t_ns
            return [before] if before else []
        fan_ns = before.fan_ns + step_ns * int(np.count_nonzero(score.valid[-1]))
        self._growing[tray] = replace(before, last_t_ns=t_ns, fan_ns=fan_ns)
        if t_ns - self._saved_t_ns[tray] < SAVED_EVERY_NS:
            return []
        self._saved_t_ns[tray] = t_ns
        return [self._growing[tray]]

    def growing(self) -> list[JudgedStretch]:
        """Those that are not over."""
        return list(self._growing.values())


MOST_KEPT = 200_000
"""alarms, and stretches of judged time; those that are older are deleted"""
NS_PER_HOUR = 3600 * NS_PER_S
_GIVEN = dict(GIVES_FEEDBACK.values())
_AT_ONCE = 1000
_READER = "rates"
_GROW = """
INSERT INTO judged (tray, twin, first_t_ns, last_t_ns, fan_ns, declared_per_day) VALUES (?, ?, ?, ?, ?, ?)
ON CONFLICT DO UPDATE SET
    twin = excluded.twin,
    last_t_ns = excluded.last_t_ns,
    fan_ns = excluded.fan_ns,
    declared_per_day = excluded.declared_per_day
"""
"""keeps the rowid, by which the oldest ones are deleted"""
_COUNT_WHILE_JUDGED = """
SELECT feedback, COUNT(*) FROM alarm WHERE tray = :tray AND :twin = (
    SELECT CASE WHEN last_t_ns >= raised_t_ns THEN twin END FROM judged
    WHERE judged.tray = :tray AND first_t_ns <= raised_t_ns ORDER BY first_t_ns DESC LIMIT 1
) GROUP BY feedback
"""
"""by the last stretch that had begun, which the key finds: 200,000 alarms and as many stretches are a second"""


class AlarmRates:
    """Rates of alarms, from the file of a history. Not thread-safe."""

    def __init__(self, history: AlarmHistory) -> None:
        self._history, self._store = history, history.store
        self.problem = ""
        """why the last ones could not be kept; empty if they were"""

    def catch_up(self, stretches: Sequence[JudgedStretch]) -> None:
        """Take what has come to the history, and when fans were judged; a stretch that has grown replaces itself. What
        the disk has no room for is taken the next time."""
        try:
            position, is_behind = self._history.position(_READER) or 0, True
            while is_behind:
                new = self._history.after(position, _AT_ONCE)
                is_behind = len(new) == _AT_ONCE
                position = new[-1][0] if new else position
                if new or stretches:
                    self._keep([alarm for _, alarm in new], stretches, position)
                stretches = ()
        except (sqlite3.Error, UserError) as error:
            self.problem = f"{self._store.path}: {error}: the rate of false alarms does not go on"
            return
        self.problem = ""

    def observed(self) -> dict[str, ObservedRate]:
        """Of each tray, since its twin of now began to judge it.

        Raises:
            UserError: the file cannot be read.
        """
        newest = self._store.read(
            "SELECT tray, twin, declared_per_day, MAX(last_t_ns) FROM judged GROUP BY tray ORDER BY tray"
        )
        return {tray: self._observed(tray, twin, declared) for tray, twin, declared, _ in newest}

    def feedback(self, tray: str, fan: int, onset_t_ns: int) -> Feedback:
        """What operators said of an alarm.

        Raises:
            UserError: the file cannot be read.
        """
        query = "SELECT feedback FROM alarm WHERE tray = ? AND fan = ? AND onset_t_ns = ?"
        rows = self._store.read(query, (tray, fan, onset_t_ns))
        return Feedback.known(rows[0][0]) if rows else Feedback.NONE

    def _observed(self, tray: str, twin: str, declared_per_day: float | None) -> ObservedRate:
        query = "SELECT MIN(first_t_ns), SUM(fan_ns) FROM judged WHERE tray = ? AND twin = ?"
        ((since_t_ns, fan_ns),) = self._store.read(query, (tray, twin))
        rows = self._store.read(_COUNT_WHILE_JUDGED, {"tray": tray, "twin": twin})
        counts = {Feedback.known(feedback): count for feedback, count in rows}
        return ObservedRate(
            since_t_ns=since_t_ns,
            fan_hours=fan_ns / NS_PER_HOUR,
            false_alarms=counts.get(Feedback.FALSE_ALARM, 0),
            true_alarms=counts.get(Feedback.TRUE_ALARM, 0),
            unmarked=counts.get(Feedback.NONE, 0),
            declared_per_day=declared_per_day,
        )

    def _keep(self, alarms: Sequence[Alarm], stretches: Sequence[JudgedStretch], position: int) -> None:
        with self._store.transaction():
            for alarm in alarms:
                self._add(alarm)
            self._store.write_many(_GROW, list(map(astuple, stretches)))
            for table in ("alarm", "judged"):
                oldest = f"SELECT MAX(rowid) FROM {table}"
                self._store.write(f"DELETE FROM {table} WHERE rowid <= ({oldest}) - {MOST_KEPT}")
            self._history.set_position(_READER, position)

    def _add(self, alarm: Alarm) -> None:
        """Messages may come in any order: after a restart, those of the bus do."""
        fan = (alarm.header.tray, alarm.fan)
        if alarm.transition == Transition.RAISED:
            self._store.write(
                "INSERT INTO alarm (tray, fan, onset_t_ns, raised_t_ns) VALUES (?, ?, ?, ?)"
                " ON CONFLICT DO UPDATE SET raised_t_ns = excluded.raised_t_ns",
                (*fan, alarm.onset_t_ns, alarm.t_ns),
            )
        if feedback := _GIVEN.get(alarm.transition):
            self._store.write(
                "INSERT INTO alarm (tray, fan, onset_t_ns, feedback, marked_t_ns) VALUES (?, ?, ?, ?, ?)"
                " ON CONFLICT DO UPDATE SET feedback = excluded.feedback, marked_t_ns = excluded.marked_t_ns"
                " WHERE excluded.marked_t_ns >= alarm.marked_t_ns",
                (*fan, alarm.marked_onset_t_ns, int(feedback), alarm.t_ns),
            )

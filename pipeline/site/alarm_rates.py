"""Which alarms were raised while fans were judged, and what operators said of them: the rate that really was.

In the file of the history of alarms, beside its transitions, so that it goes on after a restart.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import astuple
from pathlib import Path

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.site.alarm_store import AlarmStore
from fantwin.pipeline.site.judged_time import JudgedStretch
from fantwin.schemas.enums import Feedback, Transition
from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.fan_condition import GIVES_FEEDBACK
from fantwin.scoring.calibration.observed_rate import ObservedRate

MOST_KEPT = 200_000
"""alarms, and stretches of judged time; those that are older are deleted"""
NS_PER_HOUR = 3600 * NS_PER_S
_GIVEN = dict(GIVES_FEEDBACK.values())
_AT_ONCE = 1000
_READER = "rates"
_SCHEMA = """
CREATE TABLE IF NOT EXISTS alarm (
    tray TEXT NOT NULL,
    fan INTEGER NOT NULL,
    onset_t_ns INTEGER NOT NULL,
    raised_t_ns INTEGER NOT NULL DEFAULT 0,
    feedback INTEGER NOT NULL DEFAULT 0,
    marked_t_ns INTEGER NOT NULL DEFAULT 0,
    PRIMARY KEY (tray, fan, onset_t_ns)
);
CREATE TABLE IF NOT EXISTS judged (
    tray TEXT NOT NULL,
    twin TEXT NOT NULL,
    first_t_ns INTEGER NOT NULL,
    last_t_ns INTEGER NOT NULL,
    fan_ns INTEGER NOT NULL,
    declared_per_day REAL,
    PRIMARY KEY (tray, first_t_ns)
);
"""
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
    """Not thread-safe, like the store."""

    def __init__(self, path: Path, *, read_only: bool = False) -> None:
        """path: of the store, which exists. read_only: of another process.

        Raises:
            UserError: it cannot be read or written.
        """
        self._path = path
        self.problem = ""
        """why the last ones could not be kept; empty if they were"""
        try:
            if read_only:
                self._file = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
                self._file.execute("SELECT 1 FROM alarm, judged LIMIT 1")
            else:
                self._file = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
                self._file.executescript(f"PRAGMA journal_mode = WAL; PRAGMA synchronous = NORMAL; {_SCHEMA}")
        except sqlite3.Error as error:
            raise UserError(f"{path}: it has no rates of alarms: {error}") from error

    def catch_up(self, store: AlarmStore, stretches: Sequence[JudgedStretch]) -> None:
        """Take what has come to the store, and when fans were judged; a stretch that has grown replaces itself. What
        the disk has no room for is taken the next time."""
        try:
            position, is_behind = store.position(_READER), True
            while is_behind:
                new = store.after(position, _AT_ONCE)
                self._keep([alarm for _, alarm in new], stretches)
                is_behind, stretches = len(new) == _AT_ONCE, ()
                if new:
                    position = new[-1][0]
                    store.set_position(_READER, position)  # not kept: they are taken again, and nothing changes
        except (sqlite3.Error, UserError) as error:
            if self._file.in_transaction:
                self._file.execute("ROLLBACK")
            self.problem = f"{self._path}: {error}: the rate of false alarms does not go on"
            return
        self.problem = ""

    def observed(self) -> dict[str, ObservedRate]:
        """Of each tray, since its twin of now began to judge it.

        Raises:
            UserError: the file cannot be read.
        """
        try:
            newest = self._file.execute(
                "SELECT tray, twin, declared_per_day, MAX(last_t_ns) FROM judged GROUP BY tray ORDER BY tray"
            ).fetchall()
            return {tray: self._observed(tray, twin, declared) for tray, twin, declared, _ in newest}
        except sqlite3.Error as error:
            raise UserError(f"{self._path}: the rate of alarms cannot be read: {error}") from error

    def feedback(self, tray: str, fan: int, onset_t_ns: int) -> Feedback:
        """What operators said of an alarm.

        Raises:
            UserError: the file cannot be read.
        """
        try:
            row = self._file.execute(
                "SELECT feedback FROM alarm WHERE tray = ? AND fan = ? AND onset_t_ns = ?", (tray, fan, onset_t_ns)
            ).fetchone()
        except sqlite3.Error as error:
            raise UserError(f"{self._path}: feedback on alarms cannot be read: {error}") from error
        return Feedback.known(row[0]) if row else Feedback.NONE

    def close(self) -> None:
        """Leave a complete file."""
        self._file.close()

    def _observed(self, tray: str, twin: str, declared_per_day: float | None) -> ObservedRate:
        since_t_ns, fan_ns = self._file.execute(
            "SELECT MIN(first_t_ns), SUM(fan_ns) FROM judged WHERE tray = ? AND twin = ?", (tray, twin)
        ).fetchone()
        rows = self._file.execute(_COUNT_WHILE_JUDGED, {"tray": tray, "twin": twin})
        counts = {Feedback.known(feedback): count for feedback, count in rows}
        return ObservedRate(
            since_t_ns=since_t_ns,
            fan_hours=fan_ns / NS_PER_HOUR,
            false_alarms=counts.get(Feedback.FALSE_ALARM, 0),
            true_alarms=counts.get(Feedback.TRUE_ALARM, 0),
            unmarked=counts.get(Feedback.NONE, 0),
            declared_per_day=declared_per_day,
        )

    def _keep(self, alarms: Sequence[Alarm], stretches: Sequence[JudgedStretch]) -> None:
        self._file.execute("BEGIN")
        for alarm in alarms:
            self._add(alarm)
        self._file.executemany(_GROW, map(astuple, stretches))
        for table in ("alarm", "judged"):
            self._file.execute(f"DELETE FROM {table} WHERE rowid <= (SELECT MAX(rowid) FROM {table}) - {MOST_KEPT}")
        self._file.execute("COMMIT")

    def _add(self, alarm: Alarm) -> None:
        """Messages may come in any order: after a restart, those of the bus do."""
        fan = (alarm.header.tray, alarm.fan)
        if alarm.transition == Transition.RAISED:
            self._file.execute(
                "INSERT INTO alarm (tray, fan, onset_t_ns, raised_t_ns) VALUES (?, ?, ?, ?)"
                " ON CONFLICT DO UPDATE SET raised_t_ns = excluded.raised_t_ns",
                (*fan, alarm.onset_t_ns, alarm.t_ns),
            )
        if feedback := _GIVEN.get(alarm.transition):
            self._file.execute(
                "INSERT INTO alarm (tray, fan, onset_t_ns, feedback, marked_t_ns) VALUES (?, ?, ?, ?, ?)"
                " ON CONFLICT DO UPDATE SET feedback = excluded.feedback, marked_t_ns = excluded.marked_t_ns"
                " WHERE excluded.marked_t_ns >= alarm.marked_t_ns",
                (*fan, alarm.marked_onset_t_ns, int(feedback), alarm.t_ns),
            )

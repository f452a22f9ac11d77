"""The history of alarms: each transition that was heard, in a file that survives a restart of the gateway; and, beside
them, each alarm with what operators said of it, and when fans were judged.

The bus keeps the last transitions too, and a gateway that starts asks for them: each is kept once.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from dataclasses import astuple, dataclass
from pathlib import Path

from pipeline.errors import UserError
from schemas.codec import CodecError, decode, encode
from schemas.enums import Feedback, Transition
from schemas.messages import Alarm
from schemas.units import NS_PER_S
from scoring.alarms.fan_condition import GIVES_FEEDBACK
from scoring.calibration.observed_rate import ObservedRate

HISTORY = "alarms.sqlite"
"""the file of the gateway, in the run folder"""
MOST_TRANSITIONS = 200_000
"""those that are older are deleted"""
MOST_JUDGED = 100_000
"""stretches of judged time; the same"""
_DELETED_EVERY = 1000

_SCHEMA = """
CREATE TABLE IF NOT EXISTS transition (
    number INTEGER PRIMARY KEY,
    tray TEXT NOT NULL,
    fan INTEGER NOT NULL,
    t_ns INTEGER NOT NULL,
    producer TEXT NOT NULL,
    sequence INTEGER NOT NULL,
    alarm BLOB NOT NULL,
    UNIQUE (producer, tray, sequence)
);
CREATE INDEX IF NOT EXISTS of_fan ON transition (tray, fan, number);
CREATE TABLE IF NOT EXISTS reader (name TEXT PRIMARY KEY, number INTEGER NOT NULL);
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
NS_PER_HOUR = 3600 * NS_PER_S
_GIVEN = dict(GIVES_FEEDBACK.values())


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


class AlarmStore:
    """Not thread-safe: whoever shares it locks it."""

    def __init__(self, path: Path, *, read_only: bool = False) -> None:
        """Open the file, or make it. read_only: of another process.

        Raises:
            UserError: it cannot be read or written.
        """
        self._path = path
        self._added = 0
        self.problem = ""
        """why the last transition could not be kept; empty if it was"""
        try:
            if read_only:
                self._file = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
                self._file.execute("SELECT 1 FROM alarm, judged LIMIT 1")
                return
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
            self._file.executescript(f"PRAGMA journal_mode = WAL; PRAGMA synchronous = NORMAL; {_SCHEMA}")
        except (OSError, sqlite3.Error) as error:
            what = "no history of alarms of this version" if read_only else "the history of alarms cannot be kept there"
            raise UserError(f"{path}: {what}: {error}") from error

    def add(self, alarm: Alarm) -> bool:
        """Keep a transition; returns whether it is new. A full disk is a problem and no loss of what was kept."""
        row = (alarm.header.tray, alarm.fan, alarm.t_ns, alarm.header.producer, alarm.header.sequence, encode(alarm))
        try:
            done = self._file.execute(
                "INSERT OR IGNORE INTO transition (tray, fan, t_ns, producer, sequence, alarm)"
                " VALUES (?, ?, ?, ?, ?, ?)",
                row,
            )
            self._added += done.rowcount
            if done.rowcount:
                self._note_alarm(alarm)
            if self._added >= _DELETED_EVERY:
                self._added = 0
                self._file.execute(
                    "DELETE FROM transition WHERE number <= (SELECT MAX(number) FROM transition) - ?",
                    (MOST_TRANSITIONS,),
                )
                self._file.execute(
                    "DELETE FROM judged WHERE rowid <= (SELECT MAX(rowid) FROM judged) - ?", (MOST_JUDGED,)
                )
        except sqlite3.Error as error:
            self.problem = f"{self._path}: {error}: this alarm is not kept in the history"
            return True
        self.problem = ""
        return done.rowcount > 0

    def newest(self, most: int, *, tray: str = "", fan: int = -1, before: int = 0) -> Sequence[tuple[int, Alarm]]:
        """The last transitions, newest first, each with its number, by which the next page is asked for.

        tray, fan: of these only. before: only those with a lower number; 0: all.
        """
        rows = self._file.execute(
            "SELECT number, alarm FROM transition WHERE (?1 = '' OR tray = ?1) AND (?2 < 0 OR fan = ?2)"
            " AND (?3 = 0 OR number < ?3) ORDER BY number DESC LIMIT ?4",
            (tray, fan, before, most),
        )
        return [(number, alarm) for number, data in rows if (alarm := _decoded(data)) is not None]

    def after(self, number: int, most: int) -> Sequence[tuple[int, Alarm]]:
        """The transitions that came after one, oldest first, each with its number."""
        rows = self._file.execute(
            "SELECT number, alarm FROM transition WHERE number > ? ORDER BY number LIMIT ?", (number, most)
        )
        return [(number, alarm) for number, data in rows if (alarm := _decoded(data)) is not None]

    def newest_number(self) -> int:
        """The number of the last transition; 0: there is none."""
        (number,) = self._file.execute("SELECT MAX(number) FROM transition").fetchone()
        return number or 0

    def position(self, reader: str) -> int:
        """The number of the transition up to which a reader has come; 0: it has not begun."""
        row = self._file.execute("SELECT number FROM reader WHERE name = ?", (reader,)).fetchone()
        return row[0] if row else 0

    def set_position(self, reader: str, number: int) -> None:
        """A reader has come up to a transition."""
        try:
            self._file.execute("INSERT OR REPLACE INTO reader (name, number) VALUES (?, ?)", (reader, number))
        except sqlite3.Error as error:
            self.problem = f"{self._path}: {error}: after a restart, transitions will be sent twice"

    def add_judged(self, stretches: Sequence[JudgedStretch]) -> None:
        """Keep when fans were judged; a stretch that has grown replaces itself."""
        rows = list(map(astuple, stretches))
        try:
            self._file.execute("BEGIN")
            self._file.executemany("INSERT OR REPLACE INTO judged VALUES (?, ?, ?, ?, ?, ?)", rows)
            self._file.execute("COMMIT")
        except sqlite3.Error as error:
            if self._file.in_transaction:
                self._file.execute("ROLLBACK")
            self.problem = f"{self._path}: {error}: how long fans were judged is not kept"

    def observed_rates(self) -> dict[str, ObservedRate]:
        """Of each tray, since its twin of now began to judge it: the alarms raised while fans were judged."""
        newest = self._file.execute(
            "SELECT tray, twin, declared_per_day, MAX(last_t_ns) FROM judged GROUP BY tray ORDER BY tray"
        ).fetchall()
        return {tray: self._observed_rate(tray, twin, declared) for tray, twin, declared, _ in newest}

    def _observed_rate(self, tray: str, twin: str, declared_per_day: float | None) -> ObservedRate:
        since_t_ns, fan_ns = self._file.execute(
            "SELECT MIN(first_t_ns), SUM(fan_ns) FROM judged WHERE tray = ? AND twin = ?", (tray, twin)
        ).fetchone()
        rows = self._file.execute(
            "SELECT feedback, COUNT(*) FROM alarm WHERE tray = ?1 AND EXISTS (SELECT 1 FROM judged WHERE"
            " judged.tray = ?1 AND twin = ?2 AND raised_t_ns BETWEEN first_t_ns AND last_t_ns) GROUP BY feedback",
            (tray, twin),
        )
        counts = {Feedback.known(feedback): count for feedback, count in rows}
        return ObservedRate(
            since_t_ns=since_t_ns,
            fan_hours=fan_ns / NS_PER_HOUR,
            false_alarms=counts.get(Feedback.FALSE_ALARM, 0),
            true_alarms=counts.get(Feedback.TRUE_ALARM, 0),
            unmarked=counts.get(Feedback.NONE, 0),
            declared_per_day=declared_per_day,
        )

    def feedback(self, tray: str, fan: int, onset_t_ns: int) -> Feedback:
        """What operators said of an alarm."""
        row = self._file.execute(
            "SELECT feedback FROM alarm WHERE tray = ? AND fan = ? AND onset_t_ns = ?", (tray, fan, onset_t_ns)
        ).fetchone()
        return Feedback.known(row[0]) if row else Feedback.NONE

    def _note_alarm(self, alarm: Alarm) -> None:
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

    def close(self) -> None:
        """Leave a complete file."""
        self._file.close()


def _decoded(data: bytes) -> Alarm | None:
    try:
        alarm = decode(Alarm, data)
    except CodecError:
        return None
    return alarm if isinstance(alarm, Alarm) else None

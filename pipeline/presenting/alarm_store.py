"""The history of alarms: each transition that was heard, in a file that survives a restart of the gateway.

The bus keeps the last transitions too, and a gateway that starts asks for them: each is kept once. Those of before its
first start may be in recordings: they get numbers below 0, so that the order by number is that of time.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from pathlib import Path

from pipeline.errors import UserError
from schemas.codec import CodecError, decode, encode
from schemas.messages import Alarm

MOST_TRANSITIONS = 200_000
"""those that are older are deleted"""
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
CREATE TABLE IF NOT EXISTS beginning (t_ns INTEGER NOT NULL);
"""


class AlarmStore:
    """Not thread-safe: whoever shares it locks it."""

    def __init__(self, path: Path) -> None:
        """Open the file, or make it.

        Raises:
            UserError: it cannot be read or written.
        """
        self._path = path
        self._added = 0
        self.problem = ""
        """why the last transition could not be kept; empty if it was"""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
            self._file.executescript(f"PRAGMA journal_mode = WAL; PRAGMA synchronous = NORMAL; {_SCHEMA}")
        except (OSError, sqlite3.Error) as error:
            raise UserError(f"{path}: the history of alarms cannot be kept there: {error}") from error

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
            if self._added >= _DELETED_EVERY:
                self._added = 0
                deleted = self._file.execute(
                    "DELETE FROM transition WHERE number <= (SELECT MAX(number) FROM transition) - ?",
                    (MOST_TRANSITIONS,),
                )
                if deleted.rowcount > 0:
                    self._file.execute("UPDATE beginning SET t_ns = (SELECT MIN(t_ns) FROM transition)")
        except sqlite3.Error as error:
            self.problem = f"{self._path}: {error}: this alarm is not kept in the history"
            return True
        self.problem = ""
        return done.rowcount > 0

    def add_earlier(self, alarms: Sequence[Alarm]) -> int:
        """Keep transitions of before all others, the last first, as far as there is room; returns how many had room.

        Raises:
            UserError: they cannot be kept.
        """
        try:
            first, last = self._file.execute("SELECT MIN(number), MAX(number) FROM transition").fetchone()
            number = min(first or 0, 0)
            lowest = max(last or 0, 0) - MOST_TRANSITIONS + 1
            room = alarms[: max(0, number - lowest)]
            self._file.execute("BEGIN")
            for alarm in room:
                number -= 1
                header = alarm.header
                row = (number, header.tray, alarm.fan, alarm.t_ns, header.producer, header.sequence, encode(alarm))
                self._file.execute("INSERT OR IGNORE INTO transition VALUES (?, ?, ?, ?, ?, ?, ?)", row)
            self._file.execute("COMMIT")
        except sqlite3.Error as error:
            raise UserError(f"{self._path}: {error}: alarms of recordings are not in the history") from error
        return len(room)

    def begins(self, t_ns: int) -> None:
        """The history is complete from this time on, or from an earlier one that was given before."""
        kept = self.begins_t_ns()
        if kept is None:
            (first_t_ns,) = self._file.execute("SELECT MIN(t_ns) FROM transition").fetchone()
            self._file.execute("INSERT INTO beginning VALUES (?)", (min(t_ns, first_t_ns or t_ns),))
        elif t_ns < kept:
            self._file.execute("UPDATE beginning SET t_ns = ?", (t_ns,))

    def begins_t_ns(self) -> int | None:
        """From when on the history is complete; None: nobody has said it."""
        row = self._file.execute("SELECT t_ns FROM beginning").fetchone()
        return row[0] if row else None

    def newest(
        self, most: int, *, tray: str = "", fan: int = -1, before: int | None = None
    ) -> Sequence[tuple[int, Alarm]]:
        """The last transitions, newest first, each with its number, by which the next page is asked for.

        tray, fan: of these only. before: only those with a lower number; None: all.
        """
        rows = self._file.execute(
            "SELECT number, alarm FROM transition WHERE (?1 = '' OR tray = ?1) AND (?2 < 0 OR fan = ?2)"
            " AND (?3 IS NULL OR number < ?3) ORDER BY number DESC LIMIT ?4",
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

    def close(self) -> None:
        """Leave a complete file."""
        self._file.close()


def _decoded(data: bytes) -> Alarm | None:
    try:
        alarm = decode(Alarm, data)
    except CodecError:
        return None
    return alarm if isinstance(alarm, Alarm) else None

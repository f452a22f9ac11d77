"""The history of alarms: each transition that was heard, in a file that survives a restart of the gateway.

The bus keeps the last transitions too, and a gateway that starts asks for them: each is kept once.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from fantwin.pipeline.errors import UserError
from fantwin.schemas.codec import CodecError, decode, encode
from fantwin.schemas.messages import Alarm

HISTORY = "alarms.sqlite"
"""the file of the gateway, in the run folder"""
MOST_TRANSITIONS = 200_000
"""those that are older are deleted"""
_DELETED_EVERY = 1000
WAIT_S = 0.2
"""for another program that writes into the file; what it holds up is kept later"""
MOST_UNSAVED = 10_000
"""that wait for room on the disk; of more, the oldest are not kept"""

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
CREATE INDEX IF NOT EXISTS of_time ON transition (t_ns, number);
CREATE TABLE IF NOT EXISTS reader (name TEXT PRIMARY KEY, number INTEGER NOT NULL);
CREATE TABLE IF NOT EXISTS beginning (t_ns INTEGER NOT NULL);
"""


class AlarmStore:
    """Not thread-safe: whoever shares it locks it."""

    def __init__(self, path: Path, *, read_only: bool = False) -> None:
        """Open the file, or make it. read_only: of another process.

        Raises:
            UserError: it cannot be read or written.
        """
        self._path = path
        self._added = 0
        self._unsaved: dict[tuple[str, str, int], tuple[Any, ...]] = {}
        """the rows for which there was no room, oldest first, by what each is known by"""
        self.lost = 0
        """transitions that were heard and are not kept"""
        self._why_unsaved = self._why_unread = ""
        try:
            if read_only:
                self._file = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
                self._file.execute("SELECT 1 FROM transition LIMIT 1")
                return
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = sqlite3.connect(path, timeout=WAIT_S, check_same_thread=False, isolation_level=None)
            self._file.executescript(f"PRAGMA journal_mode = WAL; PRAGMA synchronous = NORMAL; {_SCHEMA}")
        except (OSError, sqlite3.Error) as error:
            what = "it has no history of alarms" if read_only else "the history of alarms cannot be kept there"
            raise UserError(f"{path}: {what}: {error}") from error

    @property
    def problem(self) -> str:
        """Why the file cannot be written or read; empty if it can."""
        return "; ".join(filter(None, (self._why_unsaved, self._why_unread)))

    def add(self, alarm: Alarm) -> bool:
        """Keep a transition; returns whether it is new. What a full disk has no room for is kept later."""
        name = (alarm.header.producer, alarm.header.tray, alarm.header.sequence)
        if name in self._unsaved:
            return False
        row = (alarm.header.tray, alarm.fan, alarm.t_ns, alarm.header.producer, alarm.header.sequence, encode(alarm))
        try:
            self._save_waiting()
            is_new = self._insert(row)
        except sqlite3.Error as error:
            self._unsaved[name] = row
            if len(self._unsaved) > MOST_UNSAVED:
                self.lost += 1
                del self._unsaved[next(iter(self._unsaved))]
            self._why_unsaved = f"{self._path}: {error}: alarms are not kept in the history until there is room"
            return True
        self._why_unsaved = ""
        return is_new

    def save_again(self) -> bool:
        """Keep what waits, if there is room now; returns whether anything was kept."""
        before = len(self._unsaved)
        try:
            self._save_waiting()
        except sqlite3.Error:
            return len(self._unsaved) < before
        self._why_unsaved = self._why_unsaved if self._unsaved else ""
        return before > 0

    def _save_waiting(self) -> None:
        while self._unsaved:
            name = next(iter(self._unsaved))
            self._insert(self._unsaved[name])
            del self._unsaved[name]

    def _insert(self, row: tuple[Any, ...]) -> bool:
        done = self._file.execute(
            "INSERT OR IGNORE INTO transition (tray, fan, t_ns, producer, sequence, alarm) VALUES (?, ?, ?, ?, ?, ?)",
            row,
        )
        self._added += done.rowcount
        if self._added >= _DELETED_EVERY:
            self._added = 0
            deleted = self._file.execute(
                "DELETE FROM transition WHERE number <= (SELECT MAX(number) FROM transition) - ?", (MOST_TRANSITIONS,)
            )
            if deleted.rowcount > 0:
                self._file.execute("UPDATE beginning SET t_ns = (SELECT MIN(t_ns) FROM transition)")
        return done.rowcount > 0

    def begins(self, t_ns: int) -> None:
        """The history is complete from this time on, or from an earlier one that was given before. `problem` says it if
        that cannot be kept."""
        try:
            if self.begins_t_ns() is None:
                self._file.execute("INSERT INTO beginning VALUES (?)", (t_ns,))
        except sqlite3.Error as error:
            self._why_unsaved = f"{self._path}: {error}: how far back the history reaches is not kept"
        except UserError:
            return

    def begins_t_ns(self) -> int | None:
        """From when on the history is complete; None: nobody has said it.

        Raises:
            UserError: the file cannot be read.
        """
        rows = self._read("SELECT t_ns FROM beginning")
        return rows[0][0] if rows else None

    def newest(
        self, most: int, *, tray: str = "", fan: int = -1, before: int | None = None
    ) -> Sequence[tuple[int, Alarm]]:
        """The last transitions, newest first, each with its number, by which the next page is asked for.

        tray, fan: of these only. before: only those with a lower number; None: all.

        Raises:
            UserError: the file cannot be read.
        """
        rows = self._read(
            "SELECT number, alarm FROM transition WHERE (:tray = '' OR tray = :tray) AND (:fan < 0 OR fan = :fan)"
            " AND (:before IS NULL OR number < :before) ORDER BY number DESC LIMIT :most",
            {"tray": tray, "fan": fan, "before": before, "most": most},
        )
        return [(number, alarm) for number, data in rows if (alarm := _decoded(data)) is not None]

    def between(
        self, begin_ns: int, end_ns: int, most: int, *, tray: str = "", fan: int = -1, is_backwards: bool = False
    ) -> Sequence[Alarm]:
        """The first transitions of a stretch of time, its end left out; is_backwards: the last ones, newest first.

        Raises:
            UserError: the file cannot be read.
        """
        order = "DESC" if is_backwards else "ASC"
        rows = self._read(
            "SELECT alarm FROM transition WHERE t_ns >= :begin_ns AND t_ns < :end_ns AND (:tray = '' OR tray = :tray)"
            f" AND (:fan < 0 OR fan = :fan) ORDER BY t_ns {order}, number {order} LIMIT :most",
            {"begin_ns": begin_ns, "end_ns": end_ns, "tray": tray, "fan": fan, "most": most},
        )
        return [alarm for (data,) in rows if (alarm := _decoded(data)) is not None]

    def after(self, number: int, most: int) -> Sequence[tuple[int, Alarm]]:
        """The transitions that came after one, oldest first, each with its number.

        Raises:
            UserError: the file cannot be read.
        """
        rows = self._read(
            "SELECT number, alarm FROM transition WHERE number > ? ORDER BY number LIMIT ?", (number, most)
        )
        return [(number, alarm) for number, data in rows if (alarm := _decoded(data)) is not None]

    def newest_number(self) -> int:
        """The number of the last transition; 0: there is none.

        Raises:
            UserError: the file cannot be read.
        """
        ((number,),) = self._read("SELECT MAX(number) FROM transition")
        return number or 0

    def position(self, reader: str) -> int:
        """The number of the transition up to which a reader has come; 0: it has not begun.

        Raises:
            UserError: the file cannot be read.
        """
        rows = self._read("SELECT number FROM reader WHERE name = ?", (reader,))
        return rows[0][0] if rows else 0

    def set_position(self, reader: str, number: int) -> None:
        """A reader has come up to a transition."""
        try:
            self._file.execute("INSERT OR REPLACE INTO reader (name, number) VALUES (?, ?)", (reader, number))
        except sqlite3.Error as error:
            self._why_unsaved = f"{self._path}: {error}: after a restart, transitions will be sent twice"

    def close(self) -> None:
        """Leave a complete file."""
        with suppress(sqlite3.Error):
            self._save_waiting()
        self._file.close()

    def _read(self, query: str, values: tuple[object, ...] | dict[str, object] = ()) -> list[Any]:
        try:
            rows = self._file.execute(query, values).fetchall()
        except sqlite3.Error as error:
            self._why_unread = (
                f"{self._path}: the history of alarms cannot be read: {error}: move it away, and restart the stage"
            )
            raise UserError(self._why_unread) from error
        self._why_unread = ""
        return rows


def _decoded(data: bytes) -> Alarm | None:
    try:
        alarm = decode(Alarm, data)
    except CodecError:
        return None
    return alarm if isinstance(alarm, Alarm) else None

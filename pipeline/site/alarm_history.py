"""The history of alarms of a site: each transition that was heard, once, in one file that its outputs share.

Page, OPC UA, MQTT and notifier add what they hear, and read from there: the first one that hears a transition writes
it. A reader has a position, so that after a restart it goes on where it was. A message is the same as another if its
content is: its sender and number alone can be forged.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import suppress
from hashlib import blake2b
from pathlib import Path
from typing import Any

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.site.sqlite_file import Store
from fantwin.schemas.codec import CodecError, decode, encode
from fantwin.schemas.messages import Alarm

FILE = Path("alarms.sqlite")
"""in the run folder"""
MOST_TRANSITIONS = 200_000
"""those that are older are deleted"""
MOST_UNSAVED = 10_000
"""that wait for room on the disk; of more, the oldest are not kept"""
_DELETED_EVERY = 1000
_SCHEMA = """
CREATE TABLE IF NOT EXISTS transition (
    number INTEGER PRIMARY KEY,
    digest BLOB NOT NULL UNIQUE,
    tray TEXT NOT NULL,
    fan INTEGER NOT NULL,
    onset_t_ns INTEGER NOT NULL,
    t_ns INTEGER NOT NULL,
    alarm BLOB NOT NULL
);
CREATE INDEX IF NOT EXISTS of_fan ON transition (tray, fan, number);
CREATE INDEX IF NOT EXISTS of_time ON transition (t_ns, number);
CREATE TABLE IF NOT EXISTS reader (name TEXT PRIMARY KEY, number INTEGER NOT NULL);
CREATE TABLE IF NOT EXISTS beginning (t_ns INTEGER NOT NULL);
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
"""with the tables of `AlarmRates`"""
_LAST_OCCURRENCES = """
SELECT each.number, each.alarm FROM
    (SELECT MAX(number) AS number FROM transition WHERE number <= :until GROUP BY tray, fan) AS newest
    JOIN transition AS last ON last.number = newest.number
    JOIN transition AS each ON each.tray = last.tray AND each.fan = last.fan AND each.onset_t_ns = last.onset_t_ns
WHERE each.number <= :until ORDER BY each.number
"""


class AlarmHistory:
    """Read in any thread, added to in one."""

    def __init__(self, path: Path, *, read_only: bool = False, schema: str = "", is_durable: bool = False) -> None:
        """Open the file, or make it. schema: statements for what a reader keeps beside it; others: as `Store`.

        Raises:
            UserError: it cannot be read or written.
        """
        what = "the history of alarms"
        self.store = Store(path, _SCHEMA + schema, what, read_only=read_only, is_durable=is_durable)
        self.lost = 0
        """transitions that were heard and are not kept"""
        self._added = 0
        self._unsaved: dict[bytes, tuple[Any, ...]] = {}
        """the rows for which there was no room, oldest first, by digest"""
        self._heard: dict[bytes, None] = {}
        """what this process has heard last"""
        self._why_unsaved = ""
        self._began = 0
        """the number of the last transition of before"""
        with suppress(UserError):  # `problem` says it
            self._began = self.newest_number()

    @property
    def problem(self) -> str:
        """Why the file cannot be written or read; empty if it can."""
        return "; ".join(filter(None, (self._why_unsaved, self.store.unread)))

    def add(self, alarm: Alarm) -> bool:
        """Keep a transition; returns whether it is news here. What a full disk has no room for is kept later."""
        data = encode(alarm)
        digest = blake2b(data, digest_size=16).digest()
        if digest in self._heard:
            return False
        self._heard[digest] = None
        if len(self._heard) > MOST_UNSAVED:
            del self._heard[next(iter(self._heard))]
        row = (digest, alarm.header.tray, alarm.fan, alarm.onset_t_ns, alarm.t_ns, data)
        try:
            self._save_waiting()
            number = self._insert(row)
        except (sqlite3.Error, UserError) as error:
            self._unsaved[digest] = row
            if len(self._unsaved) > MOST_UNSAVED:
                self.lost += 1
                del self._unsaved[next(iter(self._unsaved))]
            self._why_unsaved = f"{self.store.path}: {error}: alarms are not kept in the history until there is room"
            return True
        self._why_unsaved = ""
        return number > self._began

    def save_again(self) -> bool:
        """Keep what waits, if there is room now; returns whether anything was kept."""
        before = len(self._unsaved)
        try:
            self._save_waiting()
        except (sqlite3.Error, UserError):
            return len(self._unsaved) < before
        self._why_unsaved = self._why_unsaved if self._unsaved else ""
        return before > 0

    def _save_waiting(self) -> None:
        while self._unsaved:
            digest = next(iter(self._unsaved))
            self._insert(self._unsaved[digest])
            del self._unsaved[digest]

    def _insert(self, row: tuple[Any, ...]) -> int:
        """The number of the transition, which another process may have given it."""
        found = self.store.read("SELECT number FROM transition WHERE digest = ?", row[:1])
        if found:
            return found[0][0]
        done = self.store.write(
            "INSERT OR IGNORE INTO transition (digest, tray, fan, onset_t_ns, t_ns, alarm) VALUES (?, ?, ?, ?, ?, ?)",
            row,
        )
        if not done.rowcount:  # another process was faster
            return self.store.read("SELECT number FROM transition WHERE digest = ?", row[:1])[0][0]
        number = done.lastrowid or 0
        self._added += 1
        if self._added >= _DELETED_EVERY:
            self._added = 0
            deleted = self.store.write("DELETE FROM transition WHERE number <= ?", (number - MOST_TRANSITIONS,))
            if deleted.rowcount > 0:
                self.store.write("UPDATE beginning SET t_ns = (SELECT MIN(t_ns) FROM transition)")
        return number

    def begins(self, t_ns: int) -> None:
        """The history is complete from this time on, or from an earlier one that was given before. `problem` says it if
        that cannot be kept."""
        try:
            if self.begins_t_ns() is None:
                self.store.write("INSERT INTO beginning VALUES (?)", (t_ns,))
        except sqlite3.Error as error:
            self._why_unsaved = f"{self.store.path}: {error}: how far back the history reaches is not kept"
        except UserError:
            return

    def begins_t_ns(self) -> int | None:
        """Time from which on the history is complete; None: it is not known.

        Raises:
            UserError: the file cannot be read.
        """
        rows = self.store.read("SELECT t_ns FROM beginning")
        return rows[0][0] if rows else None

    def newest(
        self, most: int, *, tray: str = "", fan: int = -1, before: int | None = None
    ) -> Sequence[tuple[int, Alarm]]:
        """The last transitions, newest first, each with its number, by which the next page is asked for.

        tray, fan: of these only. before: only those with a lower number; None: all.

        Raises:
            UserError: the file cannot be read.
        """
        return self._alarms(
            "SELECT number, alarm FROM transition WHERE (:tray = '' OR tray = :tray) AND (:fan < 0 OR fan = :fan)"
            " AND (:before IS NULL OR number < :before) ORDER BY number DESC LIMIT :most",
            tray=tray,
            fan=fan,
            before=before,
            most=most,
        )

    def between(
        self, begin_ns: int, end_ns: int, most: int, *, tray: str = "", fan: int = -1, is_backwards: bool = False
    ) -> Sequence[Alarm]:
        """The first transitions of a stretch of time, its end left out; is_backwards: the last ones, newest first.

        Raises:
            UserError: the file cannot be read.
        """
        order = "DESC" if is_backwards else "ASC"
        found = self._alarms(
            "SELECT number, alarm FROM transition WHERE t_ns >= :begin_ns AND t_ns < :end_ns"
            " AND (:tray = '' OR tray = :tray) AND (:fan < 0 OR fan = :fan)"
            f" ORDER BY t_ns {order}, number {order} LIMIT :most",
            begin_ns=begin_ns,
            end_ns=end_ns,
            tray=tray,
            fan=fan,
            most=most,
        )
        return [alarm for _, alarm in found]

    def after(self, number: int, most: int) -> Sequence[tuple[int, Alarm]]:
        """The transitions that came after one, oldest first, each with its number.

        Raises:
            UserError: the file cannot be read.
        """
        query = "SELECT number, alarm FROM transition WHERE number > :number ORDER BY number LIMIT :most"
        return self._alarms(query, number=number, most=most)

    def last_occurrences(self, until: int) -> Sequence[Alarm]:
        """Transitions of the last alarm of each fan up to a number: its current alarm then follows from them.

        Raises:
            UserError: the file cannot be read.
        """
        return [alarm for _, alarm in self._alarms(_LAST_OCCURRENCES, until=until)]

    def newest_number(self) -> int:
        """The number of the last transition; 0: there is none.

        Raises:
            UserError: the file cannot be read.
        """
        ((number,),) = self.store.read("SELECT MAX(number) FROM transition")
        return number or 0

    def position(self, reader: str) -> int | None:
        """The number of the transition up to which a reader has come; None: it has never been here.

        Raises:
            UserError: the file cannot be read.
        """
        rows = self.store.read("SELECT number FROM reader WHERE name = ?", (reader,))
        return rows[0][0] if rows else None

    def set_position(self, reader: str, number: int) -> None:
        """A reader has come up to a transition; in a transaction of the reader, together with what it made of it.

        Raises:
            sqlite3.Error: it is not kept.
        """
        self.store.write("INSERT OR REPLACE INTO reader (name, number) VALUES (?, ?)", (reader, number))

    def close(self) -> None:
        """Leave a complete file."""
        with suppress(sqlite3.Error, UserError):
            self._save_waiting()
        self.store.close()

    def _alarms(self, query: str, **values: object) -> list[tuple[int, Alarm]]:
        return [(number, alarm) for number, data in self.store.read(query, values) if (alarm := _decoded(data))]


def _decoded(data: bytes) -> Alarm | None:
    try:
        alarm = decode(Alarm, data)
    except CodecError:
        return None
    return alarm if isinstance(alarm, Alarm) else None

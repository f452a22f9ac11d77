"""What must be sent, and what was decided, in a file of the run folder that survives a kill.

A decision and its message are saved together, or not at all. A message is deleted once its target has taken it. One
whose delivery was under way when the process was killed is sent again, and says that it may be a repetition.
"""

from __future__ import annotations

import sqlite3
import threading
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass
from pathlib import Path

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.outputs.notify.deciding import Announced, Event
from fantwin.pipeline.outputs.notify.fan_alarm import FanAlarm
from fantwin.pipeline.outputs.notify.gathering import Gathered
from fantwin.pipeline.outputs.notify.notifications import Basket, Changes, Saved
from fantwin.pipeline.outputs.notify.wording import Level, Text
from fantwin.schemas.units import NS_PER_S

MOST_EVENTS = 200_000
"""of those that were decided, the last are remembered"""
_SCHEMA = """
PRAGMA journal_mode = WAL;
PRAGMA synchronous = FULL;
CREATE TABLE IF NOT EXISTS alarm (tray TEXT, fan INTEGER, state TEXT NOT NULL, PRIMARY KEY (tray, fan));
CREATE TABLE IF NOT EXISTS announced (
    target TEXT, tray TEXT, fan INTEGER, state TEXT NOT NULL, PRIMARY KEY (target, tray, fan));
CREATE TABLE IF NOT EXISTS gathered (target TEXT, basket TEXT, state TEXT NOT NULL, PRIMARY KEY (target, basket));
CREATE TABLE IF NOT EXISTS event (
    target TEXT, tray TEXT, fan INTEGER, onset_t_ns INTEGER, kind TEXT, number INTEGER,
    PRIMARY KEY (target, tray, fan, onset_t_ns, kind, number));
CREATE TABLE IF NOT EXISTS message (
    number INTEGER PRIMARY KEY AUTOINCREMENT, target TEXT NOT NULL, made_ns INTEGER NOT NULL,
    title TEXT NOT NULL, body TEXT NOT NULL, level TEXT NOT NULL,
    under_way INTEGER NOT NULL DEFAULT 0, may_be_repeated INTEGER NOT NULL DEFAULT 0);
CREATE INDEX IF NOT EXISTS of_target ON message (target, number);
CREATE TABLE IF NOT EXISTS lost (target TEXT PRIMARY KEY, count INTEGER NOT NULL);
CREATE TABLE IF NOT EXISTS firing (
    target TEXT, tray TEXT, fan INTEGER, severity TEXT, onset_t_ns INTEGER,
    PRIMARY KEY (target, tray, fan, severity));
"""
FiringKey = tuple[str, int, str, int]
"""tray, fan, severity in words, onset: of an alert that an Alertmanager has"""


@dataclass(frozen=True)
class Waiting:
    """The next message of a target. lost: how many before it were lost, which it has to say."""

    number: int
    made_ns: int
    text: Text
    may_be_repeated: bool
    lost: int


class Outbox:
    """Thread-safe."""

    def __init__(self, path: Path, targets: Iterable[str]) -> None:
        """Open the file, or make it. Messages for targets that are no longer configured are lost.

        Raises:
            UserError: it cannot be read or written.
        """
        self._path = path
        self._lock = threading.Lock()
        self.lost: Counter[str] = Counter()
        """messages lost since the start, by target"""
        self._waiting = 0
        names = tuple(targets)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = sqlite3.connect(path, check_same_thread=False, isolation_level=None)
            self._file.executescript(_SCHEMA)
            with self._transaction() as file:
                file.execute("UPDATE message SET under_way = 0, may_be_repeated = 1 WHERE under_way")
                known = ", ".join("?" * len(names))
                self._lose(f"target NOT IN ({known})", names)
                for table in ("announced", "gathered", "lost", "firing"):
                    file.execute(f"DELETE FROM {table} WHERE target NOT IN ({known})", names)
        except (OSError, sqlite3.Error) as error:
            raise UserError(f"{path}: messages cannot be kept there: {error}") from error

    def load(self) -> Saved:
        """What was saved.

        Raises:
            UserError: it cannot be understood.
        """
        try:
            with self._lock:
                alarms = self._file.execute("SELECT state FROM alarm").fetchall()
                announced = self._file.execute("SELECT target, tray, fan, state FROM announced").fetchall()
                gathered = self._file.execute("SELECT target, basket, state FROM gathered").fetchall()
                # the first commit ends the first look; before it there is nothing
                is_first = not self._file.execute("PRAGMA user_version").fetchone()[0]
            each = [FanAlarm.from_json(state) for (state,) in alarms]
            return Saved(
                is_first=is_first,
                alarms={alarm.name: alarm for alarm in each},
                announced={(name, (tray, fan)): Announced.from_json(state) for name, tray, fan, state in announced},
                gathered={(name, Basket(basket)): Gathered.from_json(state) for name, basket, state in gathered},
            )
        except (sqlite3.Error, ValueError, KeyError, TypeError) as error:
            raise UserError(
                f"{self._path}: cannot be understood ({error}): move it away; alarms that are active now are then sent "
                "again"
            ) from error

    def was_sent(self, target: str, event: Event) -> bool:
        """Whether an event was decided before for a target; of a damaged file, where nothing is saved either: no."""
        with self._lock, suppress(sqlite3.Error):
            found = self._file.execute(
                "SELECT 1 FROM event WHERE target = ? AND tray = ? AND fan = ? AND onset_t_ns = ? AND kind = ?"
                " AND number = ?",
                (target, *astuple(event)),
            )
            return found.fetchone() is not None
        return False

    def save(self, saved: Saved, changes: Changes, *, most_messages: int, kept_s: float, now_ns: int) -> None:
        """Save what has changed, all or nothing. Messages that are too old or too many are lost.

        Raises:
            sqlite3.Error: nothing was saved.
        """
        with self._lock, self._transaction() as file:
            file.executemany(
                "INSERT OR REPLACE INTO alarm VALUES (?, ?, ?)",
                [(*name, saved.alarms[name].to_json()) for name in changes.alarms],
            )
            file.executemany(
                "INSERT OR REPLACE INTO announced VALUES (?, ?, ?, ?)",
                [(target, *fan, saved.announced[target, fan].to_json()) for target, fan in changes.announced],
            )
            file.executemany(
                "INSERT OR REPLACE INTO gathered VALUES (?, ?, ?)",
                [(*key, saved.gathered[key].to_json()) for key in changes.gathered],
            )
            file.executemany(
                "INSERT OR IGNORE INTO event VALUES (?, ?, ?, ?, ?, ?)",
                [(target, *astuple(event)) for target, event in changes.events],
            )
            file.executemany(
                "INSERT INTO message (target, made_ns, title, body, level) VALUES (?, ?, ?, ?, ?)",
                [
                    (each.target, each.made_ns, each.text.title, each.text.body, each.text.level)
                    for each in changes.outgoing
                ],
            )
            file.execute("PRAGMA user_version = 1")
            file.execute("DELETE FROM event WHERE rowid <= (SELECT MAX(rowid) FROM event) - ?", (MOST_EVENTS,))
            self._lose("made_ns < ?", (now_ns - round(kept_s * NS_PER_S),))
            self._lose("number <= (SELECT number FROM message ORDER BY number DESC LIMIT 1 OFFSET ?)", (most_messages,))

    def next_for(self, target: str, after: int = 0) -> Waiting | None:
        """The oldest message of a target, or the first one after another; None: there is none."""
        with self._lock:
            row = self._file.execute(
                "SELECT number, made_ns, title, body, level, may_be_repeated,"
                " coalesce((SELECT count FROM lost WHERE target = :target), 0)"
                " FROM message WHERE target = :target AND number > :after ORDER BY number LIMIT 1",
                {"target": target, "after": after},
            ).fetchone()
        if row is None:
            return None
        number, made_ns, title, body, level, may_be_repeated, lost = row
        return Waiting(number, made_ns, Text(title, body, Level(level)), bool(may_be_repeated), lost)

    def begin(self, waiting: Waiting) -> None:
        """Its delivery begins."""
        with self._lock:
            self._file.execute("UPDATE message SET under_way = 1 WHERE number = ?", (waiting.number,))

    def delivered(self, target: str, waiting: Waiting) -> None:
        """Its target has taken it."""
        with self._lock, self._transaction() as file:
            file.execute("DELETE FROM message WHERE number = ?", (waiting.number,))
            file.execute("UPDATE lost SET count = count - ? WHERE target = ?", (waiting.lost, target))

    def failed(self, waiting: Waiting, *, is_uncertain: bool) -> None:
        """It is to be delivered again. is_uncertain: its target may have taken it all the same."""
        with self._lock:
            self._file.execute(
                "UPDATE message SET under_way = 0, may_be_repeated = may_be_repeated OR ? WHERE number = ?",
                (is_uncertain, waiting.number),
            )

    def refuse(self, target: str, waiting: Waiting) -> None:
        """Its target takes others, but not this one: it is lost."""
        with self._lock, self._transaction():
            self._lose("target = ? AND number = ?", (target, waiting.number))

    def count(self) -> int:
        """How many messages wait; once the file is closed or cannot be read, how many did."""
        with self._lock:
            with suppress(sqlite3.Error):
                self._waiting = self._file.execute("SELECT COUNT(*) FROM message").fetchone()[0]
            return self._waiting

    def firing(self, target: str) -> set[FiringKey]:
        """The alerts that an Alertmanager was given and that have not been resolved there."""
        with self._lock:
            rows = self._file.execute("SELECT tray, fan, severity, onset_t_ns FROM firing WHERE target = ?", (target,))
            return set(rows.fetchall())

    def set_firing(self, target: str, alerts: Sequence[FiringKey]) -> None:
        """It now has these."""
        with self._lock, self._transaction() as file:
            file.execute("DELETE FROM firing WHERE target = ?", (target,))
            file.executemany("INSERT INTO firing VALUES (?, ?, ?, ?, ?)", [(target, *each) for each in alerts])

    def close(self) -> None:
        """Leave a complete file."""
        self.count()
        with self._lock:
            self._file.close()

    def _transaction(self) -> _Transaction:
        return _Transaction(self._file)

    def _lose(self, condition: str, values: Sequence[object]) -> None:
        """Delete the messages to which this applies, except one that is under way, and count them."""
        rows = self._file.execute(
            f"DELETE FROM message WHERE NOT under_way AND {condition} RETURNING target", tuple(values)
        ).fetchall()
        counts = Counter(target for (target,) in rows)
        self.lost.update(counts)
        self._file.executemany(
            "INSERT INTO lost VALUES (?, ?) ON CONFLICT (target) DO UPDATE SET count = count + excluded.count",
            counts.items(),
        )


class _Transaction:
    """All that is executed within it happens, or nothing."""

    def __init__(self, file: sqlite3.Connection) -> None:
        self._file = file

    def __enter__(self) -> sqlite3.Connection:
        self._file.execute("BEGIN IMMEDIATE")
        return self._file

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._file.execute("ROLLBACK" if kind else "COMMIT")

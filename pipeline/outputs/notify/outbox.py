"""What must be sent, and what was decided, in the file of the history of alarms.

Transitions are read from the history. How far that is done, the decisions and their messages are saved together, or not
at all. A message is deleted once its target has taken it. One whose delivery was under way when the process was killed
is sent again, and says that it may be a repetition.
"""

from __future__ import annotations

import sqlite3
from collections import Counter
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.outputs.notify.deciding import ANNOUNCED, Gathered
from fantwin.pipeline.outputs.notify.notification_flow import Basket, Changes, Saved
from fantwin.pipeline.outputs.notify.wording import Level, Text
from fantwin.pipeline.site.alarm_history import AlarmHistory
from fantwin.pipeline.site.fleet import Fan
from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import NS_PER_S

READER = "notifier"
MOST_MESSAGES, KEPT_S = 10_000, 3 * 86_400.0
"""that wait for their targets: the oldest beyond that, and those that have waited longer, are lost"""
_SCHEMA = """
CREATE TABLE IF NOT EXISTS announced (
    target TEXT, tray TEXT, fan INTEGER, state TEXT NOT NULL, PRIMARY KEY (target, tray, fan));
CREATE TABLE IF NOT EXISTS gathered (target TEXT, basket TEXT, state TEXT NOT NULL, PRIMARY KEY (target, basket));
CREATE TABLE IF NOT EXISTS message (
    number INTEGER PRIMARY KEY AUTOINCREMENT, target TEXT NOT NULL, made_ns INTEGER NOT NULL,
    title TEXT NOT NULL, body TEXT NOT NULL, level TEXT NOT NULL,
    under_way INTEGER NOT NULL DEFAULT 0, may_be_repeated INTEGER NOT NULL DEFAULT 0);
CREATE INDEX IF NOT EXISTS of_target ON message (target, number);
CREATE TABLE IF NOT EXISTS lost (target TEXT PRIMARY KEY, count INTEGER NOT NULL);
"""


@dataclass(frozen=True)
class Waiting:
    """The next message of a target. lost: how many before it were lost, which it has to say."""

    number: int
    made_ns: int
    text: Text
    may_be_repeated: bool
    lost: int


class Outbox:
    """Messages are delivered in other threads; all else is of one."""

    def __init__(self, path: Path, targets: Iterable[str]) -> None:
        """Open the file, or make it. Messages for targets that are no longer configured are lost.

        Raises:
            UserError: it cannot be read or written.
        """
        self.lost: Counter[str] = Counter()
        """messages lost since the start, by target"""
        self._waiting = 0
        names = tuple(targets)
        self._history = AlarmHistory(path, schema=_SCHEMA, is_durable=True)
        self._store = self._history.store
        self._position = self._history.position(READER)
        """of the last transition that was read; None: none ever was"""
        try:
            with self._store.transaction():
                self._store.write("UPDATE message SET under_way = 0, may_be_repeated = 1 WHERE under_way")
                known = ", ".join("?" * len(names))
                self._lose(f"target NOT IN ({known})", names)
                for table in ("gathered", "lost"):  # `announced` stays: a target may come back
                    self._store.write(f"DELETE FROM {table} WHERE target NOT IN ({known})", names)
        except sqlite3.Error as error:
            raise UserError(f"{path}: messages cannot be kept there: {error}") from error

    def load(self) -> tuple[Saved, Sequence[Alarm]]:
        """What was saved, and the transitions from which the alarms of then follow.

        Raises:
            UserError: it cannot be understood.
        """
        announced = self._store.read("SELECT target, tray, fan, state FROM announced")
        gathered = self._store.read("SELECT target, basket, state FROM gathered")
        past = self._history.last_occurrences(self._position) if self._position is not None else ()
        is_first, self._position = self._position is None, self._position or self._history.newest_number()
        try:
            saved = Saved(
                is_first=is_first,
                announced={
                    (name, Fan(tray, fan)): ANNOUNCED.validate_json(state) for name, tray, fan, state in announced
                },
                gathered={(name, Basket(basket)): Gathered.from_json(state) for name, basket, state in gathered},
            )
        except (ValueError, KeyError, TypeError) as error:
            raise UserError(
                f"{self._store.path}: cannot be understood ({error}): move it away; alarms that are active now are "
                "then sent again"
            ) from error
        return saved, past

    def hear(self, alarm: Alarm) -> None:
        """A transition has arrived: into the history."""
        self._history.add(alarm)

    def news(self, most: int) -> Sequence[Alarm]:
        """The next transitions that were not read yet, in their order; none if the file cannot be read now."""
        self._history.save_again()
        with suppress(UserError):
            found = self._history.after(self._position or 0, most)
            self._position = found[-1][0] if found else self._position
            return [alarm for _, alarm in found]
        return ()

    @property
    def problem(self) -> str:
        """Why transitions cannot be kept or read; empty if they can."""
        return self._history.problem

    def save(self, saved: Saved, changes: Changes, now_ns: int) -> None:
        """Save what has changed, all or nothing. Messages that are too old or too many are lost.

        Raises:
            sqlite3.Error: nothing was saved.
        """
        file = self._store
        with file.transaction():
            file.write_many(
                "INSERT OR REPLACE INTO announced VALUES (?, ?, ?, ?)",
                [
                    (target, *fan, ANNOUNCED.dump_json(saved.announced[target, fan]).decode())
                    for target, fan in changes.announced
                ],
            )
            file.write_many(
                "INSERT OR REPLACE INTO gathered VALUES (?, ?, ?)",
                [(*key, saved.gathered[key].to_json()) for key in changes.gathered],
            )
            file.write_many(
                "INSERT INTO message (target, made_ns, title, body, level) VALUES (?, ?, ?, ?, ?)",
                [
                    (each.target, each.made_ns, each.text.title, each.text.body, each.text.level)
                    for each in changes.outgoing
                ],
            )
            self._history.set_position(READER, self._position or 0)
            self._lose("made_ns < ?", (now_ns - round(KEPT_S * NS_PER_S),))
            self._lose("number <= (SELECT number FROM message ORDER BY number DESC LIMIT 1 OFFSET ?)", (MOST_MESSAGES,))

    def next_for(self, target: str, after: int = 0) -> Waiting | None:
        """The oldest message of a target, or the first one after another; None: there is none.

        Raises:
            UserError: the file cannot be read.
        """
        rows = self._store.read(
            "SELECT number, made_ns, title, body, level, may_be_repeated,"
            " coalesce((SELECT count FROM lost WHERE target = :target), 0)"
            " FROM message WHERE target = :target AND number > :after ORDER BY number LIMIT 1",
            {"target": target, "after": after},
        )
        if not rows:
            return None
        number, made_ns, title, body, level, may_be_repeated, lost = rows[0]
        return Waiting(number, made_ns, Text(title, body, Level(level)), bool(may_be_repeated), lost)

    def begin(self, waiting: Waiting) -> None:
        """Its delivery begins."""
        self._store.write("UPDATE message SET under_way = 1 WHERE number = ?", (waiting.number,))

    def delivered(self, target: str, waiting: Waiting) -> None:
        """Its target has taken it."""
        with self._store.transaction():
            self._store.write("DELETE FROM message WHERE number = ?", (waiting.number,))
            self._store.write("UPDATE lost SET count = count - ? WHERE target = ?", (waiting.lost, target))

    def failed(self, waiting: Waiting, *, is_uncertain: bool) -> None:
        """It is to be delivered again. is_uncertain: its target may have taken it all the same."""
        self._store.write(
            "UPDATE message SET under_way = 0, may_be_repeated = may_be_repeated OR ? WHERE number = ?",
            (is_uncertain, waiting.number),
        )

    def refuse(self, target: str, waiting: Waiting) -> None:
        """Its target takes others, but not this one: it is lost."""
        with self._store.transaction():
            self._lose("target = ? AND number = ?", (target, waiting.number))

    def count(self) -> int:
        """How many messages wait; once the file is closed or cannot be read, how many did."""
        with suppress(UserError):
            ((self._waiting,),) = self._store.read("SELECT COUNT(*) FROM message")
        return self._waiting

    def close(self) -> None:
        """Leave a complete file."""
        self.count()
        self._history.close()

    def _lose(self, condition: str, values: Sequence[object]) -> None:
        """Delete the messages to which this applies, except one that is under way, and count them."""
        rows = self._store.write(
            f"DELETE FROM message WHERE NOT under_way AND {condition} RETURNING target", tuple(values)
        ).fetchall()
        counts = Counter(target for (target,) in rows)
        self.lost.update(counts)
        self._store.write_many(
            "INSERT INTO lost VALUES (?, ?) ON CONFLICT (target) DO UPDATE SET count = count + excluded.count",
            list(counts.items()),
        )

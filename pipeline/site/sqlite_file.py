"""An SQLite file of the run folder, which several processes may share and which survives a kill."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fantwin.pipeline.errors import UserError

WAIT_S = 1.0
"""for another process that writes into the file"""
Values = Sequence[object] | Mapping[str, object]


class Store:
    """One connection, for any thread. Statements commit by themselves; a transaction is of one thread."""

    def __init__(
        self, path: Path, schema: str, what: str, *, read_only: bool = False, is_durable: bool = False
    ) -> None:
        """Open the file, or make it.

        Args:
            path: of the file.
            schema: statements that make its tables, if they are not there.
            what: is kept there, for messages to people: "the history of alarms".
            read_only: the file of another process.
            is_durable: a power cut loses nothing that was committed.

        Raises:
            UserError: it cannot be read or written.
        """
        self.path, self._what = path, what
        self._lock = threading.RLock()
        self.unread = ""
        """why the file cannot be read; empty if it can"""
        try:
            if read_only:
                self._file = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
                self._file.execute("SELECT COUNT(*) FROM sqlite_schema")
                return
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = sqlite3.connect(path, timeout=WAIT_S, check_same_thread=False, isolation_level=None)
            synchronous = "FULL" if is_durable else "NORMAL"
            self._file.executescript(f"PRAGMA journal_mode = WAL; PRAGMA synchronous = {synchronous}; {schema}")
        except (OSError, sqlite3.Error) as error:
            raise UserError(f"{path}: {what} cannot be {'read' if read_only else 'kept'} there: {error}") from error

    def read(self, query: str, values: Values = ()) -> list[Any]:
        """The rows of a query.

        Raises:
            UserError: the file cannot be read.
        """
        try:
            with self._lock:
                rows = self._file.execute(query, values).fetchall()
        except sqlite3.Error as error:
            self.unread = f"{self.path}: {self._what} cannot be read: {error}: move it away, and restart the stage"
            raise UserError(self.unread) from error
        self.unread = ""
        return rows

    def write(self, statement: str, values: Values = ()) -> sqlite3.Cursor:
        """Execute a statement.

        Raises:
            sqlite3.Error: nothing was changed.
        """
        with self._lock:
            return self._file.execute(statement, values)

    def write_many(self, statement: str, rows: Sequence[Sequence[object]]) -> None:
        """Execute a statement for each row, in a transaction of the caller.

        Raises:
            sqlite3.Error: the transaction must be rolled back.
        """
        self._file.executemany(statement, rows)

    @contextmanager
    def transaction(self) -> Iterator[None]:
        """All that is written inside is kept together, or nothing.

        Raises:
            sqlite3.Error: nothing was changed.
        """
        with self._lock:
            self._file.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._file.execute("COMMIT")
            finally:
                if self._file.in_transaction:
                    self._file.execute("ROLLBACK")

    def close(self) -> None:
        """Leave a complete file."""
        with self._lock:
            self._file.close()

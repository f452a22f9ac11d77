"""Log lines for people, written so that writing them never delays or ends the program.

The reader of the output may go away or stop reading, and its disk may be full. So a separate thread writes the lines;
it counts those that it cannot write, and reports the count when it can write again. A line that keeps repeating is
folded: it is written again after 10 s, then after twice as long each time, with the number of repetitions. Control
characters in a line become spaces: a terminal would obey them.
"""

from __future__ import annotations

import os
import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from fantwin.pipeline.site.one_line import one_line

FOLD_S = 10.0
FOLD_MAX_S = 600.0
QUEUE_SIZE = 1000
"""lines that wait to be written; more than that are counted"""
_MAX_REMEMBERED = 1000  # lines that may be repeated
_POLL_S = 0.5
_CLOSE_LIMIT_S = 1.0


@dataclass(slots=True)
class _Written:
    """A line that was written, and may be repeated."""

    at_s: float
    fold_s: float = FOLD_S
    repeated: int = 0


class RepeatedLines:
    """Which lines to write: equal ones are folded."""

    def __init__(self) -> None:
        self._written: dict[str, _Written] = {}
        """the line written first is at the beginning"""

    def add(self, line: str, now_s: float) -> list[str]:
        """The line, or nothing if it repeats one that was written a short time ago."""
        if line in self._written:
            self._written[line].repeated += 1
            return []
        self._written[line] = _Written(now_s)
        if len(self._written) > _MAX_REMEMBERED:
            del self._written[next(iter(self._written))]
        return [line]

    def due(self, now_s: float) -> list[str]:
        """The lines that were repeated and have waited long enough, with the number of repetitions."""
        lines: list[str] = []
        for line, written in list(self._written.items()):
            if now_s - written.at_s < written.fold_s:
                continue
            if written.repeated == 0:
                del self._written[line]
                continue
            lines.append(_folded(line, written.repeated))
            self._written[line] = _Written(now_s, min(2 * written.fold_s, FOLD_MAX_S))
        return lines

    def rest(self) -> list[str]:
        """All repetitions that have not been written yet."""
        return [_folded(line, written.repeated) for line, written in self._written.items() if written.repeated]


def _folded(line: str, repeated: int) -> str:
    return f"{line} ... repeated {repeated} time{'s' if repeated > 1 else ''}"


class EventLog:
    """Writes lines to a file descriptor. `say` may be called from any thread, never blocks and never raises."""

    def __init__(self, descriptor: int, now_s: Callable[[], float] = time.monotonic) -> None:
        self._descriptor = descriptor
        self._now_s = now_s
        self._queue: queue.Queue[str | None] = queue.Queue(QUEUE_SIZE)
        self._unwritten = 0
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="event log", daemon=True)
        self._thread.start()

    def say(self, line: str) -> None:
        """Write a line soon, or count it."""
        try:
            self._queue.put_nowait(line)
        except queue.Full:
            self._count_unwritten()

    def close(self) -> None:
        """Write what is still waiting, for a second at most: nobody may be reading."""
        try:
            self._queue.put(None, timeout=_CLOSE_LIMIT_S)
        except queue.Full:
            return
        self._thread.join(_CLOSE_LIMIT_S)

    def _run(self) -> None:
        repeated = RepeatedLines()
        while True:
            try:
                line = self._queue.get(timeout=_POLL_S)
            except queue.Empty:
                line = ""
            due = repeated.due(self._now_s())
            new = repeated.rest() if line is None else repeated.add(line, self._now_s()) if line else []
            for each in (*due, *new):
                self._write(each)
            if line is None:
                return

    def _write(self, line: str) -> None:
        with self._lock:
            unwritten, self._unwritten = self._unwritten, 0
        note = f"({unwritten} lines could not be written)\n" if unwritten else ""
        data = f"{note}{one_line(line)}\n".encode(errors="replace")
        try:
            while data:
                data = data[os.write(self._descriptor, data) :]
        except OSError:  # the reader has gone, or the disk is full
            self._count_unwritten(unwritten + 1)

    def _count_unwritten(self, count: int = 1) -> None:
        with self._lock:
            self._unwritten += count

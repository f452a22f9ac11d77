"""The file of a view. Rerun writes into a pipe and this module writes to the disk: Rerun's own file sink stops for ever
when the disk refuses a write, and every later flush then waits without end.
"""

from __future__ import annotations

import math
import os
import queue
import select
import sys
import threading
import time
from fcntl import ioctl
from pathlib import Path
from termios import FIONREAD

HELD_BYTES = 64 << 20
"""At most so much waits in memory for a slow disk."""
CLOSE_LIMIT_S = 5.0
FLUSH_LIMIT_S = 0.5
_PIECE_BYTES = 1 << 16


class ViewFile:
    """Copies what is written to `pipe` into a file until the other end is closed.

    When the disk refuses, or falls too far behind, the file ends there and everything later is discarded: a gap would
    make it unreadable. Whoever writes into the pipe never waits for the disk.
    """

    def __init__(self, path: Path, limit_bytes: float = math.inf) -> None:
        """Open an existing file for writing; it ends before it exceeds the limit.

        Raises:
            OSError: the file cannot be opened.
        """
        self.problem = ""
        """why nothing is written any more; empty if all is well"""
        self._path = path
        self._room_bytes = limit_bytes
        self._file = path.open("r+b", buffering=0)
        self._read_end, self._write_end = os.pipe()
        self.pipe = Path(f"/dev/fd/{self._write_end}")
        """open it for writing, then call `release_pipe`"""
        self._between = threading.Lock()
        """held while a piece is neither in the pipe nor in the queue"""
        self._waiting: queue.Queue[bytes] = queue.Queue(HELD_BYTES // _PIECE_BYTES)
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._read, self._write)]
        for thread in self._threads:
            thread.start()

    def release_pipe(self) -> None:
        """The pipe has been opened by its writer: the file ends when the writer closes it."""
        os.close(self._write_end)

    def flush(self) -> None:
        """Wait until the system has what is in the pipe, at most FLUSH_LIMIT_S."""
        until_s = time.monotonic() + FLUSH_LIMIT_S
        while time.monotonic() < until_s and not self.problem:
            with self._between:
                left = int.from_bytes(ioctl(self._read_end, FIONREAD, bytes(4)), sys.byteorder)
                if not left and not self._waiting.unfinished_tasks:
                    return
            time.sleep(0.001)

    def close(self) -> None:
        """Wait until everything is written, at most CLOSE_LIMIT_S."""
        for thread in self._threads:
            thread.join(CLOSE_LIMIT_S / 2)
            if thread.is_alive():
                self._stop(f"not finished after {CLOSE_LIMIT_S:g} s")
                return
        os.close(self._read_end)

    def _read(self) -> None:
        piece = b"\0"
        while piece:
            select.select([self._read_end], [], [])
            with self._between:
                piece = os.read(self._read_end, _PIECE_BYTES)
                try:
                    if piece and not self.problem:
                        self._waiting.put_nowait(piece)
                except queue.Full:
                    self._stop("the disk is too slow")
        self._waiting.put(b"")

    def _write(self) -> None:
        with self._file:
            while piece := self._waiting.get():
                rest = memoryview(piece)
                self._room_bytes -= len(piece)
                if self._room_bytes < 0:
                    self._stop("it has the largest size of a view", "`fantwin view` shows a recording")
                while rest and not self.problem:
                    try:
                        rest = rest[self._file.write(rest) :]
                    except OSError as error:
                        self._stop(error.strerror or str(error))
                self._waiting.task_done()

    def _stop(self, reason: str, todo: str = "make room and restart the viewer") -> None:
        self.problem = self.problem or (
            f"{self._path}: the view is not written any more: {reason}; what is in the file can be opened; {todo}"
        )

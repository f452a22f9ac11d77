"""Ctrl-C and SIGTERM request an orderly stop; a second one ends the process at once."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
from collections.abc import Callable


def stop_on_signals() -> threading.Event:
    """An event that the first SIGINT or SIGTERM sets; the second ends the process, with status 128 + its number.

    A handler in Python runs only when the main thread returns from whatever it has called, which may be never. So the
    interpreter writes the number of the signal to a socket, at once, and a thread reads it.
    """
    stop = threading.Event()
    reader, writer = socket.socketpair()
    writer.setblocking(False)
    signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda _number, _frame: None)
    threading.Thread(target=_obey, args=(reader, writer, stop), name="signals", daemon=True).start()
    return stop


def when_stdin_closes(act: Callable[[], None]) -> None:
    """Act when standard input ends: the process that started this one holds it open for as long as it lives."""

    def wait() -> None:
        while os.read(sys.stdin.fileno(), 1024):  # sys.stdin.read() would hold its lock at the interpreter's end
            pass
        act()

    threading.Thread(target=wait, name="stdin", daemon=True).start()


def ignore_hangup() -> None:
    """Go on when the terminal is closed, as when a connection to a remote host drops."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)


def _obey(reader: socket.socket, _writer: socket.socket, stop: threading.Event) -> None:
    """`_writer` is held open for as long as this thread runs."""
    while True:
        for number in reader.recv(64):
            if number not in (signal.SIGINT, signal.SIGTERM):
                continue
            if stop.is_set():
                os._exit(128 + number)
            stop.set()

"""Ctrl-C and SIGTERM set an event; a second one ends at once."""

from __future__ import annotations

import signal
import sys
import threading
from types import FrameType


def stop_on_signals(stop: threading.Event) -> None:
    """Let SIGINT and SIGTERM ask for an orderly end; whoever asks twice means it."""

    def ask(number: int, _frame: FrameType | None) -> None:
        if stop.is_set():
            sys.exit(128 + number)
        stop.set()

    signal.signal(signal.SIGINT, ask)
    signal.signal(signal.SIGTERM, ask)

"""Ctrl-C and SIGTERM request an orderly stop; a second one ends the process at once."""

from __future__ import annotations

import signal
import sys
import threading
from types import FrameType


def stop_on_signals(stop: threading.Event) -> None:
    """Set `stop` on the first SIGINT or SIGTERM; exit on the second."""

    def on_signal(number: int, _frame: FrameType | None) -> None:
        if stop.is_set():
            sys.exit(128 + number)
        stop.set()

    signal.signal(signal.SIGINT, on_signal)
    signal.signal(signal.SIGTERM, on_signal)

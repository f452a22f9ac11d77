"""Who logs in, who is refused, and what fails unexpectedly: a line each on standard error, as JSON after `event:`."""

from __future__ import annotations

import json
import os
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime

MOST_LINES, WITHIN_S = 60, 60.0
"""of more in that time it is only said how many there were: whoever guesses passwords fills no disk"""
LONGEST_VALUE = 200


class SecurityLog:
    """Thread-safe."""

    def __init__(self, write: Callable[[str], None] | None = None, now_s: Callable[[], float] = time.monotonic) -> None:
        """write: takes a line; None: it goes to standard error, which the launcher reads."""
        self._write = write or _to_standard_error
        self._now_s = now_s
        self._lock = threading.Lock()
        self._began_s = now_s()
        self._lines = self._left_out = 0

    def add(self, event: str, **values: str) -> None:
        """Something has happened. What comes from elsewhere cannot end the line, or look like another one."""
        with self._lock:
            now_s = self._now_s()
            if now_s - self._began_s >= WITHIN_S:
                self._began_s, self._lines = now_s, 0
            self._lines += 1
            if self._lines > MOST_LINES:
                self._left_out += 1
                return
            left_out, self._left_out = self._left_out, 0
        found = {"time": datetime.now(UTC).isoformat(timespec="milliseconds"), "what": event}
        found |= {name: value[:LONGEST_VALUE] for name, value in values.items()}
        if left_out:
            found["events_left_out_before"] = str(left_out)
        self._write(f"event: {json.dumps(found)}")


def _to_standard_error(line: str) -> None:
    with suppress(OSError):  # whoever reads it may have gone
        os.write(sys.stderr.fileno(), f"{line}\n".encode())

"""Wrong passwords, counted: who guesses must wait."""

from __future__ import annotations

import time
from collections import OrderedDict, deque
from collections.abc import Callable

FAILURES, FAILURES_WITHIN_S = 5, 60.0
"""so many wrong passwords for one name, or from one address: then nobody logs in so until the first is that old"""
MOST_COUNTED = 4096


class LoginFailures:
    """Used in the thread of one server only."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._failures: OrderedDict[str, deque[float]] = OrderedDict()

    def wait_s(self, *names: str) -> float:
        """How long nobody may log in under one of these names, or from one of these addresses; 0: at once."""
        now_s = self._now_s()
        waits = [
            FAILURES_WITHIN_S - (now_s - failures[0])
            for name in names
            if len(failures := self._failures.get(name, deque[float]())) == FAILURES
        ]
        return max(0.0, *waits) if waits else 0.0

    def add(self, *names: str) -> None:
        """A password was wrong."""
        for name in names:
            self._failures.setdefault(name, deque(maxlen=FAILURES)).append(self._now_s())
            self._failures.move_to_end(name)
        while len(self._failures) > MOST_COUNTED:
            self._failures.popitem(last=False)

    def forget(self, *names: str) -> None:
        """A password was right."""
        for name in names:
            self._failures.pop(name, None)

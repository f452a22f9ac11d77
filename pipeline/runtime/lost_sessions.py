"""Sessions on this host that were killed, and those whose link was cut.

The token of a session disappears when its process dies, and also when a link is cut. The two can be distinguished
only for processes on this host: by whether the process still runs.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field

from fantwin.pipeline.runtime.sessions import MOST_SESSIONS, Session

APART_S, APART_LIMIT_S = 2.0, 60.0
"""time after a token has disappeared in which a session whose process still runs counts as cut off: earlier, it may be
about to end; later, its process id may be reused"""


@dataclass
class LostSessions:
    """Finds sessions whose token has disappeared, and whether their process still runs. host: the name of this host, as
    sessions show it."""

    host: str
    now_s: Callable[[], float] = time.monotonic
    _seen: dict[str, Session] = field(default_factory=dict)
    """by token: sessions whose process was once found to run here. The number of a process in another container may not
    exist here, or may be that of another process"""
    _gone: dict[str, tuple[Session, float]] = field(default_factory=dict)
    """by token: those of them whose token has disappeared, and when; the last ones"""

    def update(self, key: str, alive: bool) -> None:
        """A token has appeared or disappeared."""
        if not alive:
            if (session := self._seen.pop(key, None)) is not None:
                self._gone[key] = session, self.now_s()
                if len(self._gone) > MOST_SESSIONS:
                    del self._gone[next(iter(self._gone))]
            return
        self._gone.pop(key, None)
        session = Session.of_key(key)
        if session is None or session.host != self.host or session.process_id == os.getpid():
            return
        if session.may_live(self.host) and len(self._seen) < MOST_SESSIONS:
            self._seen[key] = session

    def take_killed(self) -> list[str]:
        """The producers of the sessions that were killed; each is returned once."""
        killed = {key: each for key, (each, _) in self._gone.items() if not each.may_live(self.host)}
        for key in killed:
            del self._gone[key]
        return [each.producer for each in killed.values()]

    def cut_off(self) -> list[str]:
        """The producers of the sessions that still run, and whose token disappeared a while ago."""
        now_s = self.now_s()
        return [
            each.producer
            for each, since_s in self._gone.values()
            if APART_S <= now_s - since_s < APART_LIMIT_S and each.may_live(self.host)
        ]

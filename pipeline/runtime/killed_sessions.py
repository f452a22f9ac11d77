"""Sessions on this host that were killed.

The token of a session disappears when its process dies, and also when a link is cut. The two can be distinguished
only for processes on this host: by whether the process still runs.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field

from pipeline.runtime.sessions import MOST_SESSIONS, Session


@dataclass
class KilledSessions:
    """Finds sessions whose token has disappeared and whose process no longer runs. host: the name of this host, as
    sessions show it."""

    host: str
    _seen: dict[str, Session] = field(default_factory=dict)
    """by token: sessions whose process was once found to run here. The number of a process in another container may not
    exist here, or may be that of another process"""
    _gone: dict[str, Session] = field(default_factory=dict)
    """by token: those of them whose token has disappeared, the last ones"""

    def update(self, key: str, alive: bool) -> None:
        """A token has appeared or disappeared."""
        if not alive:
            if (session := self._seen.pop(key, None)) is not None:
                self._gone[key] = session
                if len(self._gone) > MOST_SESSIONS:
                    del self._gone[next(iter(self._gone))]
            return
        self._gone.pop(key, None)
        session = Session.of_key(key)
        if session is None or session.host != self.host or session.process_id == os.getpid():
            return
        if session.may_live(self.host) and len(self._seen) < MOST_SESSIONS:
            self._seen[key] = session

    def take(self) -> list[str]:
        """The producers of the sessions that were killed; each is returned once."""
        killed = {key: each for key, each in self._gone.items() if not each.may_live(self.host)}
        for key in killed:
            del self._gone[key]
        return [each.producer for each in killed.values()]

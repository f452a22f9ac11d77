"""Sessions on this host that were killed.

The token of a session goes when its process dies, and also when a link is cut. Which of them it was can be seen of
processes of this host alone.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field

from pipeline.runtime.sessions import MOST_SESSIONS, Session


@dataclass
class KilledSessions:
    """host: the name of this one, as sessions show it."""

    host: str
    _seen: dict[str, Session] = field(default_factory=dict)
    """by token: sessions whose process has been seen to run here. In a container, processes of others have numbers
    that do not exist here, or are of another process"""
    _gone: dict[str, Session] = field(default_factory=dict)
    """by token: those of them whose token has gone"""

    def update(self, key: str, alive: bool) -> None:
        """A token has appeared, or gone."""
        if not alive:
            if (session := self._seen.pop(key, None)) is not None:
                self._gone[key] = session
            return
        self._gone.pop(key, None)
        session = Session.of_key(key)
        if session is None or session.host != self.host or session.process_id == os.getpid():
            return
        if session.may_live(self.host) and len(self._seen) < MOST_SESSIONS:
            self._seen[key] = session

    def take(self) -> list[str]:
        """The producers of those whose token has gone and whose process runs no more, each once."""
        killed = {key: each for key, each in self._gone.items() if not each.may_live(self.host)}
        for key in killed:
            del self._gone[key]
        return [each.producer for each in killed.values()]

"""The sources of a stage: started with it, and stopped once, together, in a thread of their own."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from fantwin.pipeline.runtime.ending import Step
from fantwin.pipeline.runtime.inbox import FromSource, Inbox
from fantwin.pipeline.runtime.stage import BuiltStage, Core, Source

MOST_STOPPED_AT_ONCE = 128
"""a controller that does not answer takes seconds to be left, and a stage may have hundreds"""


class Sources:
    """The sources of a stage: started with it, and stopped once, together, in a thread of their own.

    What they deliver goes to the inbox, or is counted as lost.
    """

    def __init__(self, inbox: Inbox) -> None:
        self.lost = 0
        """samples that were delivered too late to be processed"""
        self._inbox = inbox
        self._started: list[Source] = []
        self._cores: dict[str, Core] = {}
        self._lock = threading.Lock()
        self._stopping: Step | None = None

    def start(self, name: str, parts: BuiltStage) -> None:
        """Start the source of the core called `name`, if it has one."""
        if parts.source is None:
            return

        def deliver(item: Any) -> None:
            if not self._inbox.put(FromSource(name, item)):
                self.discard(FromSource(name, item))

        self._cores[name] = parts.core
        self._started.append(parts.source)
        parts.source.start(deliver)

    def discard(self, item: FromSource) -> None:
        """Count an item that is no longer processed."""
        with self._lock:
            self.lost += self._cores[item.core].samples_in(item.item)

    def stop(self) -> Step:
        """Stop all sources; each first delivers what it still has. Further calls return the same step."""
        if self._stopping is None:
            self._stopping = Step(self._stop_each)
        return self._stopping

    def _stop_each(self) -> None:
        if not self._started:
            return
        with ThreadPoolExecutor(min(len(self._started), MOST_STOPPED_AT_ONCE)) as pool:
            stopped = [pool.submit(source.stop) for source in self._started]  # one waits for its device, not for others
        for each in stopped:
            each.result()

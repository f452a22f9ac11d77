"""The sources of a stage: started with it, and stopped once, together, in a thread of their own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from pipeline.runtime.ending import Step
from pipeline.runtime.stage import Source


class Sources:
    """Those that have been started."""

    def __init__(self) -> None:
        self._started: list[Source] = []
        self._stopping: Step | None = None

    def start(self, source: Source, deliver: Callable[[Any], None]) -> None:
        """Start one."""
        self._started.append(source)
        source.start(deliver)

    def stop(self) -> Step:
        """Stop all, each of which delivers the rest of what it has meanwhile. Further calls return the same step."""
        if self._stopping is None:
            self._stopping = Step(self._stop_each)
        return self._stopping

    def _stop_each(self) -> None:
        errors: list[Exception] = []
        for source in self._started:
            try:
                source.stop()
            except Exception as error:  # noqa: BLE001  the others are stopped as well
                errors.append(error)
        if errors:
            raise errors[0]

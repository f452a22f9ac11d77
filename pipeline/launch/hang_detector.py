"""Finds the stage that hangs: the one whose main loop has not run for too long.

A stage that publishes to a hung stage is soon blocked itself. So only the stage that has been silent longest is named.
All others get a new period, because they go on once it is gone.
"""

from __future__ import annotations

from dataclasses import dataclass

from fantwin.pipeline.site.stage_states import START_LIMIT_S

_AT_WORK_S = 2.0
_OWN_PAUSE_S = 1.0  # the launcher itself did not run: the machine was suspended or very busy


@dataclass(slots=True)
class _Heard:
    at_s: float
    is_ready: bool = False


class HangDetector:
    """Notes when each stage was last at work, and names the one that hangs. Times: monotonic clock, s."""

    def __init__(self, limit_s: float) -> None:
        """limit_s: how long a stage may be silent."""
        self._limit_s = limit_s
        self._heard: dict[str, _Heard] = {}
        self._checked_s: float | None = None

    def started(self, name: str, now_s: float) -> None:
        """A stage has been started."""
        self._heard[name] = _Heard(now_s)

    def heard(self, name: str, now_s: float, *, is_ready: bool) -> None:
        """The main loop of a stage has run."""
        self._heard[name] = _Heard(now_s, is_ready)

    def is_at_work(self, name: str, now_s: float) -> bool:
        """Whether the main loop of a stage ran a moment ago."""
        return name in self._heard and now_s - self._heard[name].at_s < _AT_WORK_S

    def ended(self, name: str) -> None:
        """A stage has ended."""
        self._heard.pop(name, None)

    def hung(self, now_s: float) -> tuple[str, float] | None:
        """The stage that hangs, and for how many seconds; None if none does.

        Call it at least once a second: a longer pause is taken to be one of the caller itself, and no stage is blamed
        for it. The stage that is returned is forgotten; the caller must kill it.
        """
        pause_s = 0.0 if self._checked_s is None else now_s - self._checked_s
        self._checked_s = now_s
        if pause_s > _OWN_PAUSE_S:
            for heard in self._heard.values():
                heard.at_s = min(now_s, heard.at_s + pause_s)
        silent = {name: now_s - heard.at_s for name, heard in self._heard.items() if self._is_overdue(heard, now_s)}
        if not silent:
            return None
        name = max(silent, key=lambda each: silent[each])
        del self._heard[name]
        for heard in self._heard.values():
            heard.at_s = now_s
        return name, silent[name]

    def _is_overdue(self, heard: _Heard, now_s: float) -> bool:
        return now_s - heard.at_s > (self._limit_s if heard.is_ready else max(self._limit_s, START_LIMIT_S))

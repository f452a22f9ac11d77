"""When the next version of a tray's twin is due, and when its fans are to be checked against the reference.

Only recordings outside the excluded time spans count: versions and checks are made from no others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

from pipeline.learning.healthy_history import SHORTEST_RECORDING_S, HealthyHistory
from pipeline.learning.ordinary_operation import OrdinaryOperation
from pipeline.learning.versions import VersionList

Work: TypeAlias = Literal["version", "check"]

LONGEST_WAIT_S = 7 * 24 * 3600.0
"""of healthy running between two versions"""
CHECK_AFTER_S = 24 * 3600.0
"""of healthy running between two checks of the fans against the reference"""
AFTER_COMMISSIONING_S = 4 * 3600.0
"""of healthy running after fans were commissioned again: then the twin is compared with them"""
AGAIN_AFTER = 0.25
"""after a failure, healthy running before the next attempt, as a share of the history"""
AGAIN_AFTER_AT_MOST_S = 24 * 3600.0
"""of healthy running before the next attempt"""


@dataclass(frozen=True)
class _Failure:
    """A version or a check that could not be made."""

    why: str
    end_t_ns: int
    """of the history then"""
    needed_s: float
    """healthy running after that before the next attempt"""


class LearningSchedule:
    """The schedule of one tray."""

    def __init__(self, history: HealthyHistory, operation: OrdinaryOperation, first_minutes: float) -> None:
        """operation: what the fans have done in the history. first_minutes: of healthy running, for the first
        version."""
        self._history = history
        self._operation = operation
        self._first_s = 60.0 * first_minutes
        self.started: Work = "version"
        """what was started last"""
        self._failures: dict[Work, _Failure] = {}

    @property
    def failures(self) -> list[str]:
        """Why the last version and the last check failed, if they did."""
        return [failure.why for failure in self._failures.values()]

    def failed(self, why: str) -> None:
        """What was started last has failed."""
        needed_s = max(min(AGAIN_AFTER * self._history.seconds, AGAIN_AFTER_AT_MOST_S), SHORTEST_RECORDING_S)
        self._failures[self.started] = _Failure(why, self._history.end_t_ns, needed_s)

    def succeeded(self) -> None:
        """What was started last has been done."""
        self._failures.pop(self.started, None)

    def due(self, listed: VersionList) -> Work | None:
        """What is due: a version, or a check of the fans against the reference."""
        if self._is_version_due(listed) and self._may_try("version"):
            return "version"
        return "check" if self._is_check_due(listed) and self._may_try("check") else None

    def _may_try(self, work: Work) -> bool:
        """Whether there is enough healthy running since an attempt that failed."""
        failure = self._failures.get(work)
        return failure is None or self._history.seconds_since(failure.end_t_ns) >= failure.needed_s

    def _is_version_due(self, listed: VersionList) -> bool:
        since = self._history.seconds_since
        if not listed.versions:
            return self._history.seconds >= self._first_s and not self._operation.missing()
        last = listed.versions[-1]
        if listed.is_tainted:
            return self._history.seconds >= self._first_s
        if listed.commissioned_t_ns > last.made_t_ns:
            return since(listed.commissioned_t_ns) >= AFTER_COMMISSIONING_S
        return not listed.waiting and since(last.made_t_ns) >= min(last.learned_s, LONGEST_WAIT_S)

    def _is_check_due(self, listed: VersionList) -> bool:
        if not listed.versions:
            return False
        checked_t_ns = listed.check.t_ns if listed.check else 0
        newest_t_ns = max(listed.versions[-1].made_t_ns, listed.commissioned_t_ns, checked_t_ns)
        return self._history.seconds_since(newest_t_ns) >= CHECK_AFTER_S

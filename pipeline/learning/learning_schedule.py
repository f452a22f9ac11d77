"""When the next version of a tray's twin is due or its fans are to be checked, and the child process that does it.

Only recordings outside the excluded time spans count: versions and checks are made from no others. Running near alarms
counts for checks only: whether most fans have changed alike is seen there, too.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

from fantwin.pipeline.learning.child_command import ChildCommand
from fantwin.pipeline.learning.healthy_history import KEPT_S, HealthyHistory
from fantwin.pipeline.learning.history_recordings import SHORTEST_RECORDING_S
from fantwin.pipeline.learning.ordinary_operation import OrdinaryOperation
from fantwin.pipeline.learning.versions import VersionList

_TURN = threading.Lock()
"""one tray learns at a time, to limit memory and processor use"""
STOP_S = 2.0


class LearningProcess:
    """`fantwin twins learn` for one tray of a configuration, as a child process.

    It runs while nothing else does, one at a time in this process.
    """

    def __init__(self, tray_words: Sequence[str], log: Path) -> None:
        """tray_words: the options that name configuration and tray. log: file for what the last run said."""
        self._tray_words = tray_words
        self._child = ChildCommand(_TURN, log)

    @property
    def is_free(self) -> bool:
        """Whether no tray of this process is learning."""
        return self._child.is_free

    def start(self, *, only_if_changed: bool) -> str:
        """Begin, if it is free; returns what went wrong, or nothing. only_if_changed: see `fantwin twins check`."""
        problem = self._child.begin(["twins", "check" if only_if_changed else "learn", *self._tray_words])
        return f"`fantwin twins learn`: {problem}" if problem else ""

    def poll(self) -> str | None:
        """None while it works; then, once, what went wrong, or an empty string."""
        status = self._child.ended()
        if not status:
            return None if status is None else ""
        return self._child.last_line or f"`fantwin twins learn` ended with status {status}"

    @property
    def seconds(self) -> float | None:
        """How long it has been working; None: it is not."""
        return self._child.seconds

    def stop(self) -> None:
        """End it; no version is made."""
        if not self._child.end(STOP_S):
            self._child.kill()


Work: TypeAlias = Literal["version", "check"]

FIRST_S = 600.0
"""of healthy running before the first version: a shorter one shows too little of slow changes, such as of the air"""
CHECK_AFTER_S = 24 * 3600.0
"""of healthy running between two checks of the fans against the reference; of all running if much was near alarms"""
COMMISSIONED_CHECK_S = 4000.0
"""of running of one kind, healthy or near alarms, after fans were commissioned again until they are checked: a little
more than a check needs. If the twin no longer fits them, they have one alarm after the other"""
AFTER_COMMISSIONING_S = 4 * 3600.0
"""of healthy running after fans were commissioned again until a version is made"""
AGAIN_AFTER = 0.25
"""after a failure, running before the next attempt, as a share of the history: healthy running for a version, all for a
check"""
AGAIN_AFTER_AT_MOST_S = 24 * 3600.0
"""of running before the next attempt"""


@dataclass(frozen=True)
class _Failure:
    """A version or a check that could not be made."""

    why: str
    end_t_ns: int
    """of the history then"""
    needed_s: float
    """running after that before the next attempt"""
    listed: VersionList
    """when it was begun"""


class LearningSchedule:
    """The schedule of one tray."""

    def __init__(self, history: HealthyHistory, operation: OrdinaryOperation) -> None:
        """operation: what the fans have done in the history."""
        self._history = history
        self._operation = operation
        self._started: Work = "version"
        self._listed = VersionList()
        """when that was started"""
        self._failures: dict[Work, _Failure] = {}

    @property
    def work(self) -> Work:
        """What was started last."""
        return self._started

    @property
    def failures(self) -> list[str]:
        """Why the last version and the last check failed, if they did."""
        return [failure.why for failure in self._failures.values()]

    def started(self, work: Work, listed: VersionList) -> None:
        """A version or a check is being made. listed: the versions before it."""
        self._started, self._listed = work, listed

    def failed(self, why: str) -> None:
        """What was started last has failed."""
        history_s = self._running_s(self._started, 0)
        needed_s = max(min(AGAIN_AFTER * history_s, AGAIN_AFTER_AT_MOST_S), SHORTEST_RECORDING_S)
        self._failures[self._started] = _Failure(why, self._history.end_t_ns, needed_s, self._listed)

    def succeeded(self) -> None:
        """What was started last has been done."""
        self._failures.pop(self._started, None)

    def forget_what_is_over(self, listed: VersionList) -> None:
        """Forget failures that a later version has ended, or a later check, whoever has made it. A check is part of
        each version."""
        for work, failure in list(self._failures.items()):
            has_version = len(listed.versions) > len(failure.listed.versions)
            if has_version or (work == "check" and listed.check != failure.listed.check):
                del self._failures[work]

    def due(self, listed: VersionList, *, has_alarm: bool) -> Work | None:
        """What is due: a version, or a check of the fans against the reference. No version is made while a fan has an
        alarm."""
        if not has_alarm and self.version_wait_s(listed) == 0.0:
            return "version"
        return "check" if self._is_check_due(listed) and not self._retry_wait_s("check") else None

    def version_wait_s(self, listed: VersionList) -> float | None:
        """Healthy running until the next version is due; None if it waits for something else: for fans to be moved, or
        for what becomes of one that is offered."""
        needed_s = self._needed_s(listed)
        return None if needed_s is None else max(needed_s, self._retry_wait_s("version"), 0.0)

    def _retry_wait_s(self, work: Work) -> float:
        """Running before the next attempt at what failed; 0: it may be made now."""
        failure = self._failures.get(work)
        if failure is None:
            return 0.0
        return max(failure.needed_s - self._running_s(work, failure.end_t_ns), 0.0)

    def _running_s(self, work: Work, since_t_ns: int) -> float:
        """Running since a time that counts for such work."""
        healthy_s = self._history.seconds_since(since_t_ns)
        return healthy_s + self._history.seconds_near_alarms_since(since_t_ns) if work == "check" else healthy_s

    def _needed_s(self, listed: VersionList) -> float | None:
        """As `version_wait_s`, but not above 0 where a version is due, and without failures."""
        since = self._history.seconds_since
        if not listed.versions:
            return None if self._operation.missing() else FIRST_S - self._history.seconds
        last = listed.versions[-1]
        if listed.is_tainted:
            return FIRST_S - self._history.seconds
        if listed.commissioned_t_ns > last.made_t_ns:
            return AFTER_COMMISSIONING_S - since(listed.commissioned_t_ns)
        return None if listed.waiting else min(last.learned_s, KEPT_S) - since(last.made_t_ns)

    def _is_check_due(self, listed: VersionList) -> bool:
        if not listed.versions:
            return False
        newest_t_ns, commissioned_t_ns = listed.newest_t_ns, listed.commissioned_t_ns
        near_t_ns = max(newest_t_ns, listed.check.near_t_ns if listed.check else 0)
        near_s = self._history.seconds_near_alarms_since(near_t_ns)
        is_near_due = near_s >= COMMISSIONED_CHECK_S and (
            near_t_ns == commissioned_t_ns or self._running_s("check", near_t_ns) >= CHECK_AFTER_S
        )
        needed_s = COMMISSIONED_CHECK_S if newest_t_ns == commissioned_t_ns else CHECK_AFTER_S
        return is_near_due or self._history.seconds_since(newest_t_ns) >= needed_s

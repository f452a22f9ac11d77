"""The alarm conditions of a tray's fans, updated with what was decided at the end of each bin.

Where nothing was judged no state changes; only shelving times run on, and after some time an active alarm becomes
stale.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self

import numpy as np

from fantwin.schemas.enums import Action, Severity, Transition
from fantwin.schemas.messages import Array
from fantwin.scoring.alarms.alarm_state import DATA_LOST_AFTER_NS, UNTIL_IT_CLEARS_T_NS, AlarmState, FanCondition
from fantwin.scoring.column_state import NEVER_NS
from fantwin.scoring.saved import Times


@dataclass(frozen=True)
class AlarmEvent:
    """A transition of a fan's alarm, and the alarm's state after it."""

    fan: int
    transition: Transition
    alarm_state: AlarmState


@dataclass(frozen=True, eq=False)
class Decided:
    """Decisions at a time, (fans,) each."""

    t_ns: int
    judged: Array
    """true where there was a decision; elsewhere the rest means nothing"""
    active: Array
    severity: Array
    """value of schemas.enums.Severity, where an alarm is active"""
    onset_t_ns: Array
    """start of the fault of an active alarm"""
    every_ns: int
    """time between two decisions"""


@dataclass(eq=False)
class AlarmsOfTray:
    """Conditions of a tray, one for each fan."""

    conditions: list[FanCondition]
    judged_t_ns: Times
    """(fans,) time when each was judged last"""

    def __post_init__(self) -> None:
        """Raises ValueError, OverflowError: there are others of fans or of times."""
        if len(self.judged_t_ns) != len(self.conditions):
            raise ValueError(f"times of {len(self.judged_t_ns)} fans, and alarms of {len(self.conditions)}")
        self._refresh_all()

    @classmethod
    def begin(cls, fans: int) -> Self:
        """Conditions of fans whose alarms were never raised."""
        return cls([FanCondition() for _ in range(fans)], np.full(fans, NEVER_NS, np.int64))

    def update(self, now: Decided) -> list[AlarmEvent]:
        """Process a decision; returns the events, sorted by fan."""
        judged, since_ns = now.judged, now.t_ns - self.judged_t_ns
        longest_ns = max(DATA_LOST_AFTER_NS, now.every_ns * 3 // 2)
        lost = self._active & (self.judged_t_ns != NEVER_NS) & (since_ns > longest_ns)
        unshelved = self._shelved_until_t_ns <= now.t_ns
        events: list[AlarmEvent] = []
        for fan in np.flatnonzero(lost | unshelved | (judged & (self._active | now.active))).tolist():
            condition = self.conditions[fan]
            transitions = list(condition.lose_data()) if lost[fan] else []
            if unshelved[fan]:
                transitions.append(condition.unshelve())
            if judged[fan]:
                severity = Severity(int(now.severity[fan]))
                transitions += condition.update(
                    active=bool(now.active[fan]), severity=severity, onset_t_ns=int(now.onset_t_ns[fan])
                )
            events += [AlarmEvent(fan, *transition) for transition in transitions]
            self._refresh(fan)
        self.judged_t_ns = np.where(judged, now.t_ns, self.judged_t_ns)
        return events

    def request(
        self,
        action: Action,
        fans: Iterable[int],
        now_t_ns: int,
        duration_ns: float = 0,
        operator_name: str = "",
        comment: str = "",
        onset_t_ns: int = 0,
    ) -> list[tuple[int, Transition, str]]:
        """Process an operator's request. For each fan: the transition and "", or REFUSED and the reason.

        now_t_ns: time of the last sample; a shelving ends `duration_ns` later, or with 0 once the alarm has cleared.
        onset_t_ns: see `onset_meant`.
        """
        answers: list[tuple[int, Transition, str]] = []
        for fan in fans:
            if not 0 <= fan < len(self.conditions):
                answers.append((fan, Transition.REFUSED, f"there are fans 0 to {len(self.conditions) - 1}"))
                continue
            answer = self.conditions[fan].request(action, now_t_ns, duration_ns, operator_name, comment, onset_t_ns)
            answers.append((fan, *answer))
            self._refresh(fan)
        return answers

    def onset_meant(self, fan: int, onset_t_ns: int) -> int:
        """The onset of the alarm of a fan that feedback is about, see FanCondition.onset_meant."""
        return self.conditions[fan].onset_meant(onset_t_ns)

    @property
    def active(self) -> Array:
        """Return which fans have an active alarm, (fans,)."""
        return self._active.copy()

    def alarm_state(self, fan: int) -> AlarmState:
        """The present state of a fan's alarm."""
        return self.conditions[fan].alarm_state

    def discard_all(self, *, keep_silenced: bool) -> None:
        """Return all alarms to never raised. keep_silenced: shelved and out of service stay as set."""
        for condition in self.conditions:
            condition.discard(keep_silenced=keep_silenced)
        self._refresh_all()

    def _refresh_all(self) -> None:
        self._active = np.zeros(len(self.conditions), np.bool_)
        self._shelved_until_t_ns = np.full(len(self.conditions), UNTIL_IT_CLEARS_T_NS, np.int64)
        for fan in range(len(self.conditions)):
            self._refresh(fan)

    def _refresh(self, fan: int) -> None:
        """Keep the columns by which `update` finds the fans to process; it skips the others."""
        condition = self.conditions[fan]
        self._active[fan] = condition.alarm_state.active
        self._shelved_until_t_ns[fan] = condition.alarm_state.shelved_until_t_ns or UNTIL_IT_CLEARS_T_NS

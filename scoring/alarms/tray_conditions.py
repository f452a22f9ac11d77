"""The alarm conditions of a tray's fans, updated with blocks of samples.

The result does not depend on how samples are cut into blocks: delays count the time of valid samples, and every event
carries the alarm's state at its own row. An invalid sample changes no state and no timer; only shelving times run on.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from schemas.messages import Action, Array, FanState, Transition
from scoring.alarms.fan_condition import (
    NORMAL,
    SUSPECT,
    UNTIL_IT_CLEARS_T_NS,
    AlarmState,
    ConditionSettings,
    FanCondition,
)

UNKNOWN = int(FanState.UNKNOWN)


@dataclass(frozen=True)
class AlarmEvent:
    """A transition of a fan's alarm at a row of a block, and the alarm's state after it."""

    row: int
    fan: int
    transition: Transition
    alarm_state: AlarmState


@dataclass(frozen=True)
class BlockResult:
    """The result of a block. state: (n, fans) uint8, the FanState after each sample, UNKNOWN where it is invalid."""

    state: Array
    events: list[AlarmEvent]
    """sorted by row, then fan"""
    too_short: int
    """number of excursions that ended before their on-delay"""


class TrayConditions:
    """One condition for each fan of a tray."""

    def __init__(self, fans: int, settings: ConditionSettings) -> None:
        self._settings = settings
        self._conditions = [FanCondition(settings) for _ in range(fans)]
        self._refresh_all()

    def update(self, t_ns: Array, period_ns: int, ratio: Array, valid: Array) -> BlockResult:
        """Process a block. t_ns: (n,), rising; ratio, valid: (n, fans), see `Condition.update`."""
        state = np.where(valid, NORMAL, UNKNOWN).astype(np.uint8)
        events: list[AlarmEvent] = []
        too_short = 0
        busy = self._not_normal | ((ratio > 1) & valid).any(axis=0)
        for fan in np.flatnonzero(busy | (self._shelved_until_t_ns <= t_ns[-1])).tolist():
            condition = self._conditions[fan]
            unshelve_row = int(np.searchsorted(t_ns, self._shelved_until_t_ns[fan]))
            rows = np.flatnonzero(valid[:, fan]) if busy[fan] else np.zeros(0, np.intp)
            samples = zip(rows.tolist(), t_ns[rows].tolist(), ratio[rows, fan].tolist(), strict=True)
            for row, sample_t_ns, sample_ratio in samples:
                if row >= unshelve_row:
                    events.append(AlarmEvent(unshelve_row, fan, *condition.unshelve()))
                    unshelve_row = len(t_ns)
                before = condition.fan_state
                transitions = condition.update(sample_t_ns, period_ns, sample_ratio)
                events += [AlarmEvent(row, fan, *transition) for transition in transitions]
                state[row, fan] = condition.fan_state
                too_short += before == SUSPECT and condition.fan_state == NORMAL
            if unshelve_row < len(t_ns):
                events.append(AlarmEvent(unshelve_row, fan, *condition.unshelve()))
            self._refresh(fan)
        events.sort(key=lambda event: (event.row, event.fan))
        return BlockResult(state, events, too_short)

    def request(
        self,
        action: Action,
        fans: Iterable[int],
        now_t_ns: int,
        duration_ns: float = 0,
        operator_name: str = "",
        comment: str = "",
    ) -> list[tuple[int, Transition, str]]:
        """Process an operator's request. For each fan: the transition and "", or REFUSED and the reason.

        now_t_ns: time of the last sample; a shelving ends `duration_ns` later, or with 0 once the alarm has cleared.
        """
        answers: list[tuple[int, Transition, str]] = []
        for fan in fans:
            if not 0 <= fan < len(self._conditions):
                answers.append((fan, Transition.REFUSED, f"there are fans 0 to {len(self._conditions) - 1}"))
                continue
            answer = self._conditions[fan].request(action, now_t_ns, duration_ns, operator_name, comment)
            answers.append((fan, *answer))
            self._refresh(fan)
        return answers

    def alarm_state(self, fan: int) -> AlarmState:
        """The present state of a fan's alarm."""
        return self._conditions[fan].alarm_state

    def discard_all(self, *, keep_silenced: bool) -> None:
        """Return all alarms to never raised. keep_silenced: shelved, suppressed, out of service stay as set."""
        for condition in self._conditions:
            condition.discard(keep_silenced=keep_silenced)
        self._refresh_all()

    def snapshot(self) -> dict[str, Any]:
        """The whole state, as JSON values."""
        return {"fans": [condition.snapshot() for condition in self._conditions]}

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a snapshot. Nothing has changed if this raises.

        Raises:
            ValueError: it is not a snapshot of alarm conditions, or one of another number of fans.
        """
        try:
            conditions = [FanCondition.restore(self._settings, each) for each in snapshot["fans"]]
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
            raise ValueError(f"not a snapshot of alarm conditions: {error!r}") from error
        if len(conditions) != len(self._conditions):
            raise ValueError(f"a snapshot of {len(conditions)} fans, here are {len(self._conditions)}")
        self._conditions = conditions
        self._refresh_all()

    def _refresh_all(self) -> None:
        self._not_normal = np.zeros(len(self._conditions), np.bool_)
        self._shelved_until_t_ns = np.full(len(self._conditions), UNTIL_IT_CLEARS_T_NS, np.int64)
        for fan in range(len(self._conditions)):
            self._refresh(fan)

    def _refresh(self, fan: int) -> None:
        """Keep the columns by which `update` finds the fans to process sample by sample; it skips the others."""
        condition = self._conditions[fan]
        self._not_normal[fan] = condition.fan_state != NORMAL
        self._shelved_until_t_ns[fan] = condition.alarm_state.shelved_until_t_ns or UNTIL_IT_CLEARS_T_NS

"""The alarm conditions of a tray's fans over blocks of samples.

The same whatever the blocks: delays count the time of valid samples, and every change says how the alarm stood at
its own row. A sample that is not valid leaves state and timers alone; only the time of a shelving runs on.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from schemas.messages import Action, Array, FanState, Transition
from scoring.alarms.alarm_state import NORMAL, SUSPECT, UNTIL_IT_CLEARS_T_NS, AlarmState, Condition, ConditionSettings

UNKNOWN = int(FanState.UNKNOWN)


@dataclass(frozen=True)
class AlarmEvent:
    """What happened to the alarm of a fan at a row of a block, and how it stood then."""

    row: int
    fan: int
    transition: Transition
    standing: AlarmState


@dataclass(frozen=True)
class BlockResult:
    """What a block did. state: (n, fans) uint8 of FanState after each sample, UNKNOWN where it is not valid.

    `changes` are sorted by row, then fan; `too_short` counts excursions that ended before their on-delay.
    """

    state: Array
    changes: list[AlarmEvent]
    too_short: int


class Conditions:
    """One condition for each fan of a tray."""

    def __init__(self, fans: int, settings: ConditionSettings) -> None:
        self._settings = settings
        self._conditions = [Condition(settings) for _ in range(fans)]
        self._note_all()

    def update(self, t_ns: Array, period_ns: int, ratio: Array, valid: Array) -> BlockResult:
        """Take a block. t_ns: (n,), rising; ratio, valid: (n, fans), see `Condition.take`."""
        state = np.where(valid, NORMAL, UNKNOWN).astype(np.uint8)
        changes: list[AlarmEvent] = []
        too_short = 0
        busy = self._not_normal | ((ratio > 1) & valid).any(axis=0)
        for fan in np.flatnonzero(busy | (self._shelved_until_t_ns <= t_ns[-1])).tolist():
            condition = self._conditions[fan]
            over_row = int(np.searchsorted(t_ns, self._shelved_until_t_ns[fan]))  # where the time of shelving is over
            rows = np.flatnonzero(valid[:, fan]) if busy[fan] else np.zeros(0, np.intp)
            samples = zip(rows.tolist(), t_ns[rows].tolist(), ratio[rows, fan].tolist(), strict=True)
            for row, time_ns, furthest in samples:
                if row >= over_row:
                    changes.append(AlarmEvent(over_row, fan, *condition.expire()))
                    over_row = len(t_ns)
                was = condition.state
                changes += [
                    AlarmEvent(row, fan, *happened) for happened in condition.take(time_ns, period_ns, furthest)
                ]
                state[row, fan] = condition.state
                too_short += was == SUSPECT and condition.state == NORMAL
            if over_row < len(t_ns):
                changes.append(AlarmEvent(over_row, fan, *condition.expire()))
            self._note(fan)
        changes.sort(key=lambda change: (change.row, change.fan))
        return BlockResult(state, changes, too_short)

    def request(
        self,
        action: Action,
        fans: Iterable[int],
        now_t_ns: int,
        duration_ns: float = 0,
        operator_name: str = "",
        comment: str = "",
    ) -> list[tuple[int, Transition, str]]:
        """What an operator asks of some fans: for each what then happened, or REFUSED and why.

        now_t_ns: the last sample taken; a shelving ends `duration_ns` later, or with 0 once the alarm has cleared.
        """
        answers: list[tuple[int, Transition, str]] = []
        for fan in fans:
            if not 0 <= fan < len(self._conditions):
                answers.append((fan, Transition.REFUSED, f"there are fans 0 to {len(self._conditions) - 1}"))
                continue
            asked = self._conditions[fan].request(action, now_t_ns, duration_ns, operator_name, comment)
            answers.append((fan, *asked))
            self._note(fan)
        return answers

    def standing(self, fan: int) -> AlarmState:
        """How a fan's alarm stands now."""
        return self._conditions[fan].standing

    def forget(self, *, stays_quiet: bool) -> None:
        """No alarm was ever raised; what operators want quiet may stay so."""
        for condition in self._conditions:
            condition.forget(stays_quiet=stays_quiet)
        self._note_all()

    def snapshot(self) -> dict[str, Any]:
        """All that must not be forgotten, as JSON takes it."""
        return {"fans": [condition.snapshot() for condition in self._conditions]}

    def restore(self, kept: Mapping[str, Any]) -> None:
        """Go on from a snapshot; without it nothing has changed when this raises.

        Raises:
            ValueError: it is no snapshot, or one of another number of fans.
        """
        try:
            conditions = [Condition.restored(self._settings, each) for each in kept["fans"]]
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise ValueError(f"not a snapshot of alarm conditions: {error!r}") from error
        if len(conditions) != len(self._conditions):
            raise ValueError(f"a snapshot of {len(conditions)} fans, here are {len(self._conditions)}")
        self._conditions = conditions
        self._note_all()

    def _note_all(self) -> None:
        self._not_normal = np.zeros(len(self._conditions), np.bool_)
        self._shelved_until_t_ns = np.full(len(self._conditions), UNTIL_IT_CLEARS_T_NS, np.int64)
        for fan in range(len(self._conditions)):
            self._note(fan)

    def _note(self, fan: int) -> None:
        """Which fans need a look, sample by sample: the others are normal, and time takes nothing from them."""
        condition = self._conditions[fan]
        self._not_normal[fan] = condition.state != NORMAL
        self._shelved_until_t_ns[fan] = condition.standing.shelved_until_t_ns or UNTIL_IT_CLEARS_T_NS

"""The alarm conditions of a tray's fans, updated with blocks of samples.

The result does not depend on how samples are cut into blocks: delays count the time of valid samples, and every event
carries the alarm's state at its own row. An invalid sample changes no state and no timer; only shelving times run on,
and after some time without a valid sample the delays end and an active alarm becomes stale.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from schemas.enums import Action, FanState, Transition
from schemas.messages import Array
from scoring.alarms.fan_condition import (
    NORMAL,
    SUSPECT,
    UNTIL_IT_CLEARS_T_NS,
    AlarmState,
    ConditionSettings,
    FanCondition,
)
from scoring.alarms.return_rule import ReturnEvidence

UNKNOWN = int(FanState.UNKNOWN)
NEVER_NS = -(1 << 62)
_DATA_LOST, _UNSHELVE, _SAMPLE = range(3)  # what may happen at a row, in this order


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
        self._last_valid_t_ns = np.full(fans, NEVER_NS, np.int64)
        self._refresh_all()

    def update(
        self,
        t_ns: Array,
        period_ns: int,
        ratio: Array,
        valid: Array,
        ratios: Array,
        speed_rad_s: Array,
    ) -> BlockResult:
        """Process a block. t_ns: (n,), rising; ratio, valid: (n, fans), see `Condition.update`.

        ratios (n, detectors, fans) and speed_rad_s (n, fans): see ReturnEvidence.
        """
        state = np.where(valid, np.uint8(NORMAL), np.uint8(UNKNOWN))
        events: list[AlarmEvent] = []
        too_short = 0
        busy = self._not_normal | ((ratio > 1) & valid).any(axis=0)
        unshelved = self._shelved_until_t_ns <= t_ns[-1]
        for fan in np.flatnonzero(busy | unshelved).tolist():
            condition = self._conditions[fan]
            rows = np.flatnonzero(valid[:, fan]) if busy[fan] else np.zeros(0, np.intp)
            samples = zip(ratios[rows, :, fan].tolist(), speed_rad_s[rows, fan].tolist(), strict=True)
            evidence = dict(zip(rows.tolist(), (ReturnEvidence(*sample) for sample in samples), strict=True))
            steps = [(row, _SAMPLE) for row in rows.tolist()]
            if busy[fan]:
                steps += [(row, _DATA_LOST) for row in self._data_lost_rows(fan, t_ns, rows)]
            if unshelved[fan]:
                steps.append((int(np.searchsorted(t_ns, self._shelved_until_t_ns[fan])), _UNSHELVE))
            for row, step in sorted(steps):
                before = condition.fan_state
                if step == _DATA_LOST:
                    transitions = condition.lose_data()
                elif step == _UNSHELVE:
                    transitions = (condition.unshelve(),)
                else:
                    transitions = condition.update(int(t_ns[row]), period_ns, float(ratio[row, fan]), evidence[row])
                    state[row, fan] = condition.fan_state
                events += [AlarmEvent(row, fan, *transition) for transition in transitions]
                too_short += before == SUSPECT and condition.fan_state == NORMAL
            self._refresh(fan)
        last_valid_t_ns = np.where(valid, t_ns[:, np.newaxis], NEVER_NS).max(axis=0)
        self._last_valid_t_ns = np.maximum(last_valid_t_ns, self._last_valid_t_ns)
        events.sort(key=lambda event: (event.row, event.fan))
        return BlockResult(state, events, too_short)

    def _data_lost_rows(self, fan: int, t_ns: Array, rows: Array) -> list[int]:
        """At which rows a fan has been without a valid sample for too long; rows: those with one."""
        limit_ns = self._settings.data_lost_after_ns
        if self._last_valid_t_ns[fan] == NEVER_NS:
            return []
        if t_ns[-1] - self._last_valid_t_ns[fan] <= limit_ns:
            return []
        since_t_ns = np.concatenate((self._last_valid_t_ns[fan : fan + 1], t_ns[rows]))
        lost = np.searchsorted(t_ns, since_t_ns + limit_ns, side="right")
        return lost[lost <= np.append(rows, len(t_ns) - 1)].tolist()

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
            if not 0 <= fan < len(self._conditions):
                answers.append((fan, Transition.REFUSED, f"there are fans 0 to {len(self._conditions) - 1}"))
                continue
            answer = self._conditions[fan].request(action, now_t_ns, duration_ns, operator_name, comment, onset_t_ns)
            answers.append((fan, *answer))
            self._refresh(fan)
        return answers

    def onset_meant(self, fan: int, onset_t_ns: int) -> int:
        """The onset of the alarm of a fan that feedback is about, see FanCondition.onset_meant."""
        return self._conditions[fan].onset_meant(onset_t_ns)

    @property
    def active(self) -> Array:
        """(fans,) whether each fan's alarm is active."""
        return self._active.copy()

    @property
    def is_quiet(self) -> bool:
        """Whether the state of each fan is normal, and no alarm is active."""
        return not (self._not_normal.any() or self._active.any())

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
        return {
            "fans": [condition.snapshot() for condition in self._conditions],
            "last_valid_t_ns": self._last_valid_t_ns.tolist(),
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Continue from a snapshot. Nothing has changed if this raises.

        Raises:
            ValueError: it is not a snapshot of alarm conditions, or one of another number of fans.
        """
        try:
            conditions = [FanCondition.restore(self._settings, each) for each in snapshot["fans"]]
            last_valid_t_ns = np.array(snapshot["last_valid_t_ns"], np.int64)
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
            raise ValueError(f"not a snapshot of alarm conditions: {error!r}") from error
        if not len(conditions) == len(last_valid_t_ns) == len(self._conditions):
            raise ValueError(f"a snapshot of {len(conditions)} fans, here are {len(self._conditions)}")
        self._conditions, self._last_valid_t_ns = conditions, last_valid_t_ns
        self._refresh_all()

    def _refresh_all(self) -> None:
        self._not_normal = np.zeros(len(self._conditions), np.bool_)
        self._active = np.zeros(len(self._conditions), np.bool_)
        self._shelved_until_t_ns = np.full(len(self._conditions), UNTIL_IT_CLEARS_T_NS, np.int64)
        for fan in range(len(self._conditions)):
            self._refresh(fan)

    def _refresh(self, fan: int) -> None:
        """Keep the columns by which `update` finds the fans to process sample by sample; it skips the others."""
        condition = self._conditions[fan]
        self._active[fan] = condition.alarm_state.active
        self._not_normal[fan] = condition.fan_state != NORMAL
        self._shelved_until_t_ns[fan] = condition.alarm_state.shelved_until_t_ns or UNTIL_IT_CLEARS_T_NS

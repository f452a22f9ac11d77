"""The alarm condition of one fan: the state of its alarm, including the actions of operators.

Names and rules are those of OPC UA Part 9 (OPC 10000-9, release 1.05.03): ActiveState (5.8.2), AckedState of one
occurrence (4.3, 5.7), timed and one-shot shelving (5.8.17), out of service (5.8.12). Only the present occurrence is
kept; there are no branches of earlier ones (as in B.1.2). What operators say of an alarm, that it was true or false,
is not of Part 9. See docs/reference/alarms.md.

Whether an alarm needs attention is defined here alone: `is_retained`, `is_silenced`, `is_presented`, `is_listed`. The
scorer's `AlarmState` and the `Alarm` message carry the same flags; both are accepted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from fantwin.schemas.enums import Action, Feedback, Severity, Transition
from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import NS_PER_S


def is_retained(alarm: Alarm | AlarmState) -> bool:
    """Return whether the alarm still needs attention (Retain, 5.5.2): active or unacknowledged."""
    return alarm.active or not alarm.acknowledged


def is_silenced(alarm: Alarm | AlarmState) -> bool:
    """Return whether an operator has silenced the alarm (SuppressedOrShelved, 5.8.2): shelved or out of service."""
    return bool(alarm.shelved_until_t_ns) or alarm.out_of_service


def is_presented(alarm: Alarm | AlarmState) -> bool:
    """Return whether operators should see the alarm: retained and not silenced."""
    return is_retained(alarm) and not is_silenced(alarm)


def is_listed(alarm: Alarm | AlarmState) -> bool:
    """Return whether the alarm belongs on a list of current alarms: retained or silenced."""
    return is_retained(alarm) or is_silenced(alarm)


UNTIL_IT_CLEARS_T_NS = 2**63 - 1
"""`shelved_until_t_ns` of a one-shot shelving: until the alarm clears or is unshelved."""
ONSET_TOLERANCE_NS = NS_PER_S
"""tolerance of the onset by which an operator names an alarm: people read it in seconds, and a browser rounds it"""
GIVES_FEEDBACK = {
    Action.TRUE_ALARM: (Transition.MARKED_TRUE, Feedback.TRUE_ALARM),
    Action.FALSE_ALARM: (Transition.MARKED_FALSE, Feedback.FALSE_ALARM),
}


DATA_LOST_AFTER_NS = 2 * NS_PER_S
"""an active alarm is stale after a longer time in which nothing was judged"""
EARLIER_ALARMS = 32
"""number of earlier alarms of each fan whose onsets are kept for feedback"""


@dataclass(frozen=True, slots=True)
class AlarmState:
    """The state of a fan's alarm. The defaults are those of an alarm that was never raised."""

    active: bool = False
    severity: Severity = Severity.NONE
    """highest since the alarm was raised; NONE if it never was"""
    onset_t_ns: int = 0
    """probable start of the alarm's fault; identifies the occurrence"""
    acknowledged: bool = True
    shelved_until_t_ns: int = 0
    """0: not shelved"""
    out_of_service: bool = False
    stale: bool = False
    """the state is that of before a gap: no sample has confirmed it since"""
    acknowledged_by: str = ""
    comment: str = ""
    """comment of the last granted request that had one, feedback apart"""
    feedback: Feedback = Feedback.NONE
    """the last one on this occurrence"""
    feedback_by: str = ""
    feedback_reason: str = ""


@dataclass
class FanCondition:
    """Alarm of one fan, as a condition of OPC UA Part 9."""

    alarm_state: AlarmState = AlarmState()
    earlier_onsets_t_ns: tuple[int, ...] = ()
    """onsets of the alarms before the present one, oldest first"""

    def update(self, *, active: bool, severity: Severity, onset_t_ns: int) -> Sequence[tuple[Transition, AlarmState]]:
        """Process what was decided, on data; returns the transitions, in order.

        active, severity: as they are now. onset_t_ns: of the fault that raises an alarm.
        """
        if not self.alarm_state.active:
            return self._raised(severity, onset_t_ns) if active else ()
        found: list[tuple[Transition, AlarmState]] = []
        if self.alarm_state.stale:
            self.alarm_state = replace(self.alarm_state, stale=False)
            found.append((Transition.DATA_RESTORED, self.alarm_state))
        if not active:
            return (*found, *self._cleared())
        if severity > self.alarm_state.severity:
            self.alarm_state = replace(self.alarm_state, severity=severity)
            found.append((Transition.SEVERITY, self.alarm_state))
        return found

    def _raised(self, severity: Severity, onset_t_ns: int) -> Sequence[tuple[Transition, AlarmState]]:
        self._keep_onset()
        self.alarm_state = replace(
            self.alarm_state,
            active=True,
            severity=severity,
            onset_t_ns=onset_t_ns,
            acknowledged=False,
            stale=False,
            acknowledged_by="",
            feedback=Feedback.NONE,
            feedback_by="",
            feedback_reason="",
        )
        return ((Transition.RAISED, self.alarm_state),)

    def _cleared(self) -> Sequence[tuple[Transition, AlarmState]]:
        self.alarm_state = replace(self.alarm_state, active=False)
        cleared = (Transition.CLEARED, self.alarm_state)
        if self.alarm_state.shelved_until_t_ns != UNTIL_IT_CLEARS_T_NS:
            return (cleared,)
        return cleared, self.unshelve()

    def lose_data(self) -> Sequence[tuple[Transition, AlarmState]]:
        """Make an active alarm stale: nothing has been judged for too long."""
        if not self.alarm_state.active or self.alarm_state.stale:
            return ()
        self.alarm_state = replace(self.alarm_state, stale=True)
        return ((Transition.DATA_LOST, self.alarm_state),)

    def discard(self, *, keep_silenced: bool) -> None:
        """Return to an alarm that was never raised. keep_silenced: shelved and out of service stay as set, and
        operators may still give feedback on the alarms of before."""
        self._keep_onset()
        if not keep_silenced:
            self.earlier_onsets_t_ns = ()
        before, self.alarm_state = self.alarm_state, AlarmState()
        if keep_silenced:
            self.alarm_state = AlarmState(
                shelved_until_t_ns=before.shelved_until_t_ns,
                out_of_service=before.out_of_service,
                comment=before.comment,
            )

    def unshelve(self) -> tuple[Transition, AlarmState]:
        """End the shelving because its time is over."""
        self.alarm_state = replace(self.alarm_state, shelved_until_t_ns=0)
        return Transition.UNSHELVED, self.alarm_state

    def onset_meant(self, onset_t_ns: int) -> int:
        """The onset of the alarm that feedback is about, ns: of the one nearest to `onset_t_ns` within the tolerance,
        or of the last one where that is 0. 0: there is none."""
        known = (*self.earlier_onsets_t_ns, *self._own_onset())
        if not onset_t_ns:
            return known[-1] if known else 0
        nearest = min(known, key=lambda each: abs(each - onset_t_ns), default=0)
        return nearest if abs(nearest - onset_t_ns) <= ONSET_TOLERANCE_NS else 0

    def request(
        self,
        action: Action,
        now_t_ns: int,
        duration_ns: float,
        operator_name: str,
        comment: str,
        onset_t_ns: int = 0,
    ) -> tuple[Transition, str]:
        """Process an operator's request. Returns the transition and "", or REFUSED and the reason.

        onset_t_ns: of the alarm that feedback is about, see `onset_meant`.
        """
        if action in GIVES_FEEDBACK:
            return self._take_feedback(action, operator_name, comment, onset_t_ns)
        refusal = self._refusal(action, now_t_ns, duration_ns, comment)
        if refusal:
            return Transition.REFUSED, refusal
        timed = action == Action.SHELVE and duration_ns  # other actions ignore the duration, which may be NaN
        until_t_ns = now_t_ns + round(duration_ns) if timed else UNTIL_IT_CLEARS_T_NS
        granted: dict[Action, tuple[Transition, dict[str, Any]]] = {
            Action.ACKNOWLEDGE: (
                Transition.ACKNOWLEDGED,
                {"acknowledged": True, "acknowledged_by": operator_name},
            ),
            Action.SHELVE: (Transition.SHELVED, {"shelved_until_t_ns": until_t_ns}),
            Action.UNSHELVE: (Transition.UNSHELVED, {"shelved_until_t_ns": 0}),
            Action.OUT_OF_SERVICE: (Transition.OUT_OF_SERVICE, {"out_of_service": True}),
            Action.IN_SERVICE: (Transition.IN_SERVICE, {"out_of_service": False}),
            Action.COMMISSION: (Transition.COMMISSIONING, {}),
            Action.COMMENT: (Transition.COMMENTED, {}),
        }
        transition, changed = granted[action]
        self.alarm_state = replace(self.alarm_state, **changed, comment=comment or self.alarm_state.comment)
        return transition, ""

    def _own_onset(self) -> tuple[int, ...]:
        """The onset of the present occurrence, if an alarm was raised."""
        return () if self.alarm_state.severity == Severity.NONE else (self.alarm_state.onset_t_ns,)

    def _keep_onset(self) -> None:
        """The present occurrence becomes an earlier one."""
        known = (*self.earlier_onsets_t_ns, *self._own_onset())
        self.earlier_onsets_t_ns = known[-EARLIER_ALARMS:]

    def _take_feedback(
        self, action: Action, operator_name: str, reason: str, onset_t_ns: int
    ) -> tuple[Transition, str]:
        """Keep an operator's mark on the present occurrence; a mark on an earlier one is only in its message."""
        meant_t_ns = self.onset_meant(onset_t_ns)
        if not meant_t_ns:
            began = "no alarm began then, or too many have been raised since"
            return Transition.REFUSED, began if onset_t_ns else "no alarm has been raised"
        if action == Action.FALSE_ALARM and not reason.strip():
            return Transition.REFUSED, "a false alarm needs a reason: add a comment"
        transition, feedback = GIVES_FEEDBACK[action]
        if (meant_t_ns,) == self._own_onset():
            self.alarm_state = replace(
                self.alarm_state, feedback=feedback, feedback_by=operator_name, feedback_reason=reason
            )
        return transition, ""

    def _refusal(self, action: Action, now_t_ns: int, duration_ns: float, comment: str) -> str:
        """Why the request must be refused; empty if it is granted."""
        now = self.alarm_state
        once = now.shelved_until_t_ns == UNTIL_IT_CLEARS_T_NS and duration_ns == 0
        fits = 0 <= duration_ns < UNTIL_IT_CLEARS_T_NS - now_t_ns  # NaN does not
        raised = now.severity != Severity.NONE
        unknown = ((True, f"there is no such action: {int(action)}"),)
        reasons: dict[Action, tuple[tuple[bool, str], ...]] = {
            Action.ACKNOWLEDGE: (
                (not raised, "no alarm has been raised"),
                (now.acknowledged, "it is acknowledged already"),
            ),
            Action.SHELVE: (
                (not fits, "it cannot be shelved for such a time"),
                (once, "it is shelved until it clears already"),
            ),
            Action.UNSHELVE: ((not now.shelved_until_t_ns, "it is not shelved"),),
            Action.OUT_OF_SERVICE: ((now.out_of_service, "it is out of service already"),),
            Action.IN_SERVICE: ((not now.out_of_service, "it is in service already"),),
            Action.COMMISSION: (),
            Action.COMMENT: (
                (not raised, "no alarm has been raised"),
                (not comment.strip(), "there is no comment"),
            ),
            Action.NONE: ((True, "no action is named"),),
        }
        return next((reason for applies, reason in reasons.get(action, unknown) if applies), "")

"""The alarm condition of one fan: whether an alarm is active, and what operators have said of it.

Names and rules are those of OPC UA Part 9 (OPC 10000-9, release 1.05.03): ActiveState with OnDelay and OffDelay
(5.8.2), AckedState and ConfirmedState of one occurrence (4.3, 5.7; the rows of table B.1 are a test), LatchedState and
Reset (4.8, 5.8.5), shelving by time or once (5.8.17), suppressed (5.8.8), out of service (5.8.12).
Only the present occurrence is kept, no branches of former ones (as in B.1.2). See docs/reference/alarms.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Self

import numpy as np

from schemas.messages import Action, FanState, Severity, Transition

NORMAL, SUSPECT, ALARM, RETURNING = map(int, (FanState.NORMAL, FanState.SUSPECT, FanState.ALARM, FanState.RETURNING))
UNTIL_IT_CLEARS_T_NS = 2**63 - 1
"""`shelved_until_t_ns` of a one-shot shelving: until the alarm clears or is unshelved."""


@dataclass(frozen=True)
class ConditionSettings:
    """When an alarm is raised and cleared, and what it then asks of operators. Ratios are in the statistic's limit."""

    on_delay_ns: int
    off_delay_ns: int
    return_ratio: float = 0.75
    """An active alarm begins to return below this share of its limit."""
    alarm_ratio: float = 1.5
    """From here on its severity is ALARM and no longer WARNING."""
    latching: bool = False
    """A cleared alarm stays until it is reset."""
    confirming: bool = False
    """An acknowledged alarm needs confirming, too."""


@dataclass(frozen=True, slots=True)
class AlarmState:
    """How an alarm stands; what it is before it was ever raised are the defaults."""

    active: bool = False
    severity: Severity = Severity.NONE
    """The highest since it was raised; NONE: it never was."""
    onset_t_ns: int = 0
    """First sample of the excursion that raised it: names the occurrence."""
    acknowledged: bool = True
    confirmed: bool = True
    """False from an acknowledgement on that needs confirming."""
    latched: bool = False
    shelved_until_t_ns: int = 0
    """0: not shelved."""
    suppressed: bool = False
    out_of_service: bool = False
    acknowledged_by: str = ""
    comment: str = ""
    """Of the last request that had one and was granted."""


class Condition:
    """One fan's alarm. `state`: NORMAL, SUSPECT (on-delay runs), ALARM, RETURNING (off-delay runs)."""

    def __init__(self, settings: ConditionSettings) -> None:
        self._settings = settings
        self.state = NORMAL
        self.standing = AlarmState()
        self._excursion_t_ns = 0  # its first sample; meaningless when NORMAL
        self._lasted_ns = 0  # how long the condition of SUSPECT or RETURNING has held

    def take(self, t_ns: int, period_ns: int, ratio: float) -> Sequence[tuple[Transition, AlarmState]]:
        """Take a valid sample: the statistic furthest towards its limit, in that limit. What happened, in order."""
        if self.standing.active:
            return self._while_active(period_ns, ratio)
        if not ratio > 1:
            self.state = NORMAL
            return ()
        if self.state == NORMAL:
            self._excursion_t_ns = t_ns
        self._lasted_ns = 0 if self.state == NORMAL else self._lasted_ns + period_ns
        if self._lasted_ns < self._settings.on_delay_ns:
            self.state = SUSPECT
            return ()
        self.state = ALARM
        self.standing = replace(
            self.standing,
            active=True,
            severity=self._severity(ratio),
            onset_t_ns=self._excursion_t_ns,
            acknowledged=False,
            confirmed=True,  # nothing to confirm before it is acknowledged, see table B.1
            latched=self._settings.latching,
            acknowledged_by="",
        )
        return ((Transition.RAISED, self.standing),)

    def forget(self, *, stays_quiet: bool) -> None:
        """No alarm was ever raised; what operators want quiet may stay so."""
        was, self.state, self.standing = self.standing, NORMAL, AlarmState()
        if stays_quiet:
            self.standing = AlarmState(
                shelved_until_t_ns=was.shelved_until_t_ns,
                suppressed=was.suppressed,
                out_of_service=was.out_of_service,
                comment=was.comment,
            )

    def expire(self) -> tuple[Transition, AlarmState]:
        """The time of shelving is over."""
        self.standing = replace(self.standing, shelved_until_t_ns=0)
        return Transition.UNSHELVED, self.standing

    def request(
        self, action: Action, now_t_ns: int, duration_ns: float, operator_name: str, comment: str
    ) -> tuple[Transition, str]:
        """What an operator asks for: what then happened, or REFUSED and why."""
        invalid_reason = self._why_not(action, now_t_ns, duration_ns)
        if invalid_reason:
            return Transition.REFUSED, invalid_reason
        timed = action == Action.SHELVE and duration_ns  # of others it is whatever somebody sent, NaN even
        until_t_ns = now_t_ns + round(duration_ns) if timed else UNTIL_IT_CLEARS_T_NS
        confirmed = not self._settings.confirming
        granted: dict[Action, tuple[Transition, dict[str, Any]]] = {
            Action.ACKNOWLEDGE: (
                Transition.ACKNOWLEDGED,
                {"acknowledged": True, "confirmed": confirmed, "acknowledged_by": operator_name},
            ),
            Action.CONFIRM: (Transition.CONFIRMED, {"confirmed": True}),
            Action.RESET: (Transition.RESET, {"latched": False}),
            Action.SHELVE: (Transition.SHELVED, {"shelved_until_t_ns": until_t_ns}),
            Action.UNSHELVE: (Transition.UNSHELVED, {"shelved_until_t_ns": 0}),
            Action.SUPPRESS: (Transition.SUPPRESSED, {"suppressed": True}),
            Action.UNSUPPRESS: (Transition.UNSUPPRESSED, {"suppressed": False}),
            Action.OUT_OF_SERVICE: (Transition.OUT_OF_SERVICE, {"out_of_service": True}),
            Action.IN_SERVICE: (Transition.IN_SERVICE, {"out_of_service": False}),
            Action.COMMISSION: (Transition.COMMISSIONING, {}),
        }
        transition, changed = granted[action]
        self.standing = replace(self.standing, **changed, comment=comment or self.standing.comment)
        return transition, ""

    def snapshot(self) -> dict[str, Any]:
        """All that it must not forget, as JSON takes it."""
        kept = asdict(self.standing)
        del kept["active"]  # the state says so
        kept["severity"] = int(self.standing.severity)
        return {"state": self.state, "excursion_t_ns": self._excursion_t_ns, "lasted_ns": self._lasted_ns, **kept}

    @classmethod
    def restored(cls, settings: ConditionSettings, kept: Mapping[str, Any]) -> Self:
        """The condition whose snapshot this is.

        Raises:
            KeyError, TypeError, ValueError, OverflowError: it is none.
        """
        condition = cls(settings)
        condition.state = int(FanState.known(kept["state"]))
        if condition.state not in (NORMAL, SUSPECT, ALARM, RETURNING):
            raise ValueError(kept["state"])
        condition._excursion_t_ns = _time(kept["excursion_t_ns"])
        condition._lasted_ns = _time(kept["lasted_ns"])
        condition.standing = AlarmState(
            active=condition.state in (ALARM, RETURNING),
            severity=Severity.known(kept["severity"]),
            onset_t_ns=_time(kept["onset_t_ns"]),
            shelved_until_t_ns=_time(kept["shelved_until_t_ns"]),
            acknowledged=bool(kept["acknowledged"]),
            confirmed=bool(kept["confirmed"]),
            latched=bool(kept["latched"]),
            suppressed=bool(kept["suppressed"]),
            out_of_service=bool(kept["out_of_service"]),
            acknowledged_by=str(kept["acknowledged_by"]),
            comment=str(kept["comment"]),
        )
        return condition

    def _while_active(self, period_ns: int, ratio: float) -> Sequence[tuple[Transition, AlarmState]]:
        if not ratio < self._settings.return_ratio:
            self.state = ALARM
            severity = self._severity(ratio)
            if severity <= self.standing.severity:
                return ()
            self.standing = replace(self.standing, severity=severity)
            return ((Transition.SEVERITY, self.standing),)
        self._lasted_ns = 0 if self.state == ALARM else self._lasted_ns + period_ns
        if self._lasted_ns < self._settings.off_delay_ns:
            self.state = RETURNING
            return ()
        self.state = NORMAL
        self.standing = replace(self.standing, active=False)
        cleared = (Transition.CLEARED, self.standing)
        if self.standing.shelved_until_t_ns != UNTIL_IT_CLEARS_T_NS:
            return (cleared,)
        return cleared, self.expire()

    def _severity(self, ratio: float) -> Severity:
        return Severity.ALARM if ratio >= self._settings.alarm_ratio else Severity.WARNING

    def _why_not(self, action: Action, now_t_ns: int, duration_ns: float) -> str:
        now = self.standing
        once = now.shelved_until_t_ns == UNTIL_IT_CLEARS_T_NS and duration_ns == 0
        fits = 0 <= duration_ns < UNTIL_IT_CLEARS_T_NS - now_t_ns  # NaN does not
        raised = now.severity != Severity.NONE
        unknown = ((True, f"there is no such action: {int(action)}"),)
        reasons: dict[Action, tuple[tuple[bool, str], ...]] = {
            Action.ACKNOWLEDGE: (
                (not raised, "no alarm has been raised"),
                (now.acknowledged, "it is acknowledged already"),
            ),
            Action.CONFIRM: (
                (not now.acknowledged, "it must be acknowledged first"),
                (now.confirmed, "there is nothing to confirm"),
            ),
            Action.RESET: (
                (not now.latched, "it is not latched"),
                (now.active, "it is still active"),
                (not now.acknowledged, "it must be acknowledged first"),
                (not now.confirmed, "it must be confirmed first"),
            ),
            Action.SHELVE: (
                (not fits, "it cannot be shelved for such a time"),
                (once, "it is shelved until it clears already"),
            ),
            Action.UNSHELVE: ((not now.shelved_until_t_ns, "it is not shelved"),),
            Action.SUPPRESS: ((now.suppressed, "it is suppressed already"),),
            Action.UNSUPPRESS: ((not now.suppressed, "it is not suppressed"),),
            Action.OUT_OF_SERVICE: ((now.out_of_service, "it is out of service already"),),
            Action.IN_SERVICE: ((not now.out_of_service, "it is in service already"),),
            Action.COMMISSION: (),
            Action.NONE: ((True, "no action is named"),),
        }
        return next((why for applies, why in reasons.get(action, unknown) if applies), "")


def _time(value: Any) -> int:
    return int(np.int64(value))

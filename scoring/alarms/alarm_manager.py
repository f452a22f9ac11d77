"""The alarms of a tray as messages: each transition with what the fault takes and, if known, the causes."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Protocol

import numpy as np

from fantwin.schemas.enums import Severity, Statistic, Transition
from fantwin.schemas.fields import OpenEnum
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Array, Diagnosis, Request
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.alarm_state import AlarmState, is_listed
from fantwin.scoring.alarms.alarm_text import AlarmText
from fantwin.scoring.alarms.alarms_of_tray import AlarmsOfTray, Decided
from fantwin.scoring.diagnosis.ranked_causes import says_more
from fantwin.scoring.saved import Flags

AGAIN_AFTER_S = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512)
"""times after an alarm was raised, or has another kind, at which its causes are looked at again; then each time the
last one has passed"""
OF_SPEED = (Statistic.DEVIATION, Statistic.STANDSTILL)
"""one kind of alarm; each other statistic is a kind"""
AT_ONCE_NS = 60 * NS_PER_S
"""alarms of several fans that begin within this time may have one reason"""
MAX_REQUESTERS = 64  # the latest whose requests are remembered; docs/reference/alarms.md gives the consequences


@dataclass(frozen=True, kw_only=True)
class Measured:
    """The fields of an alarm that describe its fan at a time."""

    residual_rad_s: float
    residual_std_rad_s: float
    torque_balance_command: float
    torque_balance_std_command: float
    statistic: Statistic
    score: float


class FanFacts(Protocol):
    """Facts about the fans of a tray at the end of a bin."""

    def statistic(self, fan: int) -> Statistic:
        """Statistic that an alarm of a fan is about now."""
        ...

    def measured(self, fan: int) -> Measured:
        """Measurements of a fan with an alarm."""
        ...

    def causes(self, fan: int, known: tuple[Diagnosis, ...] = ()) -> tuple[Diagnosis, ...]:
        """Causes of its alarm, most probable first. known: those that the alarm has."""
        ...

    @property
    def stands_against_command(self) -> Array:
        """Return which fans stand or turn against their command, (fans,)."""
        ...


@dataclass(eq=False)
class AlarmsState:
    """State of the alarms of a tray."""

    conditions: AlarmsOfTray
    stood: Flags
    """(fans,) true where a fan stood or turned against its command at the last look"""
    due_t_ns: dict[int, list[int]] = field(default_factory=dict)
    """times at which the causes of each alarm are looked at again"""
    last_emitted: dict[int, Alarm] = field(default_factory=dict)
    """the last message about each fan"""
    answered: dict[str, int] = field(default_factory=dict)
    """sequence of the first request that is not answered, for each producer of requests"""
    commissioned: list[int] = field(default_factory=list)
    """fans that were commissioned since the last bin: their alarms end with the next one, with or without samples"""

    def __post_init__(self) -> None:
        """Raises ValueError: it is damaged."""
        fans = range(len(self.conditions.conditions))
        named = {*self.last_emitted, *self.commissioned}
        if len(self.stood) != len(fans) or not {*self.due_t_ns} <= {*self.last_emitted} or not named <= {*fans}:
            raise ValueError("alarms of another number of fans")
        if not all(self.due_t_ns.values()) or any(fan != alarm.fan for fan, alarm in self.last_emitted.items()):
            raise ValueError("an alarm without times, or of another fan")
        states = (condition.alarm_state for condition in self.conditions.conditions)
        for each in (*states, *self.last_emitted.values()):
            for value in (getattr(each, one.name) for one in fields(each)):
                if isinstance(value, OpenEnum):
                    type(value).known(value)


class AlarmManager:
    """Keeps the alarms of a tray."""

    def __init__(self, fans: int, alarm_text: AlarmText) -> None:
        self._fans = fans
        self.state = AlarmsState(AlarmsOfTray.begin(fans), np.zeros(fans, np.bool_))
        self._alarm_text = alarm_text
        self.raised = self.cleared = 0

    @property
    def active(self) -> Array:
        """Return which fans have an active alarm, (fans,)."""
        return self.state.conditions.active

    def update(self, now: Decided, facts: FanFacts) -> list[Alarm]:
        """Process what was decided at the end of a bin; returns the messages."""
        alarms: list[Alarm] = []
        for event in self.state.conditions.update(now):
            fan, before = event.fan, self._next_message(event.fan)
            changed, measured = _state_fields(event.alarm_state), facts.measured(fan)
            if not event.alarm_state.active:
                self.cleared += event.transition == Transition.CLEARED
                self.state.due_t_ns.pop(fan, None)
                measured = replace(measured, statistic=before.statistic)  # nothing speaks for a fault any more
            elif event.transition == Transition.RAISED or (now.judged[fan] and _is_other(measured.statistic, before)):
                self.state.due_t_ns[fan] = _again_after(now.t_ns)
                changed["causes"] = facts.causes(fan)
            self.raised += event.transition == Transition.RAISED
            if event.transition != Transition.DATA_LOST:
                changed |= vars(measured)
            alarms.append(self._emit(replace(before, t_ns=now.t_ns, transition=event.transition, **changed)))
        return [*alarms, *self._diagnosed(now, facts)]

    def _diagnosed(self, now: Decided, facts: FanFacts) -> list[Alarm]:
        """The messages on causes that are news."""
        stands = facts.stands_against_command
        begins = np.flatnonzero(stands & ~self.state.stood & now.active).tolist()
        self.state.stood = stands.copy()
        due = {fan for fan, times in self.state.due_t_ns.items() if times[0] <= now.t_ns}
        for fan in due:
            left = [t_ns for t_ns in self.state.due_t_ns[fan] if t_ns > now.t_ns]
            self.state.due_t_ns[fan] = left or [now.t_ns + AGAIN_AFTER_S[-1] * NS_PER_S]
        alarms: list[Alarm] = []
        for fan in self.state.due_t_ns:
            before = self.state.last_emitted[fan]
            if not before.active or before.stale or not now.judged[fan]:
                continue
            is_other = _is_other(facts.statistic(fan), before)
            if not (is_other or fan in due or fan in begins):
                continue
            if is_other:
                self.state.due_t_ns[fan] = _again_after(now.t_ns)
            causes = facts.causes(fan, () if is_other else before.causes)
            if is_other or _is_news(causes, before.causes):
                changed = {"t_ns": now.t_ns, "transition": Transition.DIAGNOSED, "causes": causes}
                alarms.append(self._emit(replace(self._next_message(fan), **vars(facts.measured(fan)), **changed)))
        return alarms

    def answer(self, request: Request, last_t_ns: int) -> list[Alarm]:
        """Answer for each fan that a request concerns; return nothing if it was answered before.

        last_t_ns: time of the last sample, 0 for none.
        """
        if not self._is_new(request.header):
            return []
        answers = self.state.conditions.request(
            request.action,
            range(self._fans) if request.fan < 0 else (request.fan,),
            last_t_ns or request.t_ns,
            request.duration_s * NS_PER_S,
            request.operator_name,
            request.comment,
            request.onset_t_ns,
        )
        alarms: list[Alarm] = []
        for fan, transition, refusal in answers:
            exists = 0 <= fan < self._fans
            is_marked = transition in (Transition.MARKED_TRUE, Transition.MARKED_FALSE)
            alarm = replace(
                self._next_message(fan),
                t_ns=last_t_ns,
                transition=transition,
                request=f"{request.header.producer}/{request.header.sequence}",
                operator_name=request.operator_name,
                comment=request.comment,
                marked_onset_t_ns=self.state.conditions.onset_meant(fan, request.onset_t_ns) if is_marked else 0,
                **(_state_fields(self.state.conditions.alarm_state(fan)) if exists else {}),
            )
            alarms.append(self._emit(alarm, refusal) if exists else replace(alarm, message=f"{alarm.label}: {refusal}"))
        return alarms

    def republish(self) -> list[Alarm]:
        """Messages after a restart: one for each listed alarm, with the name of who acknowledged it."""
        return [self._republished(fan) for fan in self._listed()]

    def discard_all(self, t_ns: int, *, keep_silenced: bool) -> list[Alarm]:
        """Return all alarms to never raised; one message for each that was listed.

        keep_silenced: shelved and out of service stay as set.
        """
        fans = self._listed()
        self.state.conditions.discard_all(keep_silenced=keep_silenced)
        self.state.last_emitted, self.state.due_t_ns = {}, {}
        alarms: list[Alarm] = []
        for fan in fans:
            now = _state_fields(self.state.conditions.alarm_state(fan))
            self.state.last_emitted[fan] = replace(self._next_message(fan), t_ns=t_ns, **now)
            alarms.append(self._republished(fan))
        return alarms

    def _listed(self) -> list[int]:
        """Fans with a message whose alarm is retained or silenced."""
        return [fan for fan in sorted(self.state.last_emitted) if is_listed(self.state.conditions.alarm_state(fan))]

    def _republished(self, fan: int) -> Alarm:
        now = self.state.conditions.alarm_state(fan)
        alarm = replace(self._next_message(fan), transition=Transition.REPUBLISHED)
        return self._emit(replace(alarm, operator_name=now.acknowledged_by, comment=now.comment))

    def _is_new(self, header: Header) -> bool:
        """Return whether a request is not yet answered. A restarted scorer receives again what producers still hold."""
        if header.sequence < self.state.answered.get(header.producer, 0):
            return False
        self.state.answered.pop(header.producer, None)  # re-inserted at the end: the latest requesters are kept
        self.state.answered[header.producer] = header.sequence + 1
        while len(self.state.answered) > MAX_REQUESTERS:
            del self.state.answered[next(iter(self.state.answered))]
        return True

    def _next_message(self, fan: int) -> Alarm:
        """The last message about a fan without the fields of that event alone: the template of the next one."""
        last = self.state.last_emitted.get(fan) or Alarm(
            fan=fan,
            active=False,
            severity=Severity.NONE,
            t_ns=0,
            onset_t_ns=0,
            residual_rad_s=0.0,
            residual_std_rad_s=0.0,
            message="",
            acknowledged=True,
        )
        return replace(last, header=Header(), request="", operator_name="", comment="", marked_onset_t_ns=0)

    def _alike(self, alarm: Alarm) -> int:
        """Number of other fans whose alarm has the same statistic and direction and began within AT_ONCE_NS; 0 unless
        they are most of the tray."""
        found = sum(
            other.active
            and not other.stale
            and fan != alarm.fan
            and other.statistic == alarm.statistic != Statistic.MISSING_READINGS
            and _is_slower(other) == _is_slower(alarm)
            and abs(other.onset_t_ns - alarm.onset_t_ns) <= AT_ONCE_NS
            for fan, other in self.state.last_emitted.items()
        )
        return found if found >= max(2, self._fans // 2) else 0

    def _emit(self, alarm: Alarm, refusal: str = "") -> Alarm:
        is_of_size = alarm.transition in (Transition.RAISED, Transition.SEVERITY)
        message = self._alarm_text.of(alarm, refusal, self._alike(alarm) if is_of_size else 0)
        alarm = replace(alarm, message=message, fan_name=self._alarm_text.names.name(alarm.fan))
        self.state.last_emitted[alarm.fan] = alarm
        return alarm


def _again_after(t_ns: int) -> list[int]:
    """Return the times at which the causes of an alarm that begins at t_ns are looked at."""
    return [t_ns + after_s * NS_PER_S for after_s in AGAIN_AFTER_S]


def _is_other(statistic: Statistic, before: Alarm) -> bool:
    """Return whether what an alarm is about is of another kind than it was."""
    of_both = {statistic, before.statistic}
    return len(of_both) > 1 and of_both != set(OF_SPEED)


def _is_news(causes: tuple[Diagnosis, ...], than: tuple[Diagnosis, ...]) -> bool:
    """Return whether causes are worth a message."""
    return bool(causes) and says_more(causes, than)


def _is_slower(alarm: Alarm) -> bool:
    return (alarm.residual_rad_s or -alarm.torque_balance_command) < 0.0


def _state_fields(state: AlarmState) -> dict[str, Any]:
    """The fields of an alarm message that carry its state."""
    return {name: value for name, value in asdict(state).items() if name not in ("acknowledged_by", "comment")}

"""The alarms of a tray as messages: each transition with its residuals and, if known, the causes."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from schemas.enums import FanState, Feedback, Severity, Statistic, Transition
from schemas.header import Header
from schemas.messages import Alarm, Array, Diagnosis, Request, Score
from schemas.units import NS_PER_S
from scoring.alarms.alarm_flags import is_listed
from scoring.alarms.alarm_text import AlarmText
from scoring.alarms.fan_condition import AlarmState, ConditionSettings
from scoring.alarms.tray_conditions import AlarmEvent, TrayConditions
from scoring.detectors.table import row_of
from scoring.diagnosis.diagnoser import Diagnoser
from scoring.diagnosis.shown_causes import is_of_standstill

PERSISTING_SHARE = (
    0.5  # a fault persists while the torque balance is at least this share of its value in the last message
)
STANDSTILL = int(Statistic.STANDSTILL)
_OF_FEEDBACK = ("feedback", "feedback_by", "feedback_reason", "marked_onset_t_ns")
MAX_REQUESTERS = 64  # the latest whose requests are remembered; docs/reference/alarms.md gives the consequences


@dataclass(frozen=True, eq=False)
class AlarmContext:
    """How far fans are from their twins, and how far they may be."""

    balance_command: Array
    """(n, fans) less baseline"""
    limits: Callable[[int, int], tuple[float, float]]
    """at a row, of a fan: of the speed, rad/s, and of the torque balance, command; infinite for none"""


class AlarmManager:
    """Keeps the alarms of a tray and their diagnoses. The messages do not depend on how samples are cut into blocks."""

    def __init__(self, fans: int, settings: ConditionSettings, diagnoser: Diagnoser, alarm_text: AlarmText) -> None:
        self._fans = fans
        self._conditions = TrayConditions(fans, settings)
        self._diagnoser = diagnoser
        self._alarm_text = alarm_text
        self._last_emitted: dict[int, Alarm] = {}
        """the last message about each fan"""
        self._against_command = np.zeros(fans, np.bool_)
        """(fans,) whether the statistic of the last sample was that of standstill"""
        self._answered: dict[str, int] = {}
        """for each producer of requests, the sequence of the first one that is not answered"""
        self.raised = self.cleared = self.too_short = 0

    @property
    def active(self) -> Array:
        """(fans,) whether each fan's alarm is active."""
        return self._conditions.active

    @property
    def is_quiet(self) -> bool:
        """Whether no fan has an alarm or is about to have one."""
        return self._conditions.is_quiet

    def update(
        self,
        t_ns: Array,
        period_ns: int,
        score: Array,
        valid: Array,
        ratios: Array,
        speed_rad_s: Array,
    ) -> tuple[Array, list[AlarmEvent]]:
        """Process a block; see TrayConditions.update. Returns the states (n, fans) and the events."""
        result = self._conditions.update(t_ns, period_ns, score, valid, ratios, speed_rad_s)
        self.too_short += result.too_short
        return result.state, result.events

    def emit(self, events: list[AlarmEvent], score: Score, context: AlarmContext) -> list[Alarm]:
        """The messages for a block's events and diagnoses, in the order of its rows.

        The diagnoser must already have stored the block.
        """
        alarms: list[Alarm] = []

        def emit(row: int, fan: int, transition: Transition, **changed: Any) -> None:
            lost = transition == Transition.DATA_LOST
            measured = {"t_ns": int(score.t_ns[row])} if lost else _measured(row, fan, score, context)
            alarms.append(self._emit(replace(self._next_message(fan), **measured, transition=transition, **changed)))

        def causes_at(row: int, fan: int) -> tuple[Diagnosis, ...]:
            t_ns, against_command = int(score.t_ns[row]), score.statistic[row, fan] == STANDSTILL
            return (self._diagnoser.of_standstill if against_command else self._diagnoser.diagnose)(fan, t_ns)

        begins = self._standstill_begins(score)

        def diagnose_due(t_ns: Array) -> None:
            due = set(self._diagnoser.due(t_ns)) if len(t_ns) else set()
            while begins and begins[0][0] < len(t_ns):
                row, fan = begins.popleft()
                if self._is_standstill_news(fan):
                    due.add((row, fan))
            for row, fan in sorted(due):
                if self._persists(row, fan, score, context):
                    causes = causes_at(row, fan)
                    if self._diagnoser.says_more(causes, self._next_message(fan).causes):
                        emit(row, fan, Transition.DIAGNOSED, causes=causes)

        for event in events:
            diagnose_due(score.t_ns[: event.row])
            fan, changed = event.fan, _state_fields(event.alarm_state)
            if event.transition == Transition.RAISED:
                self.raised += 1
                t_ns = int(score.t_ns[event.row])
                self._diagnoser.raised(fan, t_ns, event.alarm_state.onset_t_ns)
                changed["causes"] = causes_at(event.row, fan)
            elif event.transition == Transition.SEVERITY and score.statistic[event.row, fan] == STANDSTILL:
                changed["causes"] = causes_at(event.row, fan)
            elif event.transition == Transition.CLEARED:
                self.cleared += 1
                self._diagnoser.cleared(fan)
            elif event.transition == Transition.DATA_LOST:
                self._diagnoser.cleared(fan)  # samples from after a gap may be of another state
            emit(event.row, fan, event.transition, **changed)
        diagnose_due(score.t_ns)
        return alarms

    def _standstill_begins(self, score: Score) -> deque[tuple[int, int]]:
        """Rows and fans at which the statistic becomes that of standstill."""
        now = score.statistic == STANDSTILL
        before = np.vstack((self._against_command, now))[:-1]
        self._against_command = now[-1].copy()
        return deque((row, fan) for row, fan in np.argwhere(now & ~before).tolist())

    def _is_standstill_news(self, fan: int) -> bool:
        """Whether standstill is news about a fan: its alarm is active, and no cause of standstill is named yet.

        Later starts of a fan that does not turn say less about the cause than the moment at which it came to rest.
        """
        last = self._next_message(fan)
        return last.active and not any(is_of_standstill(each) for each in last.causes)

    def _persists(self, row: int, fan: int, score: Score, context: AlarmContext) -> bool:
        """Whether the fault of the last message persists; otherwise a diagnosis would include its end."""
        if score.state[row, fan] in (FanState.STOPPED, FanState.STARTING):
            return False
        now, before = abs(context.balance_command[row, fan]), abs(self._next_message(fan).torque_balance_command)
        detector = row_of(int(score.statistic[row, fan]))
        of_tacho = detector is not None and detector.source == "tacho"
        return bool(of_tacho or not np.isfinite(now) or now >= PERSISTING_SHARE * before)

    def answer(self, request: Request, last_t_ns: int) -> list[Alarm]:
        """One answer for each fan that a request concerns; none if it was answered before.

        last_t_ns: time of the last sample, 0 for none.
        """
        if not self._is_new(request.header):
            return []
        answers = self._conditions.request(
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
                marked_onset_t_ns=self._conditions.onset_meant(fan, request.onset_t_ns) if is_marked else 0,
                **(_state_fields(self._conditions.alarm_state(fan)) if exists else {}),
            )
            alarms.append(self._emit(alarm, refusal) if exists else replace(alarm, message=f"fan {fan}: {refusal}"))
        return alarms

    def republish(self) -> list[Alarm]:
        """After a restart: one message for each listed alarm, with the name of who acknowledged it."""
        return [self._republished(fan) for fan in self._listed()]

    def discard_all(self, t_ns: int, *, keep_silenced: bool) -> list[Alarm]:
        """Return all alarms to never raised; one message for each that was listed.

        keep_silenced: shelved, suppressed and out of service stay as set.
        """
        fans = self._listed()
        self._conditions.discard_all(keep_silenced=keep_silenced)
        self._last_emitted = {}
        alarms: list[Alarm] = []
        for fan in fans:
            self._diagnoser.cleared(fan)
            fields = _state_fields(self._conditions.alarm_state(fan))
            self._last_emitted[fan] = replace(self._next_message(fan), t_ns=t_ns, **fields)
            alarms.append(self._republished(fan))
        return alarms

    def _listed(self) -> list[int]:
        """Fans with a message whose alarm is retained or silenced."""
        return [fan for fan in sorted(self._last_emitted) if is_listed(self._conditions.alarm_state(fan))]

    def _republished(self, fan: int) -> Alarm:
        now = self._conditions.alarm_state(fan)
        alarm = replace(self._next_message(fan), transition=Transition.REPUBLISHED)
        return self._emit(replace(alarm, operator_name=now.acknowledged_by, comment=now.comment))

    def snapshot(self) -> dict[str, Any]:
        """The whole state, as JSON values."""
        return {
            "conditions": self._conditions.snapshot(),
            "diagnoser": self._diagnoser.snapshot(),
            "last_emitted": {str(fan): _to_json(alarm) for fan, alarm in self._last_emitted.items()},
            "answered": self._answered,
        }

    def restore(self, stored: Mapping[str, Any]) -> None:
        """Continue from a snapshot of the same number of fans.

        Raises:
            ValueError, KeyError, TypeError, AttributeError: it is not such a snapshot.
        """
        self._conditions.restore(stored["conditions"])
        self._diagnoser.restore(stored["diagnoser"])
        self._last_emitted = {int(fan): _from_json(alarm) for fan, alarm in stored["last_emitted"].items()}
        if not all(0 <= fan < self._fans and alarm.fan == fan for fan, alarm in self._last_emitted.items()):
            raise ValueError("an alarm of a fan that does not exist")
        self._answered = {str(producer): int(sequence) for producer, sequence in stored["answered"].items()}

    def _is_new(self, header: Header) -> bool:
        """Whether a request is not yet answered. A restarted scorer receives again what producers still hold."""
        if header.sequence < self._answered.get(header.producer, 0):
            return False
        self._answered.pop(header.producer, None)  # re-inserted at the end: the latest requesters are kept
        self._answered[header.producer] = header.sequence + 1
        while len(self._answered) > MAX_REQUESTERS:
            del self._answered[next(iter(self._answered))]
        return True

    def _next_message(self, fan: int) -> Alarm:
        """The last message about a fan without the fields of that event alone: the template of the next one."""
        last = self._last_emitted.get(fan) or Alarm(
            fan=fan,
            active=False,
            severity=Severity.NONE,
            t_ns=0,
            onset_t_ns=0,
            residual_rad_s=0.0,
            limit_rad_s=0.0,
            message="",
            acknowledged=True,
            confirmed=True,
        )
        return replace(last, header=Header(), request="", operator_name="", comment="", marked_onset_t_ns=0)

    def _emit(self, alarm: Alarm, refusal: str = "") -> Alarm:
        alarm = replace(alarm, message=self._alarm_text.of(alarm, refusal))
        self._last_emitted[alarm.fan] = alarm
        return alarm


def _measured(row: int, fan: int, score: Score, context: AlarmContext) -> dict[str, Any]:
    """The fields of an alarm that describe its sample; 0 where nothing is known."""
    limit_rad_s, balance_limit_command = context.limits(row, fan)
    return {
        "t_ns": int(score.t_ns[row]),
        "residual_rad_s": float(np.nan_to_num(score.smoothed_residual_rad_s[row, fan])),
        "limit_rad_s": _finite_or_0(limit_rad_s),
        "torque_balance_command": float(np.nan_to_num(context.balance_command[row, fan])),
        "torque_balance_limit_command": _finite_or_0(balance_limit_command),
        "statistic": Statistic(int(score.statistic[row, fan])),
        "score": float(np.nan_to_num(score.score[row, fan])),
    }


def _finite_or_0(limit: float) -> float:
    return float(limit) if np.isfinite(limit) else 0.0


def _state_fields(state: AlarmState) -> dict[str, Any]:
    """The fields of an alarm message that carry its state."""
    return {
        "active": state.active,
        "severity": state.severity,
        "onset_t_ns": state.onset_t_ns,
        "acknowledged": state.acknowledged,
        "confirmed": state.confirmed,
        "latched": state.latched,
        "shelved_until_t_ns": state.shelved_until_t_ns,
        "suppressed": state.suppressed,
        "out_of_service": state.out_of_service,
        "stale": state.stale,
        "feedback": state.feedback,
        "feedback_by": state.feedback_by,
        "feedback_reason": state.feedback_reason,
    }


def _to_json(alarm: Alarm) -> dict[str, Any]:
    """The fields of an alarm. Most alarms have no feedback, so its fields are left out if they are empty."""
    return {
        name: value for name, value in asdict(alarm).items() if name != "header" and (value or name not in _OF_FEEDBACK)
    }


def _from_json(stored: Mapping[str, Any]) -> Alarm:
    return Alarm(
        **{
            **stored,
            "severity": Severity.known(stored["severity"]),
            "transition": Transition.known(stored["transition"]),
            "feedback": Feedback.known(stored.get("feedback", 0)),
            "statistic": Statistic(stored["statistic"]),  # a detector may be added before its name
            "causes": tuple(Diagnosis(**cause) for cause in stored["causes"]),
        }
    )

"""The alarms of a tray as they are told: what happened, how far the fan is from its twin, and why, if that is known."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from schemas.messages import (
    Alarm,
    Array,
    Diagnosis,
    Header,
    Request,
    Score,
    Severity,
    Statistic,
    Transition,
)
from schemas.units import NS_PER_S
from scoring.alarms.alarm_flags import is_listed
from scoring.alarms.alarm_state import AlarmState, ConditionSettings
from scoring.alarms.alarm_text import AlarmText
from scoring.alarms.tray_alarms import AlarmEvent, Conditions
from scoring.diagnosis.diagnoser import Diagnoser

STILL_THERE = 0.5  # of the torque balance that it had
MOST_PRODUCERS = 64  # of requests: so many are known, the latest; docs/reference/alarms.md tells what follows of it


@dataclass(frozen=True, eq=False)
class AlarmContext:
    """How far fans are from their twins. balance_command: (n, fans), less baseline; limits: (fans,), inf for none."""

    balance_command: Array
    limit_rad_s: Array
    balance_limit_command: Array


class AlarmManager:
    """Conditions and their diagnoses in, Alarm messages out. What it tells does not depend on how blocks are cut."""

    def __init__(self, fans: int, settings: ConditionSettings, diagnoser: Diagnoser, wording: AlarmText) -> None:
        self._fans = fans
        self._conditions = Conditions(fans, settings)
        self._diagnoser = diagnoser
        self._wording = wording
        self._told: dict[int, Alarm] = {}
        """of each fan, what was told of its alarm last"""
        self._answered: dict[str, int] = {}
        """of each producer of requests, the sequence of the first that was not answered"""
        self.raised = self.cleared = self.too_short = 0

    def states(self, t_ns: Array, period_ns: int, score: Array, valid: Array) -> tuple[Array, list[AlarmEvent]]:
        """Take a block, (n, fans) each but t_ns: the states after each sample, and the changes, for `tell`."""
        course = self._conditions.update(t_ns, period_ns, score, valid)
        self.too_short += course.too_short
        return course.state, course.changes

    def tell(self, changes: list[AlarmEvent], score: Score, distance: AlarmContext) -> list[Alarm]:
        """What happened to alarms in a block, in the order of its rows; the diagnoser has taken the block."""
        alarms: list[Alarm] = []

        def tell(row: int, fan: int, transition: Transition, **more: Any) -> None:
            now = _at(row, fan, score, distance)
            alarms.append(self._tell(replace(self._alarm(fan), **now, transition=transition, **more)))

        def diagnose_again(t_ns: Array) -> None:
            for row, fan in self._diagnoser.due(t_ns) if len(t_ns) else ():
                if self._still_there(row, fan, score, distance):
                    tell(row, fan, Transition.DIAGNOSED, causes=self._diagnoser.diagnose(fan, int(t_ns[row])))

        for change in changes:
            diagnose_again(score.t_ns[: change.row])
            fan, more = change.fan, _of_standing(change.standing)
            if change.transition == Transition.RAISED:
                self.raised += 1
                t_ns = int(score.t_ns[change.row])
                self._diagnoser.raised(fan, t_ns, change.standing.onset_t_ns)
                more["causes"] = self._diagnoser.diagnose(fan, t_ns)
            elif change.transition == Transition.CLEARED:
                self.cleared += 1
                self._diagnoser.cleared(fan)
            tell(change.row, fan, change.transition, **more)
        diagnose_again(score.t_ns)
        return alarms

    def _still_there(self, row: int, fan: int, score: Score, distance: AlarmContext) -> bool:
        """Whether what was last seen of a fault is still there: its going would be taken for part of its course."""
        now, then = abs(distance.balance_command[row, fan]), abs(self._alarm(fan).torque_balance_command)
        of_sensor = score.statistic[row, fan] == Statistic.SENSOR
        return bool(of_sensor or not np.isfinite(now) or now >= STILL_THERE * then)

    def answer(self, request: Request, last_t_ns: int) -> list[Alarm]:
        """One for every fan that a request concerns, none if it was answered before. last_t_ns: the last sample taken,
        0 for none.
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
        )
        told: list[Alarm] = []
        for fan, transition, invalid_reason in answers:
            known = 0 <= fan < self._fans
            alarm = replace(
                self._alarm(fan),
                t_ns=last_t_ns,
                transition=transition,
                request=f"{request.header.producer}/{request.header.sequence}",
                operator_name=request.operator_name,
                comment=request.comment,
                **(_of_standing(self._conditions.standing(fan)) if known else {}),
            )
            told.append(
                self._tell(alarm, invalid_reason) if known else replace(alarm, message=f"fan {fan}: {invalid_reason}")
            )
        return told

    def restate(self) -> list[Alarm]:
        """What still concerns somebody, or is kept quiet, told again after a restart; and who acknowledged it."""
        return [self._restated(fan) for fan in self._concerning()]

    def disown(self, t_ns: int, *, stays_quiet: bool) -> list[Alarm]:
        """Forget all alarms, and say so of each that concerned somebody; what operators want quiet may stay so."""
        fans = self._concerning()
        self._conditions.forget(stays_quiet=stays_quiet)
        self._told = {}
        told: list[Alarm] = []
        for fan in fans:
            self._diagnoser.cleared(fan)
            self._told[fan] = replace(self._alarm(fan), t_ns=t_ns, **_of_standing(self._conditions.standing(fan)))
            told.append(self._restated(fan))
        return told

    def _concerning(self) -> list[int]:
        """Fans whose alarm is retained, or kept quiet."""
        return [fan for fan in sorted(self._told) if is_listed(self._conditions.standing(fan))]

    def _restated(self, fan: int) -> Alarm:
        now = self._conditions.standing(fan)
        restated = replace(self._alarm(fan), transition=Transition.REPUBLISHED)
        return self._tell(replace(restated, operator_name=now.acknowledged_by, comment=now.comment))

    def snapshot(self) -> dict[str, Any]:
        """All that must not be forgotten, as JSON can hold it."""
        return {
            "conditions": self._conditions.snapshot(),
            "diagnoser": self._diagnoser.snapshot(),
            "told": {str(fan): _plain(alarm) for fan, alarm in self._told.items()},
            "answered": self._answered,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from a snapshot of as many fans.

        Raises:
            ValueError, KeyError, TypeError: it is not one.
        """
        self._conditions.restore(state["conditions"])
        self._diagnoser.restore(state["diagnoser"])
        self._told = {int(fan): _alarm_of(told) for fan, told in state["told"].items()}
        if not all(0 <= fan < self._fans and alarm.fan == fan for fan, alarm in self._told.items()):
            raise ValueError("an alarm of a fan that is not there")
        self._answered = {str(producer): int(following) for producer, following in state["answered"].items()}

    def _is_new(self, header: Header) -> bool:
        """Whether a request was not answered yet. A restarted scorer is given again what producers still keep."""
        following = self._answered.get(header.producer, 0)
        if header.sequence < following:
            return False
        self._answered.pop(header.producer, None)  # to the end: the latest are kept
        self._answered[header.producer] = header.sequence + 1
        while len(self._answered) > MOST_PRODUCERS:
            del self._answered[next(iter(self._answered))]
        return True

    def _alarm(self, fan: int) -> Alarm:
        """What was told of a fan's alarm last, as the beginning of what is told next."""
        told = self._told.get(fan) or Alarm(
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
        return replace(told, header=Header(), request="", operator_name="", comment="")

    def _tell(self, alarm: Alarm, invalid_reason: str = "") -> Alarm:
        alarm = replace(alarm, message=self._wording.of(alarm, invalid_reason))
        self._told[alarm.fan] = alarm
        return alarm


def _at(row: int, fan: int, score: Score, distance: AlarmContext) -> dict[str, Any]:
    """What an alarm says of its row; 0 where nothing is known."""
    return {
        "t_ns": int(score.t_ns[row]),
        "residual_rad_s": float(np.nan_to_num(score.smoothed_residual_rad_s[row, fan])),
        "limit_rad_s": _if_any(distance.limit_rad_s[fan]),
        "torque_balance_command": float(np.nan_to_num(distance.balance_command[row, fan])),
        "torque_balance_limit_command": _if_any(distance.balance_limit_command[fan]),
        "statistic": Statistic(int(score.statistic[row, fan])),
        "score": float(np.nan_to_num(score.score[row, fan])),
    }


def _if_any(limit: float) -> float:
    return float(limit) if np.isfinite(limit) else 0.0


def _of_standing(standing: AlarmState) -> dict[str, Any]:
    return {
        "active": standing.active,
        "severity": standing.severity,
        "onset_t_ns": standing.onset_t_ns,
        "acknowledged": standing.acknowledged,
        "confirmed": standing.confirmed,
        "latched": standing.latched,
        "shelved_until_t_ns": standing.shelved_until_t_ns,
        "suppressed": standing.suppressed,
        "out_of_service": standing.out_of_service,
    }


def _plain(alarm: Alarm) -> dict[str, Any]:
    """As JSON can hold it."""
    return {name: value for name, value in asdict(alarm).items() if name != "header"}


def _alarm_of(plain: dict[str, Any]) -> Alarm:
    return Alarm(
        **plain
        | {
            "severity": Severity.known(plain["severity"]),
            "transition": Transition.known(plain["transition"]),
            "statistic": Statistic.known(plain["statistic"]),
            "causes": tuple(Diagnosis(**cause) for cause in plain["causes"]),
        }
    )

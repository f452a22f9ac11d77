"""An alarm message as one line for people.

The lines are part of a recording, and a replay that verifies it compares them: a changed wording makes recordings of
earlier versions differ.
"""

from __future__ import annotations

from schemas.messages import Alarm, Statistic, Transition
from schemas.units import RAD_S_PER_UNIT, SpeedUnit
from scoring.alarms.alarm_flags import is_listed

CANNOT_TELL = "cannot_tell"
CAUSES = {
    "drag_up": "more drag (airflow blocked, filter clogged)",
    "drag_down": "less drag (blade lost, airflow freer than before)",
    "friction_up": "more friction (bearing)",
    "gain_down": "less drive (supply, driver)",
    "external_torque": "an external torque (something touches the rotor)",
    "sensor_stuck": "a stuck tacho",
    "sensor_dropout": "a tacho that drops out",
    "sensor_scaling": "a tacho that counts wrongly",
    CANNOT_TELL: "cannot tell yet",
}
TRANSITIONS = {
    Transition.CLEARED: "back to normal",
    Transition.ACKNOWLEDGED: "acknowledged",
    Transition.CONFIRMED: "confirmed",
    Transition.RESET: "reset",
    Transition.SHELVED: "shelved",
    Transition.UNSHELVED: "no longer shelved",
    Transition.SUPPRESSED: "suppressed",
    Transition.UNSUPPRESSED: "no longer suppressed",
    Transition.OUT_OF_SERVICE: "out of service",
    Transition.IN_SERVICE: "in service",
    Transition.COMMISSIONING: "a new baseline is being taken",
}
"""transitions whose line does not depend on anything else"""


class AlarmText:
    """Writes alarm messages in the units of a tray."""

    def __init__(self, speed_unit: SpeedUnit, command_unit: str) -> None:
        """command_unit: empty where the twin does not name it."""
        self._speed_unit: SpeedUnit = speed_unit
        self._command_unit = command_unit or "of command"

    def of(self, alarm: Alarm, refusal: str = "") -> str:
        """The line. refusal: the reason why a request was refused."""
        fan = f"fan {alarm.fan}"
        if alarm.transition == Transition.REFUSED:
            return f"{fan}: refused: {refusal}"
        if alarm.transition == Transition.DIAGNOSED:
            return f"{fan}: {self._cause(alarm)}"
        if alarm.transition in (Transition.RAISED, Transition.SEVERITY):
            return f"{fan}: {self._deviation(alarm)}{self._cause_if_known(alarm)}"
        if alarm.transition == Transition.REPUBLISHED:
            return f"{fan}: {'still stands' if is_listed(alarm) else 'stands no longer'}"
        return f"{fan}: {TRANSITIONS[alarm.transition]}"

    def _deviation(self, alarm: Alarm) -> str:
        if alarm.statistic == Statistic.SENSOR:
            return "the tacho repeats one reading, or gives none"
        if alarm.statistic in (Statistic.SPEED_VARIANCE_GROWTH, Statistic.BALANCE_VARIANCE_GROWTH):
            return f"unsteady, {alarm.score:.1f} times the limit"
        if alarm.statistic in (Statistic.SPEED_SMOOTHED, Statistic.SPEED_DRIFT):
            side = "below" if alarm.residual_rad_s < 0 else "above"
            size, limit = self._speed(abs(alarm.residual_rad_s)), self._speed(alarm.limit_rad_s)
            return f"{size} {self._speed_unit} {side} the twin (limit {limit}){_duration(alarm)}"
        side = "more" if alarm.torque_balance_command > 0 else "less"
        size, limit = abs(alarm.torque_balance_command), alarm.torque_balance_limit_command
        return f"takes {size:.2g} {self._command_unit} {side} than a healthy one (limit {limit:.2g}){_duration(alarm)}"

    def _cause_if_known(self, alarm: Alarm) -> str:
        known = alarm.causes and alarm.causes[0].cause != CANNOT_TELL
        return f"; {self._cause(alarm)}" if known else ""

    def _cause(self, alarm: Alarm) -> str:
        if not alarm.causes:
            return "cause unknown"
        first = alarm.causes[0]
        name = CAUSES.get(first.cause, first.cause)
        if first.cause == CANNOT_TELL:
            return first.evidence or name  # the evidence begins with the name
        evidence = f": {first.evidence}" if first.evidence else ""
        return f"{name}, {100 * first.probability:.0f} %{evidence}"

    def _speed(self, speed_rad_s: float) -> str:
        speed = speed_rad_s / RAD_S_PER_UNIT[self._speed_unit]
        return f"{speed:.0f}" if speed >= 10 else f"{speed:.2g}"


def _duration(alarm: Alarm) -> str:
    return ", for long" if alarm.statistic in (Statistic.SPEED_DRIFT, Statistic.BALANCE_DRIFT) else ""

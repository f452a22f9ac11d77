"""An alarm message as one line for people.

The lines are part of a recording, and a replay that verifies it compares them. Only the line of a republished alarm,
which says no more than its flags do, is not compared.
"""

from __future__ import annotations

from dataclasses import dataclass

from fantwin.schemas.enums import FanState, InvalidReason, Severity, Statistic, Transition
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import RAD_S_PER_UNIT, SpeedUnit, short_number
from fantwin.scoring.diagnosis.causes import CANNOT_TELL, CAUSES, is_of_standstill

RETURNING = "like a healthy fan again (the alarm clears after ten seconds of it)"
STOPPED, STARTING = "stopped by its command", "starting"


def words_now(state: int, invalid_reason: int = InvalidReason.NONE) -> str:
    """Words after "now": that the fan is stopped, starting or like a healthy fan again; empty: none of these.

    An alarm may go on although the newest samples of its fan have no deviation.

    state and invalid_reason: `FanState` and `InvalidReason` of the newest sample.
    """
    if state == FanState.STOPPED or invalid_reason == InvalidReason.STOPPED:
        return STOPPED
    if state == FanState.STARTING or invalid_reason == InvalidReason.STARTING:
        return STARTING
    return RETURNING if state == FanState.RETURNING else ""


TRANSITIONS = {
    Transition.CLEARED: "back to normal",
    Transition.ACKNOWLEDGED: "acknowledged",
    Transition.SHELVED: "shelved",
    Transition.UNSHELVED: "no longer shelved",
    Transition.OUT_OF_SERVICE: "out of service",
    Transition.IN_SERVICE: "in service",
    Transition.COMMISSIONING: "what was learned of it is forgotten",
    Transition.DATA_LOST: "not confirmed by data: there are no samples to judge",
    Transition.DATA_RESTORED: "judged again, on new samples",
    Transition.MARKED_TRUE: "marked as a true alarm",
    Transition.MARKED_FALSE: "marked as a false alarm",
    Transition.COMMENTED: "commented on",
}
"""transitions whose line depends on nothing else"""
SIGMAS = 2.0
"""half of the interval of a size"""
CONTINUES = "the alarm continues from before the restart"
NOT_AS_COMMANDED = "does not turn or stop as commanded"


@dataclass(frozen=True)
class AlarmUnits:
    """The units of a tray."""

    speed: SpeedUnit
    command: str = ""
    """empty where the twin does not say"""

    def shown_speed(self, speed_rad_s: float) -> str:
        """A speed in the unit that people are shown, without the unit."""
        speed = speed_rad_s / RAD_S_PER_UNIT[self.speed]
        return short_number(speed, 2)

    def deviation(self, alarm: Alarm) -> str:
        """Deviation of a fan from its healthy state, by its speed or by its torque balance."""
        if alarm.residual_rad_s or not alarm.torque_balance_command:
            side = "slower" if alarm.residual_rad_s < 0 else "faster"
            size = self.shown_speed(abs(alarm.residual_rad_s))
            error = self.shown_speed(SIGMAS * alarm.residual_std_rad_s)
            return f"{size} {self.speed} {side} than when healthy (± {error})"
        side = "more" if alarm.torque_balance_command > 0 else "less"
        sizes = abs(alarm.torque_balance_command), SIGMAS * alarm.torque_balance_std_command
        size, error = (short_number(each, 2) for each in sizes)
        return f"takes {size} {self.command or 'of command'} {side} than when healthy (± {error})"


class AlarmText:
    """Writes alarm messages in the units of a tray."""

    def __init__(self, speed_unit: SpeedUnit, command_unit: str, names: FanNames = NO_NAMES) -> None:
        """command_unit: empty where the twin does not name it."""
        self.units, self.names = AlarmUnits(speed_unit, command_unit), names

    def of(self, alarm: Alarm, refusal: str = "", alike: int = 0) -> str:
        """The line. refusal: the reason why a request was refused; alike: how many other fans of the tray have a
        similar alarm, if that is most of them."""
        fan = self.names.label(alarm.fan)
        if alarm.transition == Transition.REFUSED:
            return f"{fan}: refused: {refusal}"
        if alarm.transition == Transition.DIAGNOSED:
            return f"{fan}: {self._cause(alarm)}"
        if alarm.transition in (Transition.RAISED, Transition.SEVERITY):
            others = (
                f"; {alike} other fans of the tray have the same: see what they share (supply, air)" if alike else ""
            )
            known = alarm.causes and alarm.causes[0].cause != CANNOT_TELL
            what = self._deviation(alarm) + (f"; {self._cause(alarm)}" if known else "")
            if _is_against_command(alarm):  # by how much it was slower while it fell is no news
                what = self._cause(alarm)
            return f"{fan}: {what}{others}"
        if alarm.transition == Transition.REPUBLISHED:
            return f"{fan}: {_after_restart(alarm)}"
        if alarm.marked_onset_t_ns != alarm.onset_t_ns and alarm.marked_onset_t_ns:
            return f"{fan}: an earlier alarm is {TRANSITIONS[alarm.transition]}"
        return f"{fan}: {TRANSITIONS[alarm.transition]}"

    def _deviation(self, alarm: Alarm) -> str:
        if alarm.statistic == Statistic.STANDSTILL:
            return (alarm.causes[0].evidence if alarm.causes else "") or NOT_AS_COMMANDED
        if alarm.statistic == Statistic.MISSING_READINGS:
            return "the tacho loses readings"
        deviation = self.units.deviation(alarm)
        return f"slowly, {deviation}" if alarm.statistic == Statistic.WEAR else deviation

    def _cause(self, alarm: Alarm) -> str:
        if not alarm.causes:
            return "cause unknown"
        first = alarm.causes[0]
        if _is_against_command(alarm):
            likely = (f"{CAUSES.get(each.cause, each.cause)} {100 * each.probability:.0f} %" for each in alarm.causes)
            return f"{first.evidence or NOT_AS_COMMANDED}: {', '.join(likely)}"
        name = CAUSES.get(first.cause, first.cause)
        if first.cause == CANNOT_TELL:
            return first.evidence or name  # the evidence begins with the name
        evidence = f": {first.evidence}" if first.evidence else ""
        return f"{name}, {100 * first.probability:.0f} %{evidence}"


def deviation_in(about: str) -> str:
    """The part of the line of a raised alarm that says how far the fan is off, without causes. about: see Alarm."""
    return about.partition("; ")[0].partition(": ")[0]


def _after_restart(alarm: Alarm) -> str:
    """Words on an alarm that is over: what keeps it on the list, if anything does."""
    if alarm.active:
        return CONTINUES
    kept = {
        "not acknowledged": not alarm.acknowledged,
        "shelved": bool(alarm.shelved_until_t_ns),
        "out of service": alarm.out_of_service,
    }
    before = "no alarm" if alarm.severity == Severity.NONE else "back to normal"
    return ", ".join((before, *(state for state, applies in kept.items() if applies)))


def _is_against_command(alarm: Alarm) -> bool:
    return bool(alarm.causes) and is_of_standstill(alarm.causes[0])

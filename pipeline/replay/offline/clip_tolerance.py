"""How a replay of an alarm clip may differ from what was recorded.

The scorer continues from a snapshot, which keeps the evidence of fans with a score above 0.5; that of the others begins
again (docs/explanation/deciding.md). The recorded scorer went on with it. So until an alarm nothing differs but the
score and which statistic it is of; the alarm may be raised some samples apart, and from there on the fan is known by
other numbers.
"""

from __future__ import annotations

from collections.abc import Iterable

from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import NS_PER_S

OF_EVIDENCE = frozenset({"score", "statistic", "state", "expected_residual_rad_s", "expected_balance_command"})
"""columns of scores that may differ"""
SAME = (
    *("active", "severity", "stale", "acknowledged", "confirmed", "latched"),
    *("shelved_until_t_ns", "suppressed", "out_of_service", "request", "operator_name", "comment"),
)
"""fields of alarms that may not differ"""
ALONE = (Transition.DIAGNOSED, Transition.REPUBLISHED)
APART_S, APART_SHARE = 1.0, 0.25
"""an alarm may come so much earlier or later: at most the larger one of a time and a share of the time since its
onset"""
LACKS_EVIDENCE = (
    "evidence of fans with a score below 0.5 is not in the snapshot that the clip begins with: scores may differ, "
    f"alarms may come up to {APART_S:g} s earlier or later (or {APART_SHARE:.0%} of the time since their onset), and "
    "their numbers and causes are not compared"
)


def apart_ns(alarm: Alarm) -> int:
    """How much earlier or later an alarm may come."""
    since_onset_ns = alarm.t_ns - alarm.onset_t_ns if alarm.active and alarm.onset_t_ns > 0 else 0
    return max(round(APART_S * NS_PER_S), round(APART_SHARE * since_onset_ns))


def nearest(alarm: Alarm, others: Iterable[Alarm]) -> Alarm | None:
    """The one of others, nearest in time, that is the same decision; None: there is none."""
    alike = [other for other in others if _is_same(alarm, other)]
    return min(alike, key=lambda other: abs(other.t_ns - alarm.t_ns), default=None)


def may_be_alone(alarm: Alarm, last_t_ns: int) -> bool:
    """Whether an alarm need not have its like: it names causes or is of the start from the snapshot, or the other one
    may be later than the last score."""
    return alarm.transition in ALONE or alarm.t_ns + apart_ns(alarm) >= last_t_ns


def _is_same(alarm: Alarm, other: Alarm) -> bool:
    if (alarm.fan, alarm.transition) != (other.fan, other.transition):
        return False
    is_near = abs(alarm.t_ns - other.t_ns) <= min(apart_ns(alarm), apart_ns(other))
    is_alike = all(getattr(alarm, name) == getattr(other, name) for name in SAME)
    return is_near and is_alike and (alarm.statistic == other.statistic or not alarm.active)

"""Causes of alarms in words: names, what to do, and which of them are shown. Commands read this without scipy.

A new cause is one row of `ROWS`, and a row of scoring.model.faults that says how it shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, TypeVar

from fantwin.schemas.messages import Diagnosis

MIN_PROBABILITY = 0.15
"""probability below which causes are not listed, except the first"""
CLOSE = 0.1
"""causes whose probability is at most this much below that of the first are as likely as the first"""
CANNOT_TELL = "cannot_tell"
GAIN_DOWN = "gain_down"
SENSOR_DROPOUT, UNSTEADY, SLOW_CHANGE = "sensor_dropout", "unsteady", "slow_change"
BLOCKED, NO_POWER, NO_TACHO = "blocked", "no_power", "no_tacho"
STILL_DRIVEN, WINDMILLING = "still_driven", "windmilling"


class Size(StrEnum):
    """Size of a fault: `parameter` of a diagnosis."""

    SPEED = "speed"
    DRAG = "drag"
    FRICTION = "friction"
    TORQUE = "torque against the rotation"
    GAIN = "gain"
    READING = "speed reading"
    STUCK = "repeated readings"
    MISSING = "missing readings"
    SPREAD = "spread of the speed"


@dataclass(frozen=True)
class CauseRow:
    """Cause in words. name: for people, with what the fault may be in brackets."""

    cause: str
    name: str
    to_do: str = ""
    size: Size = Size.SPEED


_FREE = "see whether the airflow is free and the filter is clean"
_LOST = "see whether a blade is missing, or a filter or cover was taken out"
_CABLE = "look at the tacho and its cable"
_CLEAN = "clean the fan and its filter; if that changes nothing, listen to the bearing"
ROWS = (
    CauseRow("drag_up", "more drag (airflow blocked, filter clogged)", _FREE, Size.DRAG),
    CauseRow("drag_down", "less drag (blade lost, airflow freer than before)", _LOST, Size.DRAG),
    CauseRow(
        "friction_up", "more friction (bearing)", "listen to the bearing, and plan to replace the fan", Size.FRICTION
    ),
    CauseRow(GAIN_DOWN, "less drive (supply, driver)", "measure the supply, and look at the driver", Size.GAIN),
    CauseRow(
        "external_torque", "an external torque (something touches the rotor)", "see what touches the rotor", Size.TORQUE
    ),
    CauseRow("sensor_stuck", "a stuck tacho", _CABLE, Size.STUCK),
    CauseRow(SENSOR_DROPOUT, "a tacho that drops out", _CABLE, Size.MISSING),
    CauseRow(
        "sensor_scaling", "a tacho that counts wrongly", "compare the speed with another tachometer", Size.READING
    ),
    CauseRow(
        UNSTEADY, "an unsteady speed (loose part or plug, gusts)", "see whether a part or a plug is loose", Size.SPREAD
    ),
    CauseRow(SLOW_CHANGE, "a slow change (dirt, a filter that clogs, a bearing that wears)", _CLEAN),
    CauseRow(BLOCKED, "blocked", "switch it off, then see what blocks the rotor"),
    CauseRow(NO_POWER, "no power", "look at its supply, fuse and plug"),
    CauseRow(NO_TACHO, "no signal of the tacho", f"see whether it turns; if it does, {_CABLE}"),
    CauseRow(STILL_DRIVEN, "still driven", "see what still commands it, and look at the driver"),
    CauseRow(WINDMILLING, "turned by the air", "it is off: see what blows air through it"),
    CauseRow(CANNOT_TELL, "cannot tell yet"),
)
CAUSES = {row.cause: row.name for row in ROWS}
"""names for people, with what the fault may be"""
WHAT_TO_DO = {row.cause: row.to_do for row in ROWS if row.to_do}
"""advice by cause; where the cause is unclear, the evidence has it"""
STANDSTILL_CAUSES = {cause: CAUSES[cause] for cause in (BLOCKED, NO_POWER, NO_TACHO, STILL_DRIVEN, WINDMILLING)}
"""causes of a fan that does not turn or stop as commanded"""


class RatedCause(Protocol):
    """Cause with its probability, as alarms and messages have it."""

    @property
    def cause(self) -> str:
        """Name of the cause, one of `CAUSES`."""
        ...

    @property
    def probability(self) -> float:
        """0 to 1."""
        ...

    @property
    def evidence(self) -> str:
        """Evidence in words; may be empty."""
        ...


AnyCause = TypeVar("AnyCause", bound=RatedCause)


def likely(causes: Sequence[AnyCause]) -> list[AnyCause]:
    """The first cause, and those that are as likely: their probability is at most `CLOSE` below that of the first.

    causes: the most probable first.
    """
    if not causes or causes[0].cause == CANNOT_TELL:
        return list(causes[:1])
    least = causes[0].probability - CLOSE - 1e-9
    return [each for each in causes if each.probability >= least]


def less_likely(causes: Sequence[AnyCause]) -> list[AnyCause]:
    """The other causes that are probable enough to be listed."""
    first = likely(causes)
    return [each for each in causes if each not in first and each.probability >= MIN_PROBABILITY]


def likely_causes(causes: Sequence[RatedCause]) -> str:
    """The likely causes for people: "blocked or no power"; empty: none is known."""
    return " or ".join(CAUSES.get(each.cause, each.cause) for each in likely(causes))


def likely_with_share(causes: Sequence[RatedCause]) -> str:
    """Likely causes for people with their probabilities: "blocked or no power, 40 % each"."""
    found = likely(causes)
    if not found or found[0].cause == CANNOT_TELL:
        return likely_causes(causes)
    shares = [f"{100 * each.probability:.0f} %" for each in found]
    if len(set(shares)) == 1:
        return f"{likely_causes(causes)}, {shares[0]}{' each' if len(found) > 1 else ''}"
    named = zip(found, shares, strict=True)
    return ", or ".join(f"{CAUSES.get(each.cause, each.cause)}, {share}" for each, share in named)


def likely_evidence(causes: Sequence[RatedCause]) -> str:
    """The evidence of the likely causes."""
    return "; ".join(dict.fromkeys(each.evidence for each in likely(causes) if each.evidence))


def advice(causes: Sequence[RatedCause]) -> str:
    """Advice on the likely causes; empty: nothing is known."""
    return "; or ".join(dict.fromkeys(WHAT_TO_DO[each.cause] for each in likely(causes) if each.cause in WHAT_TO_DO))


def short_name(cause: str) -> str:
    """The name for people, without what the fault may be."""
    return "cannot tell" if cause == CANNOT_TELL else CAUSES.get(cause, cause).partition(" (")[0]


def with_share(cause: Diagnosis) -> str:
    """Short name and probability; `cannot_tell` is shown without one, which would not add up with the others."""
    share = "" if cause.cause == CANNOT_TELL else f" {100 * cause.probability:.0f} %"
    return f"{short_name(cause.cause)}{share}"


def most_probable(causes: Sequence[Diagnosis]) -> list[str]:
    """The likely causes, each with its short name and its probability."""
    return [with_share(each) for each in likely(causes)]


def is_of_standstill(cause: Diagnosis) -> bool:
    """Return whether the cause is of a fan that does not turn or stop as commanded."""
    return cause.cause in STANDSTILL_CAUSES

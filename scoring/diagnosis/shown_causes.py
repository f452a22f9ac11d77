"""Which causes of an alarm are shown, and their names for people. Commands read this without scipy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, TypeVar

from schemas.messages import Diagnosis

MIN_PROBABILITY = 0.15
"""less probable causes are not listed, except the first"""
CLOSE = 0.1
"""causes whose probability is at most this much below that of the first are as likely as the first"""
BLOCKED, NO_POWER, NO_TACHO = "blocked", "no_power", "no_tacho"
STILL_DRIVEN, WINDMILLING = "still_driven", "windmilling"
STANDSTILL_CAUSES = {
    BLOCKED: "blocked",
    NO_POWER: "no power",
    NO_TACHO: "no signal of the tacho",
    STILL_DRIVEN: "still driven",
    WINDMILLING: "turned by the air",
}
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
    **STANDSTILL_CAUSES,
    CANNOT_TELL: "cannot tell yet",
}
"""names for people, with what the fault may be"""
WHAT_TO_DO = {
    "drag_up": "see whether the airflow is free and the filter is clean",
    "drag_down": "see whether a blade is missing, or a filter or cover was taken out",
    "friction_up": "listen to the bearing, and plan to replace the fan",
    "gain_down": "measure the supply, and look at the driver",
    "external_torque": "see what touches the rotor",
    "sensor_stuck": "look at the tacho and its cable",
    "sensor_dropout": "look at the tacho and its cable",
    "sensor_scaling": "compare the speed with another tachometer",
    "blocked": "switch it off, then see what blocks the rotor",
    "no_power": "look at its supply, fuse and plug",
    "no_tacho": "see whether it turns; if it does, look at the tacho and its cable",
    "still_driven": "see what still commands it, and look at the driver",
    "windmilling": "it is off: see what blows air through it",
}
"""by cause; what is to be done where the cause is unclear is part of the evidence"""
FALLING = "falling speed"
"""parameter of these causes while the fan still turns"""


class RatedCause(Protocol):
    """What is known about a cause."""

    @property
    def cause(self) -> str:
        """One of `CAUSES`."""
        ...

    @property
    def probability(self) -> float:
        """0 to 1."""
        ...

    @property
    def evidence(self) -> str:
        """In words; may be empty."""
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
    """The same with the probability: "blocked or no power, 40 % each"."""
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
    """What to do about the likely causes; empty: nothing is known."""
    return "; or ".join(dict.fromkeys(WHAT_TO_DO[each.cause] for each in likely(causes) if each.cause in WHAT_TO_DO))


def short_name(cause: str) -> str:
    """The name for people, without what the fault may be."""
    return "cannot tell" if cause == CANNOT_TELL else CAUSES.get(cause, cause).partition(" (")[0]


def with_share(cause: Diagnosis) -> str:
    """The short name and the probability."""
    return f"{short_name(cause.cause)} {100 * cause.probability:.0f} %"


def most_probable(causes: Sequence[Diagnosis]) -> list[str]:
    """The likely causes, each with its short name and its probability."""
    return [with_share(each) for each in likely(causes)]


def is_of_standstill(cause: Diagnosis) -> bool:
    """Whether it was named of a fan that did not turn or stop as commanded, and not while it slowed down."""
    return cause.cause in STANDSTILL_CAUSES and cause.parameter != FALLING

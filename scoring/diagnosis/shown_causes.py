"""Which causes of an alarm are shown, and their names for people. Commands read this without scipy."""

from __future__ import annotations

from collections.abc import Sequence

from schemas.messages import Diagnosis

MIN_PROBABILITY = 0.15
"""less probable causes are not listed, except the first"""
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


def short_name(cause: str) -> str:
    """The name for people, without what the fault may be."""
    return "cannot tell" if cause == CANNOT_TELL else CAUSES.get(cause, cause).partition(" (")[0]


def with_share(cause: Diagnosis) -> str:
    """The short name and the probability."""
    return f"{short_name(cause.cause)} {100 * cause.probability:.0f} %"


def most_probable(causes: Sequence[Diagnosis]) -> list[str]:
    """The most probable cause with its probability; several where these are equal in per cent."""
    return [with_share(each) for each in causes if f"{each.probability:.0%}" == f"{causes[0].probability:.0%}"]


def is_of_standstill(cause: Diagnosis) -> bool:
    """Whether it was named of a fan that did not turn or stop as commanded, and not while it slowed down."""
    return cause.cause in STANDSTILL_CAUSES and cause.parameter != FALLING

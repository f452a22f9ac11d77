"""Which causes of an alarm are shown, and the names of those of standstill. Commands read this without scipy."""

from __future__ import annotations

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
"""names for people"""
FALLING = "falling speed"
"""parameter of these causes while the fan still turns"""


def is_of_standstill(cause: Diagnosis) -> bool:
    """Whether it was named of a fan that did not turn or stop as commanded, and not while it slowed down."""
    return cause.cause in STANDSTILL_CAUSES and cause.parameter != FALLING

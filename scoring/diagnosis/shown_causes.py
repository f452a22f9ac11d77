"""Which causes of an alarm are shown, and the names of those of standstill. Commands read this without scipy."""

from __future__ import annotations

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

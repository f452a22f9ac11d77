"""Versions of the twin of a tray, as a learner lists them."""

from __future__ import annotations

from typing import Any

from fantwin.pipeline.learning.versions import Drop, Version
from fantwin.schemas.units import NS_PER_S

DAY_NS = 86_400 * NS_PER_S


def version(name: str, day: int, **other: Any) -> Version:
    """Learned from the days up to `day`."""
    fields: dict[str, Any] = {
        "name": name,
        "how": "trained",
        "made_t_ns": day * DAY_NS,
        "hours": 24.0,
        "learned_spans": tuple((each * DAY_NS, (each + 1) * DAY_NS - 1) for each in range(1, day)),
        "since_t_ns": 0,
        "speed_unit": "rpm",
        "error": 10.0,
        "change": (0.0, 0.01),
        "reference": name,
        "drops": (Drop(speed=1000.0, within_1_s=90.0, within_10_s=50.0, within_60_s=40.0),),
        "declared_per_day": 1.0,
        "is_target": False,
        "outcome": "taken",
        "why": "it is better",
        "sha256": "0" * 64,
    }
    return Version(**{**fields, **other})

"""Which detectors hold the alarms of a tray, and for how long; see scoring.alarms.return_rule."""

from __future__ import annotations

from collections.abc import Mapping

from schemas.units import NS_PER_S
from scoring.alarms.return_rule import TOGETHER_NS, HoldingDetector
from scoring.detectors.detector import Detector
from scoring.detectors.table import rows


def holding_detectors(detectors: Mapping[str, Detector], off_delay_s: float) -> tuple[HoldingDetector, ...]:
    """The detectors that decide on the return of alarms, in the order of the table. off_delay_s: their least delay."""
    made = []
    for row in rows():
        detector = detectors.get(row.name)
        own_s = detector.off_delay_s if detector else 0.0
        made.append(
            HoldingDetector(
                row.name,
                off_delay_ns=round(max(off_delay_s, own_s) * NS_PER_S),
                grows_with_speed=row.source != "tacho",
                least_off_delay_ns=round(off_delay_s * NS_PER_S),
                is_sum=row.detector.is_sum,
                standing_ns=_standing_ns(detector) if row.comes_first else 0,
            )
        )
    return tuple(made)


def _standing_ns(detector: Detector | None) -> int:
    """A stall within a start is seen after the longest start, its residual before."""
    return TOGETHER_NS + round((detector.memory_s if detector else 0.0) * NS_PER_S)

"""Which detectors hold the alarms of a tray, and for how long; see scoring.alarms.return_rule."""

from __future__ import annotations

from collections.abc import Mapping

from schemas.units import NS_PER_S
from scoring.alarms.return_rule import ELSEWHERE_NS, RETURN_SHARE, TOGETHER_NS, HoldingDetector
from scoring.detectors.detector import Detector
from scoring.detectors.table import rows


def holding_detectors(
    detectors: Mapping[str, Detector],
    off_delay_s: float,
    *,
    judges_rest: bool = True,
    knows_speeds: bool = True,
    knows_standing: bool = True,
) -> tuple[HoldingDetector, ...]:
    """What decides on the return of alarms, in the order of the table.

    off_delay_s: the least for all. judges_rest: False only to decide as for recordings made before fans at rest were
    judged and the time of a return grew with that of its alarm. knows_speeds: False only to decide as for recordings
    made when an alarm returned at any speed as soon as at those at which it came; knows_standing: False for those made
    when a standstill changed nothing of the return of residuals.
    """
    made = []
    for row in rows():
        detector = detectors.get(row.name)
        own_s = detector.off_delay_s if detector else 0.0
        made.append(
            HoldingDetector(
                row.name,
                off_delay_ns=round(max(off_delay_s, own_s) * NS_PER_S),
                grows_with_speed=row.source != "tacho",
                return_share=RETURN_SHARE if judges_rest else 0.0,
                least_off_delay_ns=round(off_delay_s * NS_PER_S),
                is_sum=row.detector.is_sum,
                standing_ns=_standing_ns(detector) if knows_standing and row.comes_first else 0,
                elsewhere_ns=ELSEWHERE_NS if knows_speeds else 0,
                is_certain=not row.only_at_rest and (detector is not None or not (judges_rest or row.came_later)),
            )
        )
    return tuple(made)


def _standing_ns(detector: Detector | None) -> int:
    """A stall within a start is seen after the longest start, its residual before."""
    return TOGETHER_NS + round((detector.memory_s if detector else 0.0) * NS_PER_S)

"""A scorer's snapshot with thirty days of wear, as `scoring.wear` writes it."""

from __future__ import annotations

import json

from schemas.header import Header
from schemas.messages import ScorerSnapshot
from scoring.wear.trend import NS_PER_DAY, WearSeries

POINTS, DAYS_OF_WEAR = 60, 30
CHANGES = {"balance": 0.002, "drag": 0.12, "friction": 0.0, "gain": -0.05}
"""of the worn fan, at the end"""


def worn_snapshot(tray: str, fans: int, worn_fan: int, t_ns: int) -> ScorerSnapshot:
    """The newest point is of `t_ns`. The other fans do not change."""
    state = {"wear": {"fans": [{"parameters": _parameters(fan == worn_fan, t_ns)} for fan in range(fans)]}}
    return ScorerSnapshot(
        header=Header("scorer", 0, tray), t_ns=t_ns, twin_sha256="", restored=False, state_json=json.dumps(state)
    )


def _parameters(worn: bool, t_ns: int) -> dict[str, dict[str, object]]:
    parameters: dict[str, dict[str, object]] = {}
    for name, change in CHANGES.items():
        series = WearSeries()
        for point in range(POINTS):
            at_ns = t_ns - round((POINTS - 1 - point) * DAYS_OF_WEAR * NS_PER_DAY / POINTS)
            series.add(at_ns, change * worn * point / (POINTS - 1), 0.01 * abs(change) + 1e-5)
        parameters[name] = {"series": {key: column.tolist() for key, column in series.snapshot().items()}}
    return parameters

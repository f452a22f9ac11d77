"""Health messages that tests make up."""

from __future__ import annotations

from typing import Any

from schemas.enums import StageStatus
from schemas.header import Header
from schemas.health import Health


def health_of(producer: str, stage: str, number: int = 0, **more: Any) -> Health:
    """The health of a stage of all trays that is well, one second after its start; more: its other fields."""
    fields = {"instance": "all", "status": StageStatus.OK, "t_ns": 1, "uptime_s": 1.0} | more
    return Health(header=Header(producer, number, ""), stage=stage, **fields)

"""Simulated recordings of healthy fans. Each seed has times of its own, as the recordings of a plant have."""

from __future__ import annotations

from pathlib import Path

from schemas.units import NS_PER_S
from tests.support.fantwin_command import fantwin

EPOCH_NS = 1_790_000_000 * NS_PER_S
FANS = 2
PER_DAY = 1500
"""false alarms that are declared: as few as two minutes can support"""


def start_ns(seed: int) -> int:
    """The first time in the recording of a seed."""
    return EPOCH_NS + seed * 1_000 * NS_PER_S


def simulated(path: Path, seed: int, seconds: float, *more: object, fans: int = FANS) -> Path:
    result = fantwin(
        "simulate", "--fans", fans, "--profile", "multisine", "--seed", seed, "--duration", seconds,
        "--epoch-ns", start_ns(seed), "--recording", path, *more,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    return path

"""How the speeds of fans have changed since a twin was made, and in words."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pipeline.cli.twins.training_data import TrainingData, twin_errors
from pipeline.cli.twins.version_data import Excerpt

if TYPE_CHECKING:
    from schemas.messages import Array

MOST_CHANGE = 0.03
"""of the speed of a fan since the reference that counts as healthy: about a seventh of what a blocked inlet or a lost
blade takes"""


def residual_of(twin: Path, data: TrainingData, *, within_range: bool = False) -> tuple[Array, Array]:
    """(samples, fans) residual of the free run and measured speed, rad/s. within_range: only at commands that it was
    trained on."""
    with twin_errors():
        # The command line loads twin only when it is needed.
        from twin.build import free_run_of  # noqa: PLC0415
        from twin.export.onnx_twin import OnnxTwin  # noqa: PLC0415

        loaded = OnnxTwin(twin)
        residual, measured, command = free_run_of(loaded, data.runs)
    if within_range:
        low, high = loaded.card.command_range
        inside = (command >= low) & (command <= high)
        residual, measured = np.where(inside, residual, np.nan), np.where(inside, measured, np.nan)
    return residual, measured


def mean_changes(twin: Path, parts: Sequence[Excerpt]) -> Array:
    """(fans,) how far the mean speed is from that of a twin, as a share of it; 0 where nothing was measured.

    parts: of the time over which the mean is taken.
    """
    found = [residual_of(twin, part.read(), within_range=True) for part in parts]
    residual, measured = (np.concatenate([each[k] for each in found]) for k in (0, 1))
    known = np.isfinite(residual) & np.isfinite(measured)
    expected = np.where(known, measured - residual, 0.0).sum(axis=0)
    moved = np.where(known, residual, 0.0).sum(axis=0)
    return np.divide(moved, expected, out=np.zeros(len(moved)), where=expected > 0.0)


def changed_fans(change: Array, reference: str) -> str:
    """What has changed more than healthy fans do, in words; empty if nothing has. change: (fans,), since the
    reference."""
    far = np.flatnonzero(np.abs(change) > MOST_CHANGE)
    if not len(far):
        return ""
    together = len(change) > 1 and np.all(np.sign(change) == np.sign(change[far[0]]))
    if together and np.min(np.abs(change)) > 0.5 * np.max(np.abs(change)):
        return (
            f"all fans are {_faster(float(np.mean(change)))} than when {reference} was made; if maintenance, a filter "
            "or new firmware is the reason, put this version in force"
        )
    named = ", ".join(f"fan {fan} is {_faster(float(change[fan]))}" for fan in far.tolist())
    inspected = "inspect it: if it is" if len(far) == 1 else "inspect them: if they are"
    return f"{named} than when {reference} was made; {inspected} healthy, put this version in force"


def _faster(change: float) -> str:
    return f"{100.0 * abs(change):.1f} % {'faster' if change > 0.0 else 'slower'}"

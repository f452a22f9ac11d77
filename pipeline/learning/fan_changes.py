"""How the speeds of fans have changed since a twin was made, and in words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fantwin.pipeline.learning.training_data import TrainingData, twin_errors
from fantwin.pipeline.learning.version_data import Excerpt, each_excerpt
from fantwin.schemas.fan_names import NO_NAMES, FanNames

if TYPE_CHECKING:
    from fantwin.schemas.messages import Array

MOST_CHANGE = 0.03
"""of the speed of a fan since the reference that counts as healthy: about a seventh of what a blocked inlet or a lost
blade takes"""
LEAST_COMPARED = 0.1
"""of the samples: a fan with fewer readings at commands that the reference was trained on is not comparable"""


def residual_of(twin: Path, data: TrainingData, *, within_range: bool = False) -> tuple[Array, Array]:
    """(samples, fans) residual of the free run and measured speed, rad/s. within_range: only at commands that it was
    trained on."""
    with twin_errors():
        # The command line loads twin only when it is needed.
        from fantwin.twin.build import free_run_of  # noqa: PLC0415
        from fantwin.twin.export.onnx_twin import OnnxTwin  # noqa: PLC0415

        loaded = OnnxTwin(twin)
        residual, measured, command = free_run_of(loaded, data.runs)
    if within_range:
        low, high = loaded.card.command_range
        inside = (command >= low) & (command <= high)
        residual, measured = np.where(inside, residual, np.nan), np.where(inside, measured, np.nan)
    return residual, measured


def mean_changes(twin: Path, parts: Sequence[Excerpt]) -> Array:
    """(fans,) how far the mean speed is from that of a twin, as a share of it; NaN where a fan is not comparable.

    parts: of the time over which the mean is taken; one at a time is in memory.

    Raises:
        UserError: they cannot be read.
    """
    of_parts = np.array([_sums(twin, data) for data in each_excerpt(parts)])
    expected, moved, known, samples = of_parts.sum(axis=0)
    comparable = (known >= LEAST_COMPARED * samples) & (expected > 0.0)
    return np.divide(moved, expected, out=np.full(len(comparable), np.nan), where=comparable)


def _sums(twin: Path, data: TrainingData) -> Array:
    """(4, fans) the sums of expected speeds and of residuals, and the numbers of these and of all samples."""
    residual, measured = residual_of(twin, data, within_range=True)
    known = np.isfinite(residual) & np.isfinite(measured)
    expected = np.where(known, measured - residual, 0.0).sum(axis=0)
    moved = np.where(known, residual, 0.0).sum(axis=0)
    return np.stack((expected, moved, known.sum(axis=0), np.full(len(moved), len(known))))


def changes_to_list(change: Array) -> tuple[float | None, ...]:
    """Changes of fans for the list of versions: None where a fan is not comparable."""
    return tuple(each if math.isfinite(each) else None for each in change.tolist())


def changes_from_list(change: Sequence[float | None]) -> Array:
    """The inverse of `changes_to_list`."""
    return np.array([math.nan if each is None else each for each in change])


def fans_changed_alike(change: Array) -> Array:
    """(n,) the fans that have changed alike, if these are most of those that can be compared, and one of them has
    changed more than healthy fans do; else none.

    change: (fans,), since the reference; NaN for a fan that is not comparable.
    """
    compared = np.flatnonzero(np.isfinite(change))
    typical = float(np.median(change[compared])) if len(compared) else 0.0
    if typical == 0.0:
        return compared[:0]
    relative = change[compared] / typical
    alike = compared[(relative > 0.5) & (relative < 2.0)]
    is_most = len(alike) > 1 and 2 * len(alike) > len(compared)
    return alike if is_most and np.abs(change[alike]).max() > MOST_CHANGE else compared[:0]


def have_most_changed_alike(change: Array) -> bool:
    """Whether most fans of a tray have changed alike, and each of them more than healthy fans do. change: as above."""
    alike = fans_changed_alike(change)
    return 2 * int(np.count_nonzero(np.abs(change[alike]) > MOST_CHANGE)) > len(change)


def changed_fans(change: Array, reference: str, names: FanNames = NO_NAMES) -> str:
    """What has changed more than healthy fans do, in words; empty if nothing has. change: as above."""
    far = np.flatnonzero(np.abs(change) > MOST_CHANGE)
    if not len(far):
        return ""
    compared, alike = np.flatnonzero(np.isfinite(change)), fans_changed_alike(change)
    if len(alike):
        others = "".join(
            f", {names.label(fan)} is {_faster(float(change[fan]))}" for fan in compared.tolist() if fan not in alike
        )
        if others:
            which = f"{len(alike)} of {len(compared)} fans"
        else:
            which = "all fans" if len(compared) == len(change) else f"all {len(compared)} fans that can be compared"
        return (
            f"{which} are {_faster(float(np.mean(change[alike])))} than when {reference} was made{others}; if "
            "maintenance, a filter or new firmware is the reason, put this version in force"
        )
    named = ", ".join(f"{names.label(fan)} is {_faster(float(change[fan]))}" for fan in far.tolist())
    inspected = "inspect it: if it is" if len(far) == 1 else "inspect them: if they are"
    return f"{named} than when {reference} was made; {inspected} healthy, put this version in force"


def _faster(change: float) -> str:
    return f"{100.0 * abs(change):.1f} % {'faster' if change > 0.0 else 'slower'}"

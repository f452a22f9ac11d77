"""Evidence of how a speed was measured, from its readings: how finely they are graded, and how often they change.

A counting tacho shows multiples of its resolution, one pulse more or less in its window, and repeats each reading until
the next count is complete. Both show in any recording in which the fan changes its speed now and then. A resolution of
q rad/s means 2 pi / q pulses per revolution and second of window: the two cannot be separated, so a fan is taken to
have the usual two pulses where the window then is no shorter than the time between changes.

A device that shows each reading for a while, however it was measured, repeats it without grading. Readings do not tell
whether it is the speed of a moment or a mean: it is taken for the former, as of chips that measure one revolution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.tacho import REVOLUTION_S, Tacho, tacho_of_each_fan
from fantwin.schemas.units import RAD_S_PER_UNIT

Array = NDArray[np.float64]

RAD_S_PER_RPM = RAD_S_PER_UNIT["rpm"]
USUAL_PULSES = 2
FEWEST_CHANGES = 20
FEWEST_LEVELS, MOST_LEVELS = 10, 2000
"""levels of readings: fewer may be multiples of something by chance, more are not graded"""
NEARLY_ALL = 0.95
PRINTED_RAD_S = 0.51 * RAD_S_PER_RPM
"""distance from a multiple that is allowed where speeds are printed in whole rpm"""
GRADED_IN_PRINTED = 8.0
"""resolution, in units of the print, below which the grading is that of the print"""
HELD_IN_STEPS = 1.5
LONGEST_STEP = 5.0
"""longest step, in median steps; the time of a change is not known across a longer one"""
SIMILAR = 0.1
CLEAR_MOVE = 3.0
"""smallest differences of readings in a move across which a reading that is not held would have shown others"""


@dataclass(frozen=True)
class TachoEvidence:
    """A tacho that would explain the readings of a fan, and what speaks for it.

    resolution_rad_s: nearly all readings are multiples of it; 0 where they are not graded. change_s: nearly all changes
    are multiples of this time apart; None where each sample may be a reading of its own.
    """

    tacho: Tacho
    resolution_rad_s: float
    change_s: float | None

    def __str__(self) -> str:
        if not self.resolution_rad_s:
            held = f"readings change every {self.change_s:.2f} s only, and are not counts"
            as_toml = (
                f"`tacho = {self.tacho.as_toml}` in [[tray]]; `window_s = {self.tacho.held_s:g}` if they are means"
            )
            return f"{held}: shown for {self.tacho.held_s:g} s ({as_toml})"
        graded = f"readings are multiples of {self.resolution_rad_s / RAD_S_PER_RPM:.3g} rpm"
        changing = f" and change every {self.change_s:.2f} s" if self.change_s else ""
        return f"{graded}{changing}: a {self.tacho} (`tacho = {self.tacho.as_toml}` in [[tray]])"


def find_tacho(t_s: Array, speed_rad_s: Array) -> TachoEvidence | None:
    """The tacho that counts, or holds its readings, for which those of a fan speak; None where they speak for neither.

    t_s: (n,) increasing. speed_rad_s: (n,), NaN where missing.
    """
    known = np.isfinite(speed_rad_s)
    t_s, speed = t_s[known], speed_rad_s[known]
    if len(speed) < FEWEST_CHANGES:
        return None
    changed = np.flatnonzero(np.diff(speed) != 0.0) + 1
    resolution = _resolution_rad_s(speed, changed)
    step_s = float(np.median(np.diff(t_s)))
    change_s = _change_s(t_s, changed, step_s)
    if resolution is None:
        return _held(t_s, speed, changed, change_s)
    if change_s is None and not _could_count(speed, changed, resolution, step_s):
        return None
    window_s = 2.0 * math.pi / (USUAL_PULSES * resolution)
    update_s = change_s if change_s is not None else window_s
    pulses = USUAL_PULSES
    if window_s < (1.0 - SIMILAR) * update_s:
        pulses = max(1, round(2.0 * math.pi / (resolution * update_s)))
        window_s = update_s
    slides = change_s is not None and update_s < (1.0 - SIMILAR) * window_s
    tacho = Tacho(
        kind="count",
        pulses=pulses,
        window_s=float(f"{window_s:.2g}"),
        update_s=float(f"{update_s:.2g}") if slides else 0.0,
    )
    return TachoEvidence(tacho, resolution, change_s)


def tacho_hints(
    t_s: Array, speed_rad_s: Array, declared: Sequence[Tacho], fans: Sequence[int], names: FanNames = NO_NAMES
) -> list[str]:
    """Hints, one line for each kind of evidence that speaks against the declared tachos.

    t_s: (n,). speed_rad_s: (n, fans). declared: one for all fans, or one for each. fans, names: for the text.
    """
    of_each = tacho_of_each_fan(declared, len(fans))
    found = [find_tacho(t_s, column) for column in speed_rad_s.T]
    lines: dict[tuple[str, str], list[int]] = {}
    for number, its, evidence in zip(fans, of_each, found, strict=True):
        if evidence is not None and not _agree(its, evidence.tacho):
            lines.setdefault((str(evidence), str(its)), []).append(number)
    return [f"{names.labels(numbers)}: {evidence}; declared is {its}" for (evidence, its), numbers in lines.items()]


def _held(t_s: Array, speed: Array, changed: NDArray[np.intp], change_s: float | None) -> TachoEvidence | None:
    """Readings that are shown for a time, without grading: nearly all clear moves come a period after the last change.

    A slow fan, and a device that reports only a larger change, move at other times, too. What a tacho shows until the
    next pulse changes with each revolution or two.
    """
    if change_s is None or change_s * float(np.median(np.abs(speed))) < 4.0 * math.pi:
        return None
    moves = np.abs(speed[changed] - speed[changed - 1])
    is_clear = moves[1:] >= CLEAR_MOVE * max(float(moves.min()), PRINTED_RAD_S)
    apart = np.diff(t_s[changed])[is_clear]
    if len(apart) < FEWEST_CHANGES or np.mean(apart <= 1.5 * change_s) < NEARLY_ALL:
        return None
    update_s = float(f"{change_s:.2g}")
    return TachoEvidence(Tacho(kind="average", window_s=REVOLUTION_S, update_s=update_s), 0.0, change_s)


def _agree(declared: Tacho, found: Tacho) -> bool:
    if not found.resolution_rad_s:
        return declared.kind == "period" or math.isclose(declared.held_s, found.held_s, rel_tol=SIMILAR)
    if declared.kind == "average" and not declared.resolution_rad_s:
        return declared.held_s > 0.0 and math.isclose(declared.held_s, found.held_s, rel_tol=SIMILAR)
    if declared.kind not in ("count", "average"):
        return False
    close = (math.isclose(getattr(declared, name), getattr(found, name), rel_tol=SIMILAR) for name in _SEEN)
    return all(close)


_SEEN = ("resolution_rad_s", "held_s")


def _resolution_rad_s(speed: Array, changed: NDArray[np.intp]) -> float | None:
    """Coarsest grading of which nearly all readings are multiples; None where it is that of the print, or none."""
    moves = np.abs(speed[changed] - speed[changed - 1])
    levels, samples = np.unique(speed, return_counts=True)
    if len(moves) < FEWEST_CHANGES or not FEWEST_LEVELS <= len(levels) <= MOST_LEVELS:
        return None
    candidates = np.unique(np.round(moves, 9))
    finest = GRADED_IN_PRINTED * PRINTED_RAD_S
    for candidate in candidates[candidates >= finest][::-1]:
        counts = np.rint(levels / candidate)
        if not np.any(counts):
            continue
        # All levels together give the resolution more precisely than one rounded move.
        resolution = float(counts @ levels / (counts @ counts))
        off = np.abs(levels - resolution * np.rint(levels / resolution))
        if samples[off <= PRINTED_RAD_S].sum() >= NEARLY_ALL * len(speed):
            return resolution
    return None


def _could_count(speed: Array, changed: NDArray[np.intp], resolution: float, step_s: float) -> bool:
    """Return whether readings that may change with each sample move no further than the pulses between two samples."""
    pulses = USUAL_PULSES / (2.0 * math.pi) * float(np.abs(speed).max()) * step_s
    moves = np.abs(speed[changed] - speed[changed - 1]) / resolution
    return bool(np.mean(moves <= pulses + 1.5) >= NEARLY_ALL)


def _change_s(t_s: Array, changed: NDArray[np.intp], step_s: float) -> float | None:
    """Time of which the times between changes are multiples; None where it is not longer than a sample."""
    if len(changed) < FEWEST_CHANGES:
        return None
    longest_step = np.maximum.reduceat(np.diff(t_s)[: changed[-1]], changed[:-1])
    apart = np.diff(t_s[changed])[longest_step <= LONGEST_STEP * step_s]
    if len(apart) < FEWEST_CHANGES:
        return None
    shortest = float(np.quantile(apart, 0.05))
    first = float(np.median(apart[apart <= 1.5 * shortest]))
    if first <= HELD_IN_STEPS * step_s:
        return None
    times = np.rint(apart / first)
    few = times <= 3.0
    period_s = float(apart[few].sum() / times[few].sum())
    # A change is seen at the next sample, and later where that is missing.
    near = np.abs(apart - period_s * times)[few] <= HELD_IN_STEPS * step_s
    return period_s if near.mean() >= NEARLY_ALL else None

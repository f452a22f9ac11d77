"""The tolerance between a replayed number and the recorded one.

Decisions are compared exactly. The last digits of numbers depend on the processor: matrix products and functions such
as tanh are computed in another order, or with another rounding, by each kernel of BLAS, NumPy and ONNX Runtime. Scores
are recorded with seven digits, so one unit in the last of them is a relative difference of up to 1.2e-7.
docs/how-to/replay.md has the differences that were measured.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from fantwin.schemas.messages import Array

RELATIVE = 1e-6
"""share of the larger of both numbers: eight units in the last digit of a recorded score"""
SPEED_RAD_S = 1e-6
"""absolute, of speeds and variances of speeds: a hundred-thousandth of a revolution a minute"""
OTHERS = 1e-9
"""absolute, of all other numbers: scores, torque balances, probabilities, sizes of faults"""
SENTENCES = frozenset({"message", "evidence"})
"""texts with numbers that are rounded from other fields; all other texts are compared exactly"""

_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


class Apart(NamedTuple):
    """A difference of two numbers."""

    share: float = 0.0
    """share of the tolerance; 0: equal"""
    name: str = ""
    difference: float = 0.0


def shares(name: str, one: Array, other: Array) -> Array:
    """The differences of unequal numbers, as shares of the tolerance for their name, which ends in their unit.

    A share is infinite if only one of both numbers is finite.
    """
    one, other = one.astype(np.float64), other.astype(np.float64)
    absolute = SPEED_RAD_S if name.endswith(("_rad_s", "variance")) else OTHERS
    with np.errstate(invalid="ignore"):
        share = np.abs(one - other) / (absolute + RELATIVE * np.maximum(np.abs(one), np.abs(other)))
    return np.where(np.isfinite(share), share, math.inf)


def differences(one: Any, other: Any, note: Callable[[Apart], None], path: tuple[str, ...] = ()) -> Iterator[str]:
    """The places in which two nested values differ by more than the tolerance: keys and list indices, joined by dots.

    Sentences are compared without their numbers, because these are rounded from numbers that are compared anyway.
    note: called with each difference within the tolerance, of an array with the largest.
    """
    if isinstance(one, dict) and isinstance(other, dict):
        for key in {**one, **other}:
            if key in one and key in other:
                yield from differences(one[key], other[key], note, (*path, key))
            else:
                yield ".".join((*path, key))
    elif isinstance(one, list | tuple) and isinstance(other, list | tuple) and len(one) == len(other):
        for number, (mine, others) in enumerate(zip(one, other, strict=True)):
            if mine != others:
                yield from differences(mine, others, note, (*path, str(number)))
    elif isinstance(one, np.ndarray) or isinstance(other, np.ndarray) or one != other:
        apart = _apart(path, one, other)
        if apart.share > 1.0:
            yield ".".join(path)
        elif apart.share:
            note(apart)


def unequal(name: str, one: Array, other: Array) -> tuple[Array, Array]:
    """Flags of the values that differ between two arrays of one shape and type, where all NaN are equal; and the share
    of the tolerance that each of these takes, infinite if they are not floats."""
    differs = one != other
    if one.dtype.kind != "f":
        return differs, np.full(int(differs.sum()), math.inf)
    differs &= ~(np.isnan(one) & np.isnan(other))
    return differs, shares(name, one[differs], other[differs])


def _arrays_apart(name: str, one: Array, other: Array) -> Apart:
    if one.shape != other.shape or one.dtype != other.dtype:
        return Apart(math.inf)
    differs, share = unequal(name, one, other)
    if not share.size:
        return Apart()
    largest = int(np.argmax(share))
    return Apart(float(share[largest]), name, abs(float(one[differs][largest]) - float(other[differs][largest])))


def _apart(path: tuple[str, ...], one: Any, other: Any) -> Apart:
    name = next((key for key in reversed(path) if not key.isdigit()), "")
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return _arrays_apart(name, one, other)
    if isinstance(one, str) and isinstance(other, str) and name in SENTENCES:
        is_alike = _NUMBER.sub("#", one) == _NUMBER.sub("#", other)
        return Apart(0.0 if is_alike else math.inf)
    if isinstance(one, float) and isinstance(other, float):
        if math.isnan(one) and math.isnan(other):
            return Apart()
        return Apart(float(shares(name, np.array(one), np.array(other))), name, abs(one - other))
    return Apart(math.inf)

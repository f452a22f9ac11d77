"""The comparison of a replay with what was recorded, within a tolerance.

Decisions are compared exactly. The last digits of numbers depend on the processor: matrix products and functions such
as tanh are computed in another order, or with another rounding, by each kernel of BLAS, NumPy and ONNX Runtime. Scores
are recorded with seven digits, so one unit in the last of them is a relative difference of up to 1.2e-7.
docs/how-to/replay.md has the differences that were measured.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.recordings.dates import format_utc
from fantwin.pipeline.replay.offline.plan import BEGINNING, Limit
from fantwin.schemas.messages import Array

RELATIVE = 1e-6
"""share of the larger of both numbers: eight units in the last digit of a recorded score"""
SPEED_RAD_S = 1e-6
"""absolute, of speeds and variances of speeds: a hundred-thousandth of a revolution a minute"""
OTHERS = 1e-9
"""absolute, of all other numbers: scores, torque balances, probabilities, sizes of faults"""
SENTENCES = frozenset({"message", "evidence"})
"""texts with numbers that are rounded from other fields; all other texts are compared exactly"""
MAX_NAMED = 5
"""differences that are described"""

_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


class Apart(NamedTuple):
    """A difference of two numbers."""

    share: float = 0.0
    """share of the tolerance; 0: equal"""
    name: str = ""
    difference: float = 0.0


def unequal(name: str, one: Array, other: Array, note: Callable[[Apart], None]) -> Array:
    """Which values of two arrays of one shape and type differ: numbers by more than the tolerance, others at all.

    All NaN are equal. name: ends in the unit. note: called with the largest difference within the tolerance.
    """
    differs = one != other
    if one.dtype.kind != "f":
        return differs
    differs &= ~(np.isnan(one) & np.isnan(other))
    first, second = one[differs].astype(np.float64), other[differs].astype(np.float64)
    absolute = SPEED_RAD_S if name.endswith(("_rad_s", "variance")) else OTHERS
    with np.errstate(invalid="ignore"):
        share = np.abs(first - second) / (absolute + RELATIVE * np.maximum(np.abs(first), np.abs(second)))
    is_allowed = share <= 1.0  # not where only one of both is finite
    if is_allowed.any():
        largest = int(np.argmax(np.where(is_allowed, share, 0.0)))
        note(Apart(float(share[largest]), name, float(np.abs(first - second)[largest])))
    differs[differs] = ~is_allowed
    return differs


def differences(one: Any, other: Any, note: Callable[[Apart], None], path: tuple[str, ...] = ()) -> Iterator[str]:
    """The places in which two nested values differ by more than the tolerance: keys and list indices, joined by dots.

    Sentences are compared without their numbers, because these are rounded from numbers that are compared anyway.
    note: see `unequal`.
    """
    if isinstance(one, dict) and isinstance(other, dict):
        for key in {**one, **other}:
            if key in one and key in other:
                yield from differences(one[key], other[key], note, (*path, key))
            else:
                yield ".".join((*path, key))
    elif isinstance(one, list | tuple) and isinstance(other, list | tuple) and len(one) == len(other):
        for number, (mine, others) in enumerate(zip(one, other, strict=True)):
            yield from differences(mine, others, note, (*path, str(number)))
    elif not _is_alike(next((key for key in reversed(path) if not key.isdigit()), ""), one, other, note):
        yield ".".join(path)


def _is_alike(name: str, one: Any, other: Any, note: Callable[[Apart], None]) -> bool:
    if type(one) is not type(other):
        return False
    if isinstance(one, float | np.ndarray):
        one, other = np.atleast_1d(one), np.atleast_1d(other)
        is_comparable = one.shape == other.shape and one.dtype == other.dtype
        return is_comparable and not unequal(name, one, other, note).any()
    if isinstance(one, str) and name in SENTENCES:
        return _NUMBER.sub("#", one) == _NUMBER.sub("#", other)
    return bool(one == other)


class CannotCompareError(UserError):
    """The replay cannot be compared with the recording."""


COUNTS = (
    *(f"samples_{name}" for name in ("equal", "different", "not_made", "not_recorded", "not_comparable")),
    "others_different",
    *(f"alarms_{name}" for name in ("equal", "different", "not_recorded", "not_comparable")),
    *(f"snapshots_{name}" for name in ("equal", "different", "not_comparable")),
)
"""What a comparison counts. Samples are those of the tray, with all fans; others are those of `grid` and
`prediction`, and rows of `overview`.

different: another decision, or a number that differs by more than its tolerance. not_made: recorded, and not replayed.
not_recorded: replayed, and not in the recording: in flight when it ended, or lost. not_comparable: not equal or not
replayed, where the recording lacks what they were computed from.
"""


@dataclass
class Comparison:
    """The result for one tray. Where scores were left out, snapshots are compared instead."""

    tray: str
    left_out: tuple[str, ...] = ()
    """topics that were not recorded"""
    counts: Counter[str] = field(default_factory=Counter[str])
    """by name, see COUNTS"""
    numbers_different: int = 0
    """the different samples with a number that differs"""
    holes: int = 0
    """samples that are not recorded between recorded ones: they were lost, or removed"""
    largest: Apart = Apart()
    """the largest difference within the tolerance, by its share of the tolerance"""
    reasons: list[str] = field(default_factory=list)
    """why something is not comparable, a line each"""
    named: list[str] = field(default_factory=list)
    """the first differences, a line each"""

    @property
    def has_scores(self) -> bool:
        """Scores were recorded."""
        return "score" not in self.left_out

    @property
    def is_equal(self) -> bool:
        """Whether nothing differs."""
        return not any(count for name, count in self.counts.items() if name.endswith(("_different", "_not_made")))

    @property
    def has_content(self) -> bool:
        """Whether anything could be compared."""
        if self.has_scores:
            return any(self.counts[f"samples_{name}"] for name in ("equal", "different", "not_made"))
        return bool(self.counts["alarms_equal"] or self.counts["snapshots_equal"] or not self.is_equal)

    def note(self, apart: Apart) -> None:
        """Keep the largest of the differences within the tolerance."""
        self.largest = max(self.largest, apart)

    def add_not_comparable(self, samples: int, limit: Limit) -> None:
        """Count samples beyond the limit of their session."""
        self.counts["samples_not_comparable"] += samples
        if samples:
            self.add_limit(limit)

    def add_limit(self, limit: Limit) -> None:
        """Add the reason why something beyond the limit of its session is not comparable."""
        since = "" if limit.t_ns == BEGINNING else f"after {format_utc(limit.t_ns)}: "
        self.add_reason(f"{self.tray}: {since}{limit.reason}")

    def add_reason(self, reason: str) -> None:
        """Add a line on what is not comparable, once."""
        if reason not in self.reasons:
            self.reasons.append(reason)

    def name(self, difference: str) -> None:
        """Describe a difference, if it is one of the first."""
        if len(self.named) < MAX_NAMED:
            self.named.append(f"{self.tray}: {difference}")

    def as_json(self) -> dict[str, Any]:
        """The JSON form."""
        return {
            "equal": self.is_equal,
            **{name: self.counts[name] for name in COUNTS},
            "largest_difference": self.largest._asdict(),
            "left_out": list(self.left_out),
            "not_comparable": self.reasons,
            "differences": self.named,
        }

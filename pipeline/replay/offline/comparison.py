"""The result of comparing a replay with what was recorded."""

from __future__ import annotations

from dataclasses import dataclass, field

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.recordings.dates import format_utc
from fantwin.pipeline.replay.offline.plan import BEGINNING, Limit
from fantwin.pipeline.replay.offline.tolerance import Apart

MAX_NAMED = 5
"""differences that are described"""


class CannotCompareError(UserError):
    """The replay cannot be compared with the recording."""


@dataclass
class Comparison:
    """The result for one tray. Samples are those of the tray, with all fans."""

    tray: str
    equal: int = 0
    different: int = 0
    """replayed with another decision, or with a number that differs by more than its tolerance"""
    numbers_different: int = 0
    """the different samples with such a number"""
    not_made: int = 0
    """recorded, and not replayed"""
    not_recorded: int = 0
    """replayed, and not in the recording: in flight when it ended, or lost"""
    holes: int = 0
    """those between recorded ones: they were lost, or removed"""
    inputs_different: int = 0
    """samples of `grid` and `prediction` that were replayed differently"""
    alarms_equal: int = 0
    alarms_different: int = 0
    alarms_not_recorded: int = 0
    """replayed, and later than the last recorded score of their session"""
    not_comparable: int = 0
    """not equal or not replayed, where the recording lacks what they were computed from"""
    alarms_not_comparable: int = 0
    has_scores: bool = True
    """scores were recorded; otherwise snapshots are compared"""
    snapshots_equal: int = 0
    snapshots_different: int = 0
    snapshots_not_comparable: int = 0
    largest: Apart = Apart()
    """the largest difference within the tolerance, by its share of the tolerance"""
    reasons: list[str] = field(default_factory=list)
    """why something is not comparable, a line each"""
    named: list[str] = field(default_factory=list)
    """the first differences, a line each"""

    @property
    def is_equal(self) -> bool:
        """Whether nothing differs."""
        return not (
            self.different
            or self.inputs_different
            or self.not_made
            or self.alarms_different
            or self.snapshots_different
        )

    @property
    def has_content(self) -> bool:
        """Whether anything could be compared."""
        if self.has_scores:
            return bool(self.equal or self.different or self.not_made)
        return bool(self.alarms_equal or self.snapshots_equal or not self.is_equal)

    def note(self, apart: Apart) -> None:
        """Keep the largest of the differences within the tolerance."""
        self.largest = max(self.largest, apart)

    def add_not_comparable(self, samples: int, limit: Limit) -> None:
        """Count samples beyond the limit of their session."""
        self.not_comparable += samples
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
            self.named.append(difference)

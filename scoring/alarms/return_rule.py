"""When the alarm of a fan returns: the detectors that exceeded their limit decide, each after an off-delay of its own.

A detector holds an alarm from the sample at which it exceeds its limit. It has returned when it has been below
`return_ratio` for as long as samples affect it (`Detector.off_delay_s`): until then the fault may still be in it, and a
contact that comes and goes is good for a moment only.

The longer an alarm has stood, the longer it must be gone. And it must be gone at the speeds at which it came: a twin
that errs at another speed by as much as the fault costs hides it there. Elsewhere an alarm returns after
`ELSEWHERE_NS`. A residual of several limits is not hidden by such errors, and returns at any speed. (Residuals are
clipped at two limits: a low-pass exceeds three only where it smooths many noisy readings.)

What began with a standstill is over with it: such a residual returns at any speed, after the least off-delay, and its
sum once it is below its limit, for it falls slowly. One that was there before is another fault.

Only samples that could show the fault count. A blade that is touched takes ten per cent of the speed: 200 rpm at
2,000 rpm, which is beyond a limit of 150, and 70 rpm at 700 rpm, which is not. So the largest ratio over speed that the
alarm has had says at which speeds it would be seen; below them the alarm stands as it is, and so it does while the
detector has nothing to score. A statistic is late, so its ratio belongs to the highest speed that is still in it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Self

from schemas.units import NS_PER_S

NOT_BELOW = -1
RETURN_SHARE, LONGEST_RETURN_NS = 0.1, 60 * NS_PER_S  # of the time that a detector has held an alarm; and at most
ELSEWHERE_NS = 600 * NS_PER_S
TOGETHER_NS = 10 * NS_PER_S  # so long before or after a standstill is seen its residual may begin
HIDDEN_RATIO = 3.0  # to its limit; no healthy twin errs by so much
NEAR_SPEED_RATIO = 1.15  # to the highest speed at which it exceeded, and of the lowest to it
LARGEST = 1e300  # ratio over speed of a fault that shows at any speed


@dataclass(frozen=True)
class HoldingDetector:
    """What the rule knows about a detector."""

    name: str
    off_delay_ns: int
    grows_with_speed: bool
    """whether the same fault is larger at a higher speed: of a residual, not of the tacho"""
    return_share: float = RETURN_SHARE
    """a return must last for this share of the time for which the statistic held the alarm"""
    is_sum: bool = False
    """whether its statistic is a sum, which falls only as fast as it may"""
    standing_ns: int = 0
    """so long before this detector sees a standstill its residuals may have begun; 0: it sees none"""
    least_off_delay_ns: int = 0
    """of all detectors"""
    elsewhere_ns: int = ELSEWHERE_NS
    """a return at speeds other than those of the alarm must last for this time"""


@dataclass(frozen=True)
class ReturnEvidence:
    """A sample of one fan. ratios: of each detector, NaN where it has nothing to score; speed_rad_s: of the twin."""

    ratios: Sequence[float]
    speed_rad_s: float


@dataclass
class _Hold:
    """One detector that holds the alarm."""

    ratio_per_rad_s: float = 0.0
    """largest so far"""
    below_ns: int = NOT_BELOW
    """how long it has been below the ratio of return, in samples that could show the fault"""
    peak_rad_s: float = 0.0
    """highest speed of the last off-delay"""
    peak_age_ns: int = 0
    age_ns: int = 0
    held_ns: int = 0
    """its age when it was above the ratio of return last"""
    elsewhere_ns: int = 0
    """how long it has been below the ratio of return at other speeds than those at which it exceeded"""
    largest: float = 0.0
    """ratio so far"""
    slowest_rad_s: float = LARGEST
    fastest_rad_s: float = 0.0
    """at which it exceeded"""

    def follow(self, speed_rad_s: float, period_ns: int, off_delay_ns: int) -> None:
        """Keep the highest speed."""
        self.peak_age_ns += period_ns
        if speed_rad_s >= self.peak_rad_s or self.peak_age_ns > off_delay_ns:
            self.peak_rad_s, self.peak_age_ns = speed_rad_s, 0

    def shows_at(self, speed_rad_s: float, ratio: float) -> bool:
        """Whether the fault would be seen at a speed, with at least this ratio."""
        return self.ratio_per_rad_s >= LARGEST or self.ratio_per_rad_s * speed_rad_s >= ratio

    def is_near(self, speed_rad_s: float) -> bool:
        """Whether it exceeded at about this speed, or between speeds below and above it."""
        return self.slowest_rad_s / NEAR_SPEED_RATIO <= speed_rad_s <= self.fastest_rad_s * NEAR_SPEED_RATIO

    def rise(self) -> None:
        """It is above the ratio of return: it has not returned at all."""
        self.below_ns, self.elsewhere_ns = NOT_BELOW, 0

    def exceed(self, ratio: float) -> None:
        """The limit is exceeded, by this ratio, at the highest speed that is still in it."""
        self.largest = max(self.largest, min(ratio, LARGEST))
        if self.peak_rad_s > 0.0:
            self.ratio_per_rad_s = max(self.ratio_per_rad_s, min(ratio / self.peak_rad_s, LARGEST))
            self.slowest_rad_s = min(self.slowest_rad_s, self.peak_rad_s)
            self.fastest_rad_s = max(self.fastest_rad_s, self.peak_rad_s)
        else:
            self.show_at_any_speed()
        self.rise()

    def show_at_any_speed(self) -> None:
        """It is not known at which speeds the fault shows."""
        self.ratio_per_rad_s = self.fastest_rad_s = LARGEST
        self.slowest_rad_s = 0.0


class AlarmReturn:
    """The detectors that hold the alarm of one fan."""

    def __init__(self, detectors: Sequence[HoldingDetector], return_ratio: float) -> None:
        self._detectors = detectors
        self._return_ratio = return_ratio
        self._holds: dict[str, _Hold] = {}

    def begin(self) -> None:
        """An alarm is being raised: the detectors that exceed their limit from now on hold it."""
        self._holds = {}

    def update(self, period_ns: int, sample: ReturnEvidence) -> tuple[bool, bool]:
        """Take a sample. Returns whether no detector is above its ratio of return, and whether all have returned."""
        speed = abs(sample.speed_rad_s) if math.isfinite(sample.speed_rad_s) else 0.0
        above, over = False, True
        sizes = [
            self._holds[each.name].largest
            for each in self._detectors
            if each.grows_with_speed and each.name in self._holds
        ]
        is_hidden_nowhere = max(sizes, default=0.0) >= HIDDEN_RATIO
        standings_ns = self._standings_ns()
        for detector, ratio in zip(self._detectors, sample.ratios, strict=True):
            hold = self._holds.get(detector.name)
            if hold is None:
                if not ratio > 1.0:
                    continue
                hold = self._holds[detector.name] = _Hold()
            hold.follow(speed, period_ns, detector.off_delay_ns)
            began_in_one = any(youngest <= hold.age_ns <= oldest for youngest, oldest in standings_ns)
            is_of_standing = detector.grows_with_speed and began_in_one
            shows = not detector.grows_with_speed or is_of_standing or hold.shows_at(speed, self._return_ratio)
            is_near = is_of_standing or is_hidden_nowhere or not detector.grows_with_speed or hold.is_near(speed)
            return_ratio = 1.0 if is_of_standing and detector.is_sum else self._return_ratio
            if ratio > 1.0:
                hold.exceed(ratio)
            elif ratio >= return_ratio:
                hold.rise()
            elif ratio < return_ratio and shows and is_near:
                hold.below_ns = 0 if hold.below_ns == NOT_BELOW else hold.below_ns + period_ns
            elif ratio < return_ratio and shows:
                hold.elsewhere_ns += period_ns
            hold.age_ns += period_ns
            if ratio >= return_ratio:
                above, hold.held_ns = True, hold.age_ns
            longer_ns = min(round(detector.return_share * hold.held_ns), LONGEST_RETURN_NS)
            own_ns = detector.least_off_delay_ns if is_of_standing else detector.off_delay_ns
            least_ns = max(own_ns, longer_ns)
            elsewhere_ns = max(hold.below_ns, 0) + hold.elsewhere_ns
            over &= hold.below_ns >= least_ns or (
                hold.elsewhere_ns > 0 and elsewhere_ns >= max(detector.elsewhere_ns, least_ns)
            )
        return not above, over

    def _standings_ns(self) -> list[tuple[int, int]]:
        """Of each standstill that was seen: the ages of residuals that began with it, the youngest and the oldest."""
        seen = [
            (each, self._holds[each.name]) for each in self._detectors if each.standing_ns and each.name in self._holds
        ]
        return [(hold.age_ns - hold.held_ns - TOGETHER_NS, hold.age_ns + each.standing_ns) for each, hold in seen]

    def begin_delays_again(self) -> None:
        """After a gap the off-delays start again."""
        for hold in self._holds.values():
            hold.rise()

    def forget_sizes(self) -> None:
        """With another baseline the fault has another size: every sample counts again."""
        for hold in self._holds.values():
            hold.show_at_any_speed()

    def snapshot(self) -> dict[str, Any]:
        """The state, as JSON values."""
        return {name: asdict(hold) for name, hold in self._holds.items()}

    @classmethod
    def restore(cls, detectors: Sequence[HoldingDetector], return_ratio: float, stored: Mapping[str, Any]) -> Self:
        """The state of a snapshot.

        Raises:
            KeyError, TypeError, ValueError: it is no such snapshot.
        """
        restored = cls(detectors, return_ratio)
        used = {detector.name for detector in detectors}
        restored._holds = {
            str(name): _Hold(
                ratio_per_rad_s=float(hold["ratio_per_rad_s"]),
                below_ns=int(hold["below_ns"]),
                peak_rad_s=float(hold["peak_rad_s"]),
                peak_age_ns=int(hold["peak_age_ns"]),
                age_ns=int(hold["age_ns"]),
                held_ns=int(hold["held_ns"]),
                elsewhere_ns=int(hold["elsewhere_ns"]),
                largest=float(hold["largest"]),
                slowest_rad_s=float(hold["slowest_rad_s"]),
                fastest_rad_s=float(hold["fastest_rad_s"]),
            )
            for name, hold in stored.items()
            if name in used
        }
        return restored

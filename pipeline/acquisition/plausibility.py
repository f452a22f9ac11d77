"""The plausibility of readings, by the same rules for all sources. Implausible ones are counted by kind."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace

from fantwin.pipeline.acquisition.device_sequence import DeviceSequence
from fantwin.pipeline.acquisition.input_quality import InputQuality
from fantwin.pipeline.sources.source import Reading, ReadingLimits, Rejected
from fantwin.schemas.channels import BY_NAME, Channel

LONGEST_DETAIL = 120
"""characters of the fault of a refused input, which may quote it; each health contains it"""


class Plausibility:
    """Checks the readings of one tray."""

    def __init__(
        self,
        limits: ReadingLimits,
        speed_unit: str,
        counts: Counter[str],
        quality: InputQuality,
        sequence: DeviceSequence,
    ) -> None:
        """counts, quality, sequence: those of the tray; readings that are refused are added to them."""
        self.limits = limits
        self._speed_unit = speed_unit
        self._counts = counts
        self._quality = quality
        self._sequence = sequence
        self.measured: list[Channel] = []
        """the channels that the source has given"""
        self.first_refused: dict[str, str] = {}
        """fault of the first refused input, by kind"""

    def plausible(self, item: Reading | Rejected) -> Reading | None:
        """The reading, without implausible speeds; None, and counted, if it cannot be used."""
        if isinstance(item, Reading) and self._is_ordinary(item):
            self._counts["no_speed"] += 0  # shown from the first reading on
            self._quality.add_valid()
            return item
        rejected = item if isinstance(item, Rejected) else self.limits.why_refused(item)
        if rejected is None:
            assert isinstance(item, Reading)
            return self._with_plausible_speeds(item)
        self._counts[rejected.kind] += 1
        self._sequence.refused += rejected.is_sample
        if not rejected.harmless:
            self._counts["refused_input"] += 1
            rejected = replace(rejected, detail=_shortened(rejected.detail))
            self._quality.add_fault(rejected)
            self.first_refused.setdefault(rejected.kind, rejected.detail)
        return None

    def _is_ordinary(self, reading: Reading) -> bool:
        """Return whether all values are there and plausible, as in nearly all readings; a sum shows any not finite."""
        command, speed, limits = reading.command, reading.speed, self.limits
        return (
            len(command) == len(speed) == limits.fans
            and math.isfinite(sum(command) + sum(speed))
            and limits.command_min <= min(command)
            and max(command) <= limits.command_max
            and -limits.speed_max <= min(speed)
            and max(speed) <= limits.speed_max
        )

    def _with_plausible_speeds(self, reading: Reading) -> Reading:
        speed_max = self.limits.speed_max
        self._counts["no_speed"] += sum(map(math.isnan, reading.speed))
        absurd = [speed for speed in reading.speed if abs(speed) > speed_max]
        if not absurd:
            self._quality.add_valid()
            return reading
        self._counts["absurd_speed"] += len(absurd)
        speeds = tuple(math.nan if abs(v) > speed_max else v for v in reading.speed)
        if all(map(math.isnan, speeds)):
            self._counts["absurd_samples"] += 1
            detail = f"speed {absurd[0]:g} is beyond speed_max = {speed_max:g} {self._speed_unit}"
            self._quality.add_fault(Rejected("absurd_speed", detail, setting="speed_max and speed_unit"))
        else:
            self._quality.add_valid()
        return replace(reading, speed=speeds)

    def with_plausible_columns(self, reading: Reading) -> Reading:
        """The reading with NaN where a value beside command and speed cannot be true, or the source has left it out.

        A source that gives a column in some samples only, such as a temperature once a second, has it in all.
        """
        if not (self.measured or reading.measured):
            return reading
        unknown = (math.nan,) * self.limits.fans
        measured = dict.fromkeys((each.name for each in self.measured), unknown)
        for name, values in reading.measured.items():
            if not values:
                continue
            each = BY_NAME[name]
            if each not in self.measured:
                self.measured.append(each)
            if len(values) == self.limits.fans:
                measured[name] = tuple(value if each.is_plausible(value) else math.nan for value in values)
                absurd = sum(not (each.is_plausible(value) or math.isnan(value)) for value in values)
            else:
                measured[name], absurd = unknown, len(values)
            if absurd:
                self._counts[f"absurd_{each.key}"] += absurd
        return replace(reading, measured=measured)


def _shortened(detail: str) -> str:
    return detail if len(detail) <= LONGEST_DETAIL else f"{detail[:LONGEST_DETAIL]}..."

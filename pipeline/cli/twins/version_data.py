"""Which parts of the healthy history the next version of a twin is trained, validated, compared and checked on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pipeline.cli.twins.training_data import TrainingData, read_training_data
from pipeline.learning.healthy_history import HealthyRecording

MOST_RECORDINGS = 24
"""the newest ones that a twin is trained on"""
LEAST_COMPARED_S = 600.0
"""the newest recording that is as long is the one for validation and comparison"""
HELD_OUT = 0.2
"""share of the only recording that is kept for validation"""
CHECKED_PARTS, CHECKED_PART_S = 24, 120.0
"""of the newest healthy day, in which the speeds of the fans are checked: a mean over its hours and commands"""


@dataclass(frozen=True)
class Excerpt:
    """A part of each of some recordings, in seconds since its first sample."""

    paths: list[Path]
    from_s: float
    to_s: float

    def read(self) -> TrainingData:
        """Its samples.

        Raises:
            UserError: they cannot be read.
        """
        return read_training_data(self.paths, None, None, self.from_s, self.to_s)


@dataclass(frozen=True)
class Split:
    """training: what a twin is fitted to. validation: on which its weights are chosen, and its band is measured.
    comparison: what it has not seen; the same as validation for a first twin, which is compared with no other."""

    training: Excerpt
    validation: Excerpt
    comparison: Excerpt


def split(recordings: Sequence[HealthyRecording], most_s: float) -> Split:
    """The newest long recording for validation and comparison, others for training; or parts of the only one.

    most_s: samples of so many seconds are enough for each.
    """
    if len(recordings) == 1:
        (only,) = recordings
        border_s = (1.0 - HELD_OUT) * only.seconds
        training = Excerpt([only.path], max(0.0, border_s - most_s), border_s)
        held_out = Excerpt([only.path], border_s, math.inf)
        return Split(training, held_out, held_out)
    compared = newest_long(recordings)
    others = [each.path for each in recordings if each != compared][-MOST_RECORDINGS:]
    first_s = max(0.0, compared.seconds - most_s)
    middle_s = (first_s + compared.seconds) / 2.0
    return Split(
        Excerpt(others, 0.0, most_s / len(others)),
        Excerpt([compared.path], first_s, middle_s),
        Excerpt([compared.path], middle_s, math.inf),
    )


def newest_long(recordings: Sequence[HealthyRecording]) -> HealthyRecording:
    """The newest recording of at least LEAST_COMPARED_S, or the longest."""
    long = [each for each in recordings if each.seconds >= LEAST_COMPARED_S]
    return long[-1] if long else max(recordings, key=lambda each: each.seconds)


def newest_recordings(recordings: Sequence[HealthyRecording], wanted_s: float) -> list[HealthyRecording]:
    """The newest recordings that together are at least this long, or all."""
    chosen: list[HealthyRecording] = []
    for each in reversed(recordings):
        if sum(one.seconds for one in chosen) < wanted_s:
            chosen.insert(0, each)
    return chosen


def spread_parts(recordings: Sequence[HealthyRecording]) -> list[Excerpt]:
    """Parts of CHECKED_PART_S evenly over the recordings, at most CHECKED_PARTS of them."""
    total_s = sum(each.seconds for each in recordings)
    apart_s = max(total_s / CHECKED_PARTS, CHECKED_PART_S)
    parts: list[Excerpt] = []
    for each in recordings:
        count = max(1, round(each.seconds / apart_s))
        length_s = min(CHECKED_PART_S, each.seconds / count)
        for number in range(count):
            middle_s = (number + 0.5) * each.seconds / count
            parts.append(Excerpt([each.path], middle_s - length_s / 2.0, middle_s + length_s / 2.0))
    return parts

"""Which parts of the healthy history the next version of a twin is trained, validated, compared and checked on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fantwin.pipeline.cli.twins.excerpts import MOST_HZ, Excerpt
from fantwin.pipeline.cli.twins.windows import Windows, joined, windows_of
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.learning.history_recordings import HistoryRecording

WINDOW_S = 60.0
"""long enough for many time constants of a fan; windows are longer where samples are few"""
MOST_WINDOWS, LEAST_WINDOWS = 24, 12
"""that a twin is trained on"""
MOST_READINGS = 600_000
"""of all fans together that a twin is trained on, if LEAST_WINDOWS have no more: two or three minutes of a core"""
HELD_OUT_WINDOWS = 12
"""half of them for validation, half for comparison"""
WANTED_SAMPLES = 10_000
"""that are enough for small networks: on slow lines, windows are so long that they have as many together"""
SHORTEST_RECORDING_IN_WINDOWS = 10
"""the recording that is held out has at least so many windows, if need be shorter ones"""
LEAST_COMPARED_S = 600.0
"""the newest recording that is as long is the one for validation and comparison"""
KEPT_OUT_EVERY = 5
"""of the windows of that recording one is kept out of training, where the others are needed for it"""
ENOUGH_OF_RANGE = 0.75
"""of the tenths of the commands' range: if other recordings have fewer of each fan, they are not enough to train on"""
CHECKED_PARTS, CHECKED_PART_S = 24, 120.0
"""of the newest healthy hours, in which the speeds of the fans are checked: a mean over these and their commands"""


@dataclass(frozen=True)
class Split:
    """training: what a twin is fitted to. validation: on which its weights are chosen, and its band is measured.
    comparison: what it has not seen; the same as validation where the history is too short for both."""

    training: tuple[Excerpt, ...]
    validation: tuple[Excerpt, ...]
    comparison: tuple[Excerpt, ...]


def split(recordings: Sequence[HistoryRecording], rate_hz: float, fans: int) -> Split:
    """Windows of the newest long recording for validation and comparison, of the others for training.

    Where the others are not enough, only every fifth window of that recording is held out. rate_hz, fans: of the line.

    Raises:
        UserError: a recording cannot be read, or lacks most of its samples.
    """
    rate_hz = min(rate_hz, MOST_HZ)
    compared = newest_long(recordings)
    wanted_s = max(WINDOW_S, WANTED_SAMPLES / MOST_WINDOWS / rate_hz)
    window_s = min(wanted_s, compared.seconds / SHORTEST_RECORDING_IN_WINDOWS)
    windows = windows_of(recordings, window_s)
    is_compared = np.array([each.path == compared.path for each in windows.excerpts])
    others, newest = windows.of(~is_compared), windows.of(is_compared)
    if len(newest) < KEPT_OUT_EVERY:
        raise UserError(f"{compared.path}: most of its samples are missing: too few to learn from")
    if len(others) and np.all(others.tenths >= ENOUGH_OF_RANGE * windows.tenths):
        training, held_out = others, newest
    else:
        last = np.flatnonzero(is_compared)[KEPT_OUT_EVERY - 1 :: KEPT_OUT_EVERY]
        is_kept_out = np.isin(np.arange(len(windows)), last)
        training, held_out = windows.of(~is_kept_out), windows.of(is_kept_out)
    most = int(MOST_READINGS / (fans * rate_hz * window_s))
    trained = training.chosen(min(max(most, LEAST_WINDOWS), MOST_WINDOWS))
    return Split(joined(trained.excerpts), *_halves(held_out))


def _halves(held_out: Windows) -> tuple[tuple[Excerpt, ...], tuple[Excerpt, ...]]:
    """Validation and comparison by turns, so that both are of the same hours and commands."""
    chosen = held_out.chosen(HELD_OUT_WINDOWS).excerpts
    return (chosen[::2], chosen[1::2]) if len(chosen) > 3 else (chosen, chosen)


def newest_long(recordings: Sequence[HistoryRecording]) -> HistoryRecording:
    """The newest recording of at least LEAST_COMPARED_S, or the longest."""
    long = [each for each in recordings if each.seconds >= LEAST_COMPARED_S]
    return long[-1] if long else max(recordings, key=lambda each: each.seconds)


def newest_recordings(recordings: Sequence[HistoryRecording], wanted_s: float) -> list[HistoryRecording]:
    """The newest recordings that together are at least this long, or all."""
    chosen: list[HistoryRecording] = []
    for each in reversed(recordings):
        if sum(one.seconds for one in chosen) < wanted_s:
            chosen.insert(0, each)
    return chosen


def spread_parts(recordings: Sequence[HistoryRecording], last_s: float = np.inf) -> list[Excerpt]:
    """Parts of CHECKED_PART_S evenly over the last seconds of the recordings, at most CHECKED_PARTS of them; shorter
    where a recording begins or ends."""
    ends_s = np.cumsum([each.seconds for each in recordings])
    whole_s = min(float(ends_s[-1]), last_s)
    count = int(np.clip(whole_s / CHECKED_PART_S, 1, CHECKED_PARTS))
    half_s = min(CHECKED_PART_S, whole_s / count) / 2.0
    parts: list[Excerpt] = []
    for middle_s in (ends_s[-1] - whole_s + (np.arange(count) + 0.5) * whole_s / count).tolist():
        number = int(np.searchsorted(ends_s, middle_s))
        each = recordings[number]
        within_s = middle_s - (ends_s[number] - each.seconds)
        parts.append(Excerpt(each.path, max(0.0, within_s - half_s), min(each.seconds, within_s + half_s)))
    return parts

"""Parts of the healthy history: those that the next version of a twin is trained, validated, compared and checked on.

Windows are chosen by how much they show of a fan: the sum of the square roots of the time in each tenth of the range of
its commands, and of the changes into each. The next minute at a command shows less than the first one, and a command
that is rare counts.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.learning.history_recordings import HistoryRecording
from fantwin.pipeline.learning.training_data import TrainingData, joined, training_data_of, twin_errors
from fantwin.pipeline.recordings.excerpts import ExcerptReader

if TYPE_CHECKING:
    from fantwin.schemas.messages import Array

_LOG = logging.getLogger(__name__)
MOST_HZ = 100.0
"""samples of faster lines are thinned to at most about this rate, that of the fastest grid by default"""
NEARLY = 0.05
"""a rate that is higher by this share is not thinned"""


@dataclass(frozen=True)
class Excerpt:
    """A part of a recording, in seconds since its first sample."""

    path: Path
    from_s: float
    to_s: float


def read_excerpts(excerpts: Iterable[Excerpt]) -> TrainingData:
    """The samples of excerpts together, those of fast lines thinned. Damage is logged.

    Raises:
        UserError: they cannot be read, or are not in one unit.
    """
    return joined(list(each_excerpt(excerpts)))


def each_excerpt(excerpts: Iterable[Excerpt]) -> Iterator[TrainingData]:
    """The samples of each excerpt by itself. Raises as `read_excerpts`."""
    path, reader = None, None
    for excerpt in excerpts:
        if reader is None or excerpt.path != path:
            path, reader = excerpt.path, ExcerptReader(excerpt.path)
        found = reader.read(excerpt.from_s, excerpt.to_s)
        if found.damage:
            _LOG.warning("%s", found.damage)
        yield _thinned(training_data_of(found))


def _thinned(data: TrainingData) -> TrainingData:
    with twin_errors():
        from fantwin.twin.evaluation.resampling import thinned  # noqa: PLC0415  the command line loads twin only when it is needed

        runs = [thinned(run, every_of(1.0 / run.median_period_s)) for run in data.runs]
    sources = [replace(source, samples=run.samples) for source, run in zip(data.sources, runs, strict=True)]
    return replace(data, runs=runs, sources=sources)


def every_of(rate_hz: float) -> int:
    """Number of samples of a line of which one is used."""
    return max(1, math.ceil(rate_hz / MOST_HZ - NEARLY))


LOOK_S = 1.0
"""between two commands that are looked at"""
TENTHS = 10
"""equal parts of the range of a fan's commands"""
CHANGE_COUNTS_S = 10.0
"""a change by more than a tenth counts as so many seconds at a command"""
ROUNDING = 1e-6
LEAST_KNOWN = 0.5
"""of the samples of other windows: with fewer a window is not used"""


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows of equal length, in order of time.

    activity: (windows, fans, 2 x TENTHS) seconds in each tenth of the range of a fan's commands, and changes into each.
    """

    excerpts: tuple[Excerpt, ...]
    activity: Array

    def __len__(self) -> int:
        return len(self.excerpts)

    def of(self, wanted: NDArray[np.intp] | NDArray[np.bool_]) -> Windows:
        """Some of them, by index or flag."""
        numbers = np.arange(len(self))[wanted]
        return replace(
            self, excerpts=tuple(self.excerpts[k] for k in numbers.tolist()), activity=self.activity[numbers]
        )

    def chosen(self, count: int) -> Windows:
        """Choose at most so many: half of them evenly spread, the others those that add most to what these show.

        Always the same ones for the same windows.
        """
        if len(self) <= count:
            return self
        spread = ((np.arange(count // 2) + 0.5) * len(self) / (count // 2)).astype(np.intp)
        taken = np.zeros(len(self), np.bool_)
        taken[spread] = True
        shown = self.activity[spread].sum(axis=0)
        order = np.random.default_rng(0).permutation(len(self))  # equal ones are not neighbours
        for _ in range(count - len(spread)):
            left = order[~taken[order]]
            gain = np.sqrt(shown + self.activity[left]).sum(axis=(1, 2))
            best = left[np.argmax(gain)]
            taken[best] = True
            shown = shown + self.activity[best]
        return self.of(taken)

    @property
    def tenths(self) -> Array:
        """(fans,) how many tenths of its range the command of each fan is in for some seconds."""
        return (self.activity[:, :, :TENTHS].sum(axis=0) >= CHANGE_COUNTS_S).sum(axis=1)


def windows_of(recordings: Sequence[HistoryRecording], window_s: float) -> Windows:
    """Successive windows of the recordings, without those that lack many samples.

    Raises:
        UserError: a recording cannot be read, or the number of fans changes.
    """
    traces = [ExcerptReader(each.path).commands(LOOK_S) for each in recordings]
    commands = np.concatenate([command for _, command in _of_one_number_of_fans(traces)])
    low, high = np.nanmin(commands, axis=0), np.nanmax(commands, axis=0)
    width = np.where(high > low, (high - low) / TENTHS, 1.0)
    excerpts: list[Excerpt] = []
    activity: list[Array] = []
    known: list[Array] = []
    for each, (t_s, command) in zip(recordings, traces, strict=True):
        count = max(1, int(each.seconds / window_s + ROUNDING))
        excerpts += [Excerpt(each.path, k * window_s, (k + 1) * window_s) for k in range(count)]
        window = np.clip(t_s // window_s, 0, count).astype(np.intp)
        activity.append(_activity(window, (command - low) / width, count))
        known.append(np.bincount(window, minlength=count + 1)[:count])
    samples = np.concatenate(known)
    found = Windows(tuple(excerpts), np.concatenate(activity))
    return found.of(samples >= max(2.0, LEAST_KNOWN * float(np.median(samples))))


def joined_excerpts(excerpts: Sequence[Excerpt]) -> tuple[Excerpt, ...]:
    """The same parts of recordings, adjoining ones as one."""
    parts: list[Excerpt] = []
    for each in excerpts:
        if parts and parts[-1].path == each.path and parts[-1].to_s == each.from_s:
            parts[-1] = replace(parts[-1], to_s=each.to_s)
        else:
            parts.append(each)
    return tuple(parts)


def _of_one_number_of_fans(traces: Sequence[tuple[Array, Array]]) -> Sequence[tuple[Array, Array]]:
    fans = {command.shape[1] for _, command in traces}
    if len(fans) > 1:
        numbers = " and ".join(map(str, sorted(fans)))
        raise UserError(f"the healthy history has recordings of {numbers} fans: mark those of other fans as faulty")
    return traces


def _activity(window: NDArray[np.intp], place: Array, count: int) -> Array:
    """(count, fans, 2 x TENTHS). window: (n,) of each sample. place: (n, fans) in the range, from 0 to TENTHS."""
    fans = place.shape[1]
    found = np.zeros((count + 1, fans, 2 * TENTHS))  # the last one: what is after the last window
    known = np.isfinite(place)
    tenth = np.clip(np.where(known, place, 0.0), 0, TENTHS - 1).astype(np.intp)
    at = (np.broadcast_to(window[:, np.newaxis], tenth.shape), np.broadcast_to(np.arange(fans), tenth.shape))
    np.add.at(found, (*at, tenth), np.where(known, LOOK_S, 0.0))
    changed = np.abs(np.diff(place, axis=0)) > 1.0  # False where one is not known
    changed &= (np.diff(window) == 0)[:, np.newaxis]
    into = tuple(index[1:] for index in (*at, TENTHS + tenth))
    np.add.at(found, into, np.where(changed, CHANGE_COUNTS_S, 0.0))
    return found[:count]


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
    return Split(joined_excerpts(trained.excerpts), *_halves(held_out))


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

"""Windows of the healthy history: what the commands do in each, and a choice of those that show most.

How much windows show of a fan: the sum of the square roots of the time in each tenth of the range of its commands, and
of the changes into each. The next minute at a command shows less than the first one, and a command that is rare counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fantwin.pipeline.cli.twins.excerpts import Excerpt
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.learning.history_recordings import HistoryRecording
from fantwin.pipeline.recordings.excerpts import ExcerptReader

if TYPE_CHECKING:
    from fantwin.schemas.messages import Array

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
        """At most so many: half of them evenly spread, the others those that add most to what these show.

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


def joined(excerpts: Sequence[Excerpt]) -> tuple[Excerpt, ...]:
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

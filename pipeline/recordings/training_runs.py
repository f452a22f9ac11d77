"""A recording as input for training: time, command and speed of one tray as arrays.

The time of a sample is computed as in the pipeline, from the device clock if there is one
(pipeline.timebase.device_clock).
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from fantwin.pipeline.recordings.left_out import left_out_hint
from fantwin.pipeline.recordings.reading import Reading, RecordingError, read_metadata, read_recording
from fantwin.pipeline.sources.tables.measured_table import hold_last
from fantwin.pipeline.timebase.device_clock import DeviceClock
from fantwin.schemas.channels import CHANNELS, measured_columns
from fantwin.schemas.codec import CodecError, decode_together
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.messages import Array, Raw
from fantwin.schemas.tacho import Tacho, tacho_of_each_fan
from fantwin.schemas.topics import tray_of
from fantwin.schemas.units import NS_PER_S

LONGEST_HELD_NS = NS_PER_S // 2
"""time for which a command that is not known is taken for the last one"""
MERGED_MESSAGES = 1024
"""so many are decoded as one while a recording is read"""


@dataclass(frozen=True, eq=False)
class RecordedRun:
    """Raw samples of a tray over one segment of its device clock."""

    path: Path
    tray: str
    t_s: Array
    """(n,) strictly increasing, since the first sample of this tray in the recording"""
    command: Array
    """(n, fans), never NaN"""
    speed_rad_s: Array
    """(n, fans), NaN where the tacho gave no reading"""
    auxiliary: Mapping[str, Array] = field(default_factory=dict[str, Array])
    """(n, fans) each, NaN where not known: what the source measures beside, by name (schemas.channels)"""


@dataclass(frozen=True)
class RecordedTray:
    """All runs of one tray in a recording."""

    runs: tuple[RecordedRun, ...]
    speed_unit: str
    """unit in which its speeds are displayed"""
    tacho: tuple[Tacho, ...]
    """of each fan of its runs"""
    damage: str
    """what of the file could not be read, in one line; empty if all of it was read"""
    names: FanNames = NO_NAMES
    """names of all fans of the tray"""

    def between(self, from_s: float, to_s: float) -> RecordedTray:
        """The samples with from_s <= t_s < to_s, of runs that have at least two of them."""
        parts = (_rows(run, (run.t_s >= from_s) & (run.t_s < to_s)) for run in self.runs)
        return replace(self, runs=tuple(run for run in parts if len(run.t_s) > 1))


def read_runs(
    path: Path,
    tray: str | None = None,
    fans: Sequence[int] | None = None,
    from_s: float = 0.0,
    to_s: float = math.inf,
) -> RecordedTray:
    """The raw samples of a tray with from_s <= t_s < to_s.

    The whole recording is read, because the device clock is followed from its start; pipeline.recordings.excerpts reads
    only what is around an excerpt.

    tray: needed only if the recording has several. fans: counted from 0; None for all.

    Raises:
        RecordingError: the file cannot be read, or has no such samples.
    """
    reading = read_recording(path, topics=("raw",), tray=tray)
    by_tray: dict[str, list[Raw]] = {}
    pending: dict[str, list[bytes]] = {}
    """the newest of each tray, which are not decoded yet"""
    for envelope in reading.undecoded():
        payloads = pending.setdefault(tray_of(envelope.key), [])
        payloads.append(envelope.payload)
        if len(payloads) == MERGED_MESSAGES:
            if decoded := _decoded(payloads, reading):
                by_tray.setdefault(tray_of(envelope.key), []).extend(decoded)
            payloads.clear()
    for name, payloads in pending.items():
        if decoded := by_tray.get(name, []) + _decoded(payloads, reading):
            by_tray[name] = decoded
    name = only_tray(path, by_tray, tray)
    found = recorded_tray(path, name, by_tray[name], reading.damage, fans).between(from_s, to_s)
    if not found.runs:
        raise no_samples(path, from_s, to_s)
    return found


def _decoded(payloads: Sequence[bytes], reading: Reading) -> list[Raw]:
    """The same samples in as few messages as possible; the many arrays of small ones take more memory than samples."""
    try:
        return decode_together(Raw, payloads)
    except CodecError:
        reading.undecodable += len(payloads) == 1
        return [raw for payload in payloads for raw in _decoded([payload], reading)] if len(payloads) > 1 else []


def only_tray(path: Path, trays: Collection[str], chosen: str | None = None) -> str:
    """The tray that has raw samples. chosen: the only one that was looked for.

    Raises:
        RecordingError: there is none, or there are several.
    """
    if not trays:
        why = left_out_hint([path], ("raw",)) or "correct --tray, or name another recording"
        of_tray = f" of tray {chosen!r}" if chosen else ""
        raise RecordingError(f"{path}: no raw samples{of_tray} in this recording: {why}")
    if len(trays) > 1:
        raise RecordingError(f"{path}: several trays, {', '.join(sorted(trays))}: choose one with --tray")
    return next(iter(trays))


def no_samples(path: Path, from_s: float, to_s: float) -> RecordingError:
    """The error of a part of a recording that has no two samples."""
    return RecordingError(f"{path}: fewer than two raw samples from {from_s:g} s to {to_s:g} s; see --from and --to")


def recorded_tray(
    path: Path,
    tray: str,
    messages: Sequence[Raw],
    damage: str,
    fans: Sequence[int] | None = None,
    start_t_ns: int | None = None,
) -> RecordedTray:
    """The runs of successive messages of a tray.

    start_t_ns: time of the first sample of the recording; None: that of these messages.

    Raises:
        RecordingError: the number of fans changes, there is no such fan, or the metadata are damaged.
    """
    segments = segments_of(path, messages)
    if start_t_ns is None:
        start_t_ns = int(segments[0][0][0]) if segments else 0
    runs = tuple(_run(path, tray, segment, start_t_ns, fans) for segment in segments)
    metadata = read_metadata(path)
    try:
        tacho = tacho_of_each_fan(metadata.tacho(tray, messages[0].tachos), messages[0].fans)
    except (ValueError, RecordingError) as error:
        raise RecordingError(f"{path}: {error}") from error
    chosen = tacho if fans is None else tuple(tacho[fan] for fan in fans)
    return RecordedTray(runs, metadata.speed_unit(tray), chosen, damage, metadata.names(tray))


Columns = tuple[Array, Array, Array, Mapping[str, Array]]
"""t_ns (n,), command (n, fans), speed_rad_s (n, fans), and the auxiliary columns of a RecordedRun."""


def segments_of(path: Path, messages: Sequence[Raw]) -> list[Columns]:
    """The samples by rising time, one item per segment of the device clock that has any.

    Raises:
        RecordingError: the number of fans changes.
    """
    fans = {message.fans for message in messages}
    if len(fans) > 1:
        raise RecordingError(
            f"{path}: the number of fans changes from {' to '.join(map(str, sorted(fans)))}: split the recording there"
        )
    t_ns, segment = _times(messages)
    command = np.concatenate([message.command for message in messages])
    speed_rad_s = np.concatenate([message.speed_rad_s for message in messages])
    auxiliary = _auxiliary(messages)
    firsts = [0, *(np.flatnonzero(np.diff(segment)) + 1).tolist(), len(t_ns)]
    parts = (slice(first, last) for first, last in pairwise(firsts) if last > first)
    segments = (
        _in_order(t_ns[part], command[part], speed_rad_s[part], {name: of[part] for name, of in auxiliary.items()})
        for part in parts
    )
    return [each for each in segments if len(each[0])]


def _auxiliary(messages: Sequence[Raw]) -> dict[str, Array]:
    """The columns that any of the messages has, NaN in those that do not have it."""
    present = {name for message in messages for name in measured_columns(message)}
    return {
        column.name: np.concatenate(
            [
                of if len(of := getattr(message, column.name)) else np.full(message.command.shape, np.nan)
                for message in messages
            ]
        )
        for column in CHANNELS
        if column.name in present
    }


def _times(messages: Iterable[Raw]) -> tuple[Array, Array]:
    """(n,) the host time of each sample, and the number of its segment of the device clock."""
    clock = DeviceClock()
    times: list[Array] = []
    segments: list[Array] = []
    for message in messages:
        received = message.host_receive_t_ns
        if len(message.device_clock_us):
            mapped = [
                (clock.to_host_ns(clock_us, received_ns), clock.segments)
                for clock_us, received_ns in zip(message.device_clock_us.tolist(), received.tolist(), strict=True)
            ]
            both = np.array(mapped, np.int64)
            times.append(both[:, 0])
            segments.append(both[:, 1].astype(np.int32))
        else:  # before the first segment of a clock, such samples belong to it
            times.append(received)
            segments.append(np.full(len(received), max(1, clock.segments), np.int32))
    return np.concatenate(times), np.concatenate(segments)


def _in_order(t_ns: Array, command: Array, speed_rad_s: Array, auxiliary: Mapping[str, Array]) -> Columns:
    """Samples by rising time whose commands are known; of samples with the same time, the first received.

    A command is held for LONGEST_HELD_NS: later, something that is not known drives the fan.
    """
    if np.all(np.diff(t_ns) > 0) and not np.isnan(command).any():
        return t_ns, command, speed_rad_s, auxiliary  # as nearly all are; saves copies
    t_ns, first = np.unique(t_ns, return_index=True)
    rows = np.where(np.isnan(command[first]), 0, np.arange(len(first))[:, np.newaxis])
    held_ns = t_ns[:, np.newaxis] - t_ns[np.maximum.accumulate(rows, axis=0)]
    command = hold_last(command[first])
    known = ~np.any(np.isnan(command) | (held_ns > LONGEST_HELD_NS), axis=1)
    of_known = {name: of[first][known] for name, of in auxiliary.items()}
    return t_ns[known], command[known], speed_rad_s[first][known], of_known


def _run(path: Path, tray: str, segment: Columns, start_t_ns: int, fans: Sequence[int] | None) -> RecordedRun:
    t_ns, command, speed_rad_s, auxiliary = segment
    if fans is not None:
        if not all(0 <= fan < command.shape[1] for fan in fans):
            raise RecordingError(f"{path}: the tray has fans 0 to {command.shape[1] - 1}; see --fans")
        command, speed_rad_s = command[:, fans], speed_rad_s[:, fans]
        auxiliary = {name: of[:, fans] for name, of in auxiliary.items()}
    return RecordedRun(path, tray, (t_ns - start_t_ns) / NS_PER_S, command, speed_rad_s, auxiliary)


def _rows(run: RecordedRun, wanted: Array) -> RecordedRun:
    if wanted.all():
        return run
    return replace(
        run,
        t_s=run.t_s[wanted],
        command=run.command[wanted],
        speed_rad_s=run.speed_rad_s[wanted],
        auxiliary={name: of[wanted] for name, of in run.auxiliary.items()},
    )

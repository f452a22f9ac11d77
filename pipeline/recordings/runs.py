"""A recording as input for training: time, command and speed of one tray as arrays.

The time of a sample is computed as in the pipeline, from the device clock if there is one
(pipeline.devices.device_clock).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.devices.device_clock import DeviceClock
from pipeline.devices.measured_table import hold_last
from pipeline.recordings.reading import RecordingError, read_metadata, read_recording
from schemas.messages import Array, Raw
from schemas.tacho import Tacho, tacho_of_each_fan
from schemas.units import NS_PER_S


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


def read_runs(
    path: Path,
    tray: str | None = None,
    fans: Sequence[int] | None = None,
    from_s: float = 0.0,
    to_s: float = math.inf,
) -> RecordedTray:
    """The raw samples of a tray with from_s <= t_s < to_s.

    tray: needed only if the recording has several. fans: counted from 0; None for all.

    Raises:
        RecordingError: the file cannot be read, or has no such samples.
    """
    reading = read_recording(path, topics=("raw",))
    by_tray: dict[str, list[Raw]] = {}
    for envelope in reading:
        assert isinstance(envelope.message, Raw)
        if tray is None or envelope.message.header.tray == tray:
            by_tray.setdefault(envelope.message.header.tray, []).append(envelope.message)
    if not by_tray:
        raise RecordingError(f"{path}: no raw samples{f' of tray {tray!r}' if tray else ''} in this recording")
    if len(by_tray) > 1:
        raise RecordingError(f"{path}: several trays, {', '.join(sorted(by_tray))}: choose one with --tray")
    ((name, messages),) = by_tray.items()
    segments = [segment for segment in _segments(path, messages) if len(segment[0])]
    start_ns = segments[0][0][0] if segments else 0
    runs = [
        _run(path, name, (t_ns - start_ns) / NS_PER_S, command, speed_rad_s, fans, from_s, to_s)
        for t_ns, command, speed_rad_s in segments
    ]
    runs = [run for run in runs if len(run.t_s) > 1]
    if not runs:
        raise RecordingError(f"{path}: fewer than two raw samples from {from_s:g} s to {to_s:g} s; see --from and --to")
    metadata = read_metadata(path)
    try:
        tacho = tacho_of_each_fan(metadata.tacho(name), messages[0].fans)
    except (ValueError, RecordingError) as error:
        raise RecordingError(f"{path}: {error}") from error
    chosen = tacho if fans is None else tuple(tacho[fan] for fan in fans)
    return RecordedTray(tuple(runs), metadata.speed_unit(name), chosen, reading.damage)


Columns = tuple[Array, Array, Array]
"""t_ns (n,), command (n, fans), speed_rad_s (n, fans)."""


def _segments(path: Path, messages: Sequence[Raw]) -> list[Columns]:
    """The samples by rising time, one item per segment of the device clock."""
    fans = {message.fans for message in messages}
    if len(fans) > 1:
        raise RecordingError(
            f"{path}: the number of fans changes from {' to '.join(map(str, sorted(fans)))}: split the recording there"
        )
    clock = DeviceClock()
    segments: list[tuple[list[int], list[Array], list[Array]]] = []
    for message in messages:
        clock_us = message.device_clock_us.tolist()
        for k, received_ns in enumerate(message.host_receive_t_ns.tolist()):
            t_ns = clock.to_host_ns(clock_us[k], received_ns) if clock_us else received_ns
            if len(segments) < max(1, clock.segments):
                segments.append(([], [], []))
            times, commands, speeds = segments[-1]
            times.append(t_ns)
            commands.append(message.command[k])
            speeds.append(message.speed_rad_s[k])
    return [_in_order(np.array(t, np.int64), np.array(c), np.array(s)) for t, c, s in segments]


def _in_order(t_ns: Array, command: Array, speed_rad_s: Array) -> Columns:
    """Samples by rising time from the first known command on; of samples with the same time, the first received."""
    t_ns, first = np.unique(t_ns, return_index=True)
    command = hold_last(command[first])
    known = ~np.any(np.isnan(command), axis=1)
    return t_ns[known], command[known], speed_rad_s[first][known]


def _run(
    path: Path,
    tray: str,
    t_s: Array,
    command: Array,
    speed_rad_s: Array,
    fans: Sequence[int] | None,
    from_s: float,
    to_s: float,
) -> RecordedRun:
    if fans is None:
        fans = range(command.shape[1])
    if not all(0 <= fan < command.shape[1] for fan in fans):
        raise RecordingError(f"{path}: the tray has fans 0 to {command.shape[1] - 1}; see --fans")
    wanted = (t_s >= from_s) & (t_s < to_s)
    return RecordedRun(path, tray, t_s[wanted], command[wanted][:, fans], speed_rad_s[wanted][:, fans])

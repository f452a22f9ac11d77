"""Excerpts of a recording of one tray, read by its index: an excerpt costs what it holds, not what the recording holds.

The device clock is followed from CLOCK_MARGIN_S before an excerpt, not from the start of the recording. By then the
mapping to host time rests on the same least delayed samples (a sliding window of 60 s, pipeline.timebase.device_clock),
and its times have approached the same line: with delays of milliseconds, within 0.1 ms. The time between neighbouring
samples stays that of the device clock. pipeline.recordings.training_runs reads all of a recording, and its times are
exactly those of the pipeline.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from mcap.records import ChunkIndex

from fantwin.pipeline.recordings.indexed import IndexedRecording
from fantwin.pipeline.recordings.reading import RecordingError, read_recording
from fantwin.pipeline.recordings.records import CORRUPT_DATA_ERRORS
from fantwin.pipeline.recordings.training_runs import RecordedTray, no_samples, only_tray, recorded_tray, segments_of
from fantwin.schemas.codec import CodecError
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Raw
from fantwin.schemas.topics import tray_of
from fantwin.schemas.units import NS_PER_S

if TYPE_CHECKING:
    from fantwin.schemas.messages import Array

CLOCK_MARGIN_S = 90.0
"""read before an excerpt: the sliding window of the device clock, and time to approach its line"""
LATE_S = 2.0
"""by which samples may be received after they were measured; later ones are missing from an excerpt"""


class ExcerptReader:
    """Reads excerpts of a recording that has raw samples of one tray."""

    def __init__(self, path: Path) -> None:
        """Raises RecordingError: the file cannot be read, is not a recording, or has not one tray with raw samples."""
        self._path = path
        read_recording(path)
        self._indexed = IndexedRecording(path, ("raw",))
        self._chunks = self._indexed.chunks
        self._first_t_ns = np.array([chunk.message_start_time for chunk in self._chunks], np.int64)
        self._last_t_ns = np.array([chunk.message_end_time for chunk in self._chunks], np.int64)
        self._tray = only_tray(path, {tray_of(key) for key, _ in self._indexed.channels.values()})
        self._start_t_ns = self._first_sample_t_ns()

    def read(self, from_s: float, to_s: float) -> RecordedTray:
        """The samples with from_s <= t_s < to_s; seconds are counted from the first sample of the recording.

        Raises:
            RecordingError: there are no two such samples, or as `read_runs`.
        """
        first_t_ns = self._start_t_ns + round((from_s - CLOCK_MARGIN_S) * NS_PER_S)
        last_t_ns = self._start_t_ns + round((to_s + LATE_S) * NS_PER_S)
        within = np.flatnonzero((self._last_t_ns >= first_t_ns) & (self._first_t_ns <= last_t_ns))
        after = np.flatnonzero(self._first_t_ns > last_t_ns)[:1]  # the time of a message is that of its last sample
        raws = list(self._raws([self._chunks[number] for number in sorted({*within.tolist(), *after.tolist()})]))
        if not raws:
            raise no_samples(self._path, from_s, to_s)
        damage = self._indexed.reading.damage
        around = recorded_tray(self._path, self._tray, raws, damage, start_t_ns=self._start_t_ns)
        found = around.between(from_s, to_s)
        if not found.runs:
            raise no_samples(self._path, from_s, to_s)
        return found

    def commands(self, every_s: float) -> tuple[Array, Array]:
        """(n,) seconds and (n, fans) commands of samples that are about `every_s` apart, or as far as samples are.

        Seconds are those of receipt. Few of the messages are decoded.

        Raises:
            RecordingError: the number of fans changes, or as `read_runs`.
        """
        times: list[Array] = []
        commands: list[Array] = []
        for raw in self._spaced(round(every_s * NS_PER_S)):
            t_s = (raw.host_receive_t_ns - self._start_t_ns) / NS_PER_S
            before_s = times[-1][-1] if times else -math.inf
            kept = np.diff(np.floor(t_s / every_s), prepend=np.floor(before_s / every_s)) != 0.0
            if kept.any():
                times.append(t_s[kept])
                commands.append(raw.command[kept])
        if len({command.shape[1] for command in commands}) > 1:
            raise RecordingError(f"{self._path}: the number of fans changes: split the recording there")
        return np.concatenate(times), np.concatenate(commands)

    def _first_sample_t_ns(self) -> int:
        """Time of the first sample with a known command."""
        raws: list[Raw] = []
        for chunk in self._chunks:
            raws += self._raws([chunk])
            if segments := segments_of(self._path, raws) if raws else []:
                return int(segments[0][0][0])
        raise no_samples(self._path, 0.0, math.inf)

    def _spaced(self, every_ns: int) -> Iterator[Raw]:
        """Messages at least so far apart; chunks in between are not read."""
        due_ns = 0

        def is_early(t_ns: int) -> bool:
            return 0 < due_ns - t_ns <= every_ns  # after a host clock was set back, none is

        for chunk in self._chunks:
            if is_early(chunk.message_start_time) and is_early(chunk.message_end_time):
                continue
            for envelope in self._envelopes([chunk]):
                if not is_early(envelope.received_t_ns) and (raw := self._raw(envelope)):
                    due_ns = envelope.received_t_ns + every_ns
                    yield raw

    def _raws(self, chunks: Sequence[ChunkIndex]) -> Iterator[Raw]:
        return filter(None, map(self._raw, self._envelopes(chunks)))

    def _envelopes(self, chunks: Sequence[ChunkIndex]) -> Iterator[Envelope]:
        for chunk in chunks:
            try:
                yield from self._indexed.envelopes(chunk)
            except CORRUPT_DATA_ERRORS:
                self._indexed.reading.damaged_chunks += 1
            except OSError as error:
                raise RecordingError(f"{self._path}: cannot read the recording: {error.strerror}") from error

    def _raw(self, envelope: Envelope) -> Raw | None:
        """The message; None if it cannot be decoded or has no samples."""
        try:
            raw = envelope.message
        except CodecError:
            self._indexed.reading.undecodable += 1
            return None
        assert isinstance(raw, Raw)
        return raw if len(raw.host_receive_t_ns) else None

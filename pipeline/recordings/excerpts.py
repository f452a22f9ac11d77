"""Excerpts of a recording of one tray, read by its index: an excerpt costs what it holds, not what the recording holds.

The device clock is followed from CLOCK_MARGIN_S before an excerpt, not from the start of the recording. By then the
mapping to host time rests on the same least delayed samples (a sliding window of 60 s, pipeline.timebase.device_clock),
and its times have approached the same line: with delays of milliseconds, within 0.1 ms. The time between neighbouring
samples stays that of the device clock. pipeline.recordings.runs reads all of a recording, and its times are exactly
those of the pipeline.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from mcap.records import ChunkIndex

from fantwin.pipeline.recordings.indexed import IndexedRecording
from fantwin.pipeline.recordings.reading import RecordingError, read_recording
from fantwin.pipeline.recordings.records import CORRUPT_DATA_ERRORS
from fantwin.pipeline.recordings.runs import RecordedTray, no_samples, read_runs, recorded_tray, segments_of
from fantwin.schemas.codec import CodecError
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Raw
from fantwin.schemas.units import NS_PER_S

if TYPE_CHECKING:
    from fantwin.schemas.messages import Array

CLOCK_MARGIN_S = 90.0
"""read before an excerpt: the sliding window of the device clock, and time to approach its line"""
LATE_S = 2.0
"""by which samples may be received after they were measured; later ones are missing from an excerpt"""


class ExcerptReader:
    """Reads excerpts of a recording that has raw samples of one tray.

    A recording without a whole index is read whole, once.
    """

    def __init__(self, path: Path) -> None:
        """Raises RecordingError: the file cannot be opened or is not a recording."""
        self._path = path
        self._chunks = _RawChunks.of(path)
        start = self._chunks and self._chunks.start()
        self._start_t_ns, self._tray = start or (0, "")
        if start is None:
            self._chunks = None

    def read(self, from_s: float, to_s: float) -> RecordedTray:
        """The samples with from_s <= t_s < to_s; seconds are counted from the first sample of the recording.

        Raises:
            RecordingError: there are no two such samples, or as `read_runs`.
        """
        around = self._whole if self._chunks is None else self._around(self._chunks, from_s, to_s)
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
        if self._chunks is None:
            runs = self._whole.runs
            t_s, command = np.concatenate([run.t_s for run in runs]), np.concatenate([run.command for run in runs])
            kept = _spaced(t_s, every_s)
            return t_s[kept], command[kept]
        times: list[Array] = []
        commands: list[Array] = []
        for raw in self._chunks.spaced(round(every_s * NS_PER_S)):
            t_s = (raw.host_receive_t_ns - self._start_t_ns) / NS_PER_S
            kept = _spaced(t_s, every_s, times[-1][-1] if times else -math.inf)
            if not kept.any():
                continue
            times.append(t_s[kept])
            commands.append(raw.command[kept])
        if len({command.shape[1] for command in commands}) > 1:
            raise RecordingError(f"{self._path}: the number of fans changes: split the recording there")
        return np.concatenate(times), np.concatenate(commands)

    @cached_property
    def _whole(self) -> RecordedTray:
        return read_runs(self._path)

    def _around(self, chunks: _RawChunks, from_s: float, to_s: float) -> RecordedTray:
        first_t_ns, last_t_ns = (
            self._start_t_ns + round(seconds * NS_PER_S) for seconds in (from_s - CLOCK_MARGIN_S, to_s + LATE_S)
        )
        raws = chunks.between(first_t_ns, last_t_ns)
        if not raws:
            raise no_samples(self._path, from_s, to_s)
        return recorded_tray(self._path, self._tray, raws, chunks.damage, start_t_ns=self._start_t_ns)


def _spaced(t_s: Array, every_s: float, before_s: float = -math.inf) -> Array:
    """(n,) which of successive samples begin another multiple of every_s. before_s: the last one that did."""
    return np.diff(np.floor(t_s / every_s), prepend=np.floor(before_s / every_s)) != 0.0


class _RawChunks:
    """The chunks of a recording with raw samples of one tray, in the order of the file."""

    def __init__(self, indexed: IndexedRecording) -> None:
        """indexed: of raw samples."""
        self._path, self._indexed = indexed.file, indexed
        self._chunks = indexed.chunks
        self._first_t_ns = np.array([chunk.message_start_time for chunk in self._chunks], np.int64)
        self._last_t_ns = np.array([chunk.message_end_time for chunk in self._chunks], np.int64)

    @classmethod
    def of(cls, path: Path) -> _RawChunks | None:
        """None if the file has no index, or raw samples of several trays or none.

        Raises:
            RecordingError: the file cannot be opened or is not a recording.
        """
        read_recording(path)
        indexed = IndexedRecording.of(path, ("raw",))
        return cls(indexed) if indexed and len(indexed.channels) == 1 and indexed.chunks else None

    @property
    def damage(self) -> str:
        """What could not be read so far, in one line; empty if all could."""
        return self._indexed.reading.damage

    def start(self) -> tuple[int, str] | None:
        """Time of the first sample, ns, and the name of the tray; None where these cannot be found in one chunk."""
        raws = self._decoded(self._chunks[:1])
        segments = segments_of(self._path, raws) if raws else []
        return (int(segments[0][0][0]), raws[0].header.tray) if segments else None

    def between(self, first_t_ns: int, last_t_ns: int) -> list[Raw]:
        """The messages of the chunks with any message of this time span, and of the first one after it: the time of a
        message is that of its last sample."""
        within = np.flatnonzero((self._last_t_ns >= first_t_ns) & (self._first_t_ns <= last_t_ns))
        after = np.flatnonzero(self._first_t_ns > last_t_ns)[:1]
        chosen = sorted({*within.tolist(), *after.tolist()})
        return self._decoded([self._chunks[number] for number in chosen])

    def spaced(self, every_ns: int) -> Iterator[Raw]:
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

    def _decoded(self, chunks: Sequence[ChunkIndex]) -> list[Raw]:
        return [raw for envelope in self._envelopes(chunks) if (raw := self._raw(envelope))]

    def _envelopes(self, chunks: Sequence[ChunkIndex]) -> Iterator[Envelope]:
        for chunk in chunks:
            try:
                yield from self._indexed.envelopes(chunk)
            except CORRUPT_DATA_ERRORS:
                self._indexed.reading.damaged_chunks += 1
            except OSError as error:
                raise RecordingError(f"{self._path}: cannot read the recording: {error.strerror}") from error

    def _raw(self, envelope: Envelope) -> Raw | None:
        try:
            raw = envelope.message
        except CodecError:
            self._indexed.reading.undecodable += 1
            return None
        assert isinstance(raw, Raw)
        return raw if len(raw.host_receive_t_ns) else None

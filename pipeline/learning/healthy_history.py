"""The healthy history of a tray: recordings of raw samples from times without an alarm, for learning.

    FOLDER/healthy/FIRST-LAST.mcap   one recording of healthy running; FIRST and LAST are times in ns since 1970

A sample enters a recording only when `hold_back_ns` have passed after it without an alarm, since a fault begins before
its alarm. Until there is a twin, nobody can raise an alarm, and nothing is held back: the fans must be healthy.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pipeline.learning.versions import TimeSpan, overlap
from pipeline.recordings.reading import RecordingError, read_recording
from pipeline.recordings.records import ACTIVE_SUFFIX
from pipeline.recordings.repair import repair_in_place
from pipeline.recordings.writing import RecordingWriter
from schemas.messages import Raw
from schemas.topics import tray_key
from schemas.units import NS_PER_S

HEALTHY = "healthy"
OPEN_NAME = "open.mcap"
SHORTEST_RECORDING_S = 60.0
"""a shorter recording is of no use for learning, and is deleted"""
LONGEST_RECORDING_NS = 8 * 3600 * NS_PER_S
"""of one recording"""
LONGEST_GAP_NS = 60 * NS_PER_S
"""after a longer pause of the samples a new recording begins"""
_NAME = re.compile(r"(\d+)-(\d+)\.mcap")


@dataclass(frozen=True)
class HealthyRecording:
    """A finished recording of healthy running."""

    path: Path
    span: TimeSpan

    @property
    def seconds(self) -> float:
        """How long it is."""
        return (self.span[1] - self.span[0]) / NS_PER_S


def healthy_recordings(folder: Path, excluded: Sequence[TimeSpan] = ()) -> list[HealthyRecording]:
    """The finished recordings of a tray, in order of time, without those that overlap an excluded time span.

    Raises:
        OSError: the folder cannot be read.
    """
    place = folder / HEALTHY
    names = [(_NAME.fullmatch(path.name), path) for path in place.iterdir()] if place.is_dir() else []
    found = [HealthyRecording(path, (int(match[1]), int(match[2]))) for match, path in names if match]
    return sorted((each for each in found if not overlap((each.span,), excluded)), key=lambda each: each.span)


class HealthyHistory:
    """Writes the history of one tray."""

    def __init__(
        self,
        folder: Path,
        site: str,
        tray: str,
        metadata: Mapping[str, str],
        attachments: Mapping[str, bytes],
        *,
        hold_back_s: float,
        kept_s: float,
    ) -> None:
        """hold_back_s: see above. kept_s: of healthy running; older recordings are deleted, except for the first."""
        self._folder = folder
        self._key = tray_key(site, tray, "raw")
        self._metadata, self._attachments = metadata, attachments
        self._hold_back_ns = round(hold_back_s * NS_PER_S)
        self._kept_ns = round(kept_s * NS_PER_S)
        self._waiting: deque[Raw] = deque()
        self._writer: RecordingWriter | None = None
        self._span: TimeSpan = (0, 0)
        self._resumes_t_ns = 0
        """samples up to then are not healthy"""
        self.problem = ""
        self._repair()

    @property
    def seconds(self) -> float:
        """Healthy running in the recordings, the open one as well."""
        return self.seconds_since(0)

    def seconds_since(self, t_ns: int) -> float:
        """The same of those recordings that begin at a time or later."""
        with suppress(OSError):
            finished = sum(each.seconds for each in healthy_recordings(self._folder) if each.span[0] >= t_ns)
            return finished + (self._open_s if self._span[0] >= t_ns else 0.0)
        return 0.0

    @property
    def _open_s(self) -> float:
        return (self._span[1] - self._span[0]) / NS_PER_S

    def add(self, raw: Raw, *, has_alarm: bool, is_watched: bool) -> None:
        """Take samples. has_alarm: a fan of the tray has an alarm now. is_watched: there is a twin."""
        if not len(raw.host_receive_t_ns):
            return
        t_ns = int(raw.host_receive_t_ns[-1])
        if has_alarm:
            self._waiting.clear()
            self.finish()
            self._resumes_t_ns = t_ns + self._hold_back_ns
        if t_ns <= self._resumes_t_ns:
            return
        self._waiting.append(raw)
        held_ns = self._hold_back_ns if is_watched else 0
        while self._waiting and _last_t_ns(self._waiting[0]) <= t_ns - held_ns:
            self._write(self._waiting.popleft())

    def finish(self) -> None:
        """End the open recording, so that it can be learned from; what is held back stays."""
        writer, self._writer = self._writer, None
        span, self._span = self._span, (0, 0)
        if writer is None:
            return
        try:
            if (span[1] - span[0]) / NS_PER_S < SHORTEST_RECORDING_S:
                writer.discard()
                return
            writer.finish()
            writer.path.rename(self._path(span))
            self._delete_oldest()
        except (OSError, RecordingError) as error:
            self.problem = f"{writer.path}: the healthy history cannot be kept: {error}"

    def flush(self) -> None:
        """Write to disk, so that a crash loses only the samples held back."""
        if self._writer:
            try:
                self._writer.flush()
            except RecordingError as error:
                self._fail(error)

    def close(self) -> None:
        """End the open recording; what is held back is dropped."""
        self._waiting.clear()
        self.finish()

    def _write(self, raw: Raw) -> None:
        first_t_ns, last_t_ns = int(raw.host_receive_t_ns[0]), _last_t_ns(raw)
        is_apart = not 0 <= first_t_ns - self._span[1] <= LONGEST_GAP_NS
        if self._writer and (is_apart or last_t_ns - self._span[0] > LONGEST_RECORDING_NS):
            self.finish()
        try:
            if self._writer is None:
                place = self._folder / HEALTHY / OPEN_NAME
                self._writer = RecordingWriter(
                    place, self._metadata, self._attachments, t_ns=first_t_ns, overwrite=True
                )
                self._span = (first_t_ns, last_t_ns)
            self._writer.add_message(self._key, raw, last_t_ns)
            self._span = (self._span[0], last_t_ns)
            self.problem = ""
        except RecordingError as error:
            self._fail(error)

    def _fail(self, error: RecordingError) -> None:
        """A write failed: the unfinished recording is deleted, and the next sample starts another."""
        writer, self._writer, self._span = self._writer, None, (0, 0)
        if writer:
            with suppress(OSError, RecordingError):
                writer.discard()
        self.problem = f"nothing is learned: {error}"

    def _path(self, span: TimeSpan) -> Path:
        return self._folder / HEALTHY / f"{span[0]}-{span[1]}.mcap"

    def _delete_oldest(self) -> None:
        left_ns = self._kept_ns
        for each in reversed(healthy_recordings(self._folder)[1:]):
            left_ns -= each.span[1] - each.span[0]
            if left_ns < 0:
                each.path.unlink()

    def _repair(self) -> None:
        """Repair the recording that a killed process left open, and name it as finished."""
        active = self._folder / HEALTHY / (OPEN_NAME + ACTIVE_SUFFIX)
        left = [active] if active.exists() else []
        try:
            for path in left:
                recovery = repair_in_place(path)
                if recovery is not None:
                    self._name(recovery.path)
        except (OSError, RecordingError) as error:
            self.problem = f"{active}: cannot be repaired, so it is not learned from: {error}"

    def _name(self, path: Path) -> None:
        times = _raw_times(path)
        if not times or (times[-1] - times[0]) / NS_PER_S < SHORTEST_RECORDING_S:
            path.unlink()
        else:
            path.rename(self._path((times[0], times[-1])))


def recorded_raws(folder: Path) -> Iterator[Raw]:
    """The samples of the history of a tray, in order.

    Raises:
        RecordingError: a recording cannot be read.
    """
    for each in healthy_recordings(folder):
        yield from _raws(each.path)


def _raws(path: Path) -> Iterator[Raw]:
    for envelope in read_recording(path, ("raw",)):
        assert isinstance(envelope.message, Raw)
        yield envelope.message


def _raw_times(path: Path) -> list[int]:
    return [t_ns for raw in _raws(path) for t_ns in raw.host_receive_t_ns.tolist()]


def _last_t_ns(raw: Raw) -> int:
    return int(raw.host_receive_t_ns[-1])

"""Recordings of raw samples in one folder of a tray's history: finished after a while, and the oldest deleted.

PLACE/FIRST-LAST.mcap   FIRST and LAST are times in ns since 1970
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from fantwin.pipeline.learning.versions import TimeSpan, overlap
from fantwin.pipeline.recordings.indexed import last_message_ns
from fantwin.pipeline.recordings.reading import RecordingError, read_recording
from fantwin.pipeline.recordings.records import ACTIVE_SUFFIX
from fantwin.pipeline.recordings.repair import repair_in_place
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.messages import Raw
from fantwin.schemas.units import NS_PER_S

OPEN_NAME = "open.mcap"
LEFT_NAMES = "open*.mcap"
"""of a recording that was finished and not renamed, or repaired beside such a one"""
SHORTEST_RECORDING_S = 60.0
"""a shorter recording is of no use for learning, and is deleted"""
LONGEST_RECORDING_NS = 8 * 3600 * NS_PER_S
"""of one recording"""
LONGEST_GAP_NS = 60 * NS_PER_S
"""after a longer pause of the samples a new recording begins"""
_NAME = re.compile(r"(\d+)-(\d+)\.mcap")


@dataclass(frozen=True)
class HistoryRecording:
    """A finished recording."""

    path: Path
    span: TimeSpan

    @property
    def seconds(self) -> float:
        """How long it is."""
        return _seconds(self.span)


def recordings_in(place: Path, excluded: Sequence[TimeSpan] = ()) -> list[HistoryRecording]:
    """The finished recordings of a folder, in order of time, without those that overlap an excluded time span.

    Raises:
        OSError: the folder cannot be read.
    """
    names = [(_NAME.fullmatch(path.name), path) for path in place.iterdir()] if place.is_dir() else []
    found = [HistoryRecording(path, (int(match[1]), int(match[2]))) for match, path in names if match]
    return sorted((each for each in found if not overlap((each.span,), excluded)), key=lambda each: each.span)


@dataclass
class HistoryProblems:
    """Why samples are not kept, of all folders of a tray."""

    write: str = ""
    """shown until samples are on the disk again, in any folder"""
    finish: str = ""
    """of a recording that could not be finished or repaired; shown until another one is finished"""


class HistoryRecordings:
    """Writes the recordings of one folder; nobody else writes or deletes them."""

    def __init__(
        self,
        place: Path,
        key: str,
        metadata: Mapping[str, str],
        attachments: Mapping[str, bytes],
        problems: HistoryProblems,
        *,
        kept_s: float,
        keeps_first: bool,
    ) -> None:
        """key: of the samples on the bus. problems: of the tray, kept up to date. kept_s: of running in the recordings
        outside the excluded time spans, and as much in the others; older ones are deleted. keeps_first: except for the
        first."""
        self._place = place
        self._key = key
        self._metadata, self._attachments, self._problems = metadata, attachments, problems
        self._kept_s, self._first_deleted = kept_s, int(keeps_first)
        self._writer: RecordingWriter | None = None
        self._span: TimeSpan = (0, 0)
        self._finished: list[HistoryRecording] = []
        self._usable: list[HistoryRecording] = []
        """those outside the excluded time spans"""
        self._excluded: Sequence[TimeSpan] = ()
        self.end_t_ns = 0
        """end of the newest finished recording; 0: none yet"""
        self._name_left()

    def seconds_since(self, t_ns: int) -> float:
        """Running in the recordings outside the excluded time spans that begin at a time or later, the open one as
        well."""
        finished = sum(each.seconds for each in self._usable if each.span[0] >= t_ns)
        counts = self._span[0] >= t_ns and not self._is_excluded(self._span)
        return finished + (_seconds(self._span) if counts else 0.0)

    @property
    def kept_since_t_ns(self) -> int:
        """Beginning of the oldest recording but the first; 0 without one."""
        return self._finished[1].span[0] if len(self._finished) > 1 else 0

    def exclude(self, spans: Sequence[TimeSpan]) -> None:
        """Recordings that overlap these time spans no longer count; a new one begins where such a span ends."""
        self._excluded = spans
        self._usable = [each for each in self._finished if not self._is_excluded(each.span)]

    def write(self, raw: Raw) -> None:
        """Add samples, at least one, later than all before them."""
        first_t_ns, newest_t_ns = int(raw.host_receive_t_ns[0]), last_t_ns(raw)
        if self._writer and not self._continues(first_t_ns, newest_t_ns):
            self.finish()
        try:
            if self._writer is None:
                self._writer = RecordingWriter(
                    self._place / OPEN_NAME, self._metadata, self._attachments, t_ns=first_t_ns, overwrite=True
                )
                self._span = (first_t_ns, newest_t_ns)
            self._writer.add_message(self._key, raw, newest_t_ns)
            self._span = (self._span[0], newest_t_ns)
        except RecordingError as error:
            self._fail(error)

    def finish(self) -> None:
        """End the open recording, so that it can be learned from."""
        writer, self._writer = self._writer, None
        span, self._span = self._span, (0, 0)
        if writer is None:
            return
        try:
            if _seconds(span) < SHORTEST_RECORDING_S:
                writer.discard()
                return
            writer.finish()
            writer.path.rename(self._path(span))
            self._list_finished()
            self._delete_oldest()
            self._problems.write = self._problems.finish = ""
        except (OSError, RecordingError) as error:
            self._problems.finish = f"{writer.path}: the history cannot be kept: {error}"
            self._name_left()

    def flush(self) -> None:
        """Write to disk, so that a crash loses only the samples added since."""
        if self._writer:
            try:
                self._writer.flush()
                self._problems.write = ""
            except RecordingError as error:
                self._fail(error)

    def _continues(self, first_t_ns: int, newest_t_ns: int) -> bool:
        """Whether samples belong into the open recording."""
        follows = 0 <= first_t_ns - self._span[1] <= LONGEST_GAP_NS
        fits = newest_t_ns - self._span[0] <= LONGEST_RECORDING_NS
        return follows and fits and self._is_excluded((first_t_ns, newest_t_ns)) == self._is_excluded(self._span)

    def _is_excluded(self, span: TimeSpan) -> bool:
        return overlap((span,), self._excluded)

    def _fail(self, error: RecordingError) -> None:
        """A write failed: the recording ends after what is on the disk, and the next sample starts another."""
        writer, self._writer, self._span = self._writer, None, (0, 0)
        if writer:
            with suppress(OSError):
                writer.discard()  # if it has not ended
        self._problems.write = f"samples are not kept for learning: {error}"
        self._name_left()

    def _path(self, span: TimeSpan) -> Path:
        return self._place / f"{span[0]}-{span[1]}.mcap"

    def _list_finished(self) -> None:
        self._finished = recordings_in(self._place)
        self.end_t_ns = max((each.span[1] for each in self._finished), default=0)
        self.exclude(self._excluded)

    def _delete_oldest(self) -> None:
        """Excluded recordings take no place of others; of them as much is kept, since they may be used again."""
        left_ns = dict.fromkeys((False, True), round(self._kept_s * NS_PER_S))
        for each in reversed(self._finished[self._first_deleted :]):
            is_excluded = self._is_excluded(each.span)
            left_ns[is_excluded] -= each.span[1] - each.span[0]
            if left_ns[is_excluded] < 0:
                each.path.unlink()
        if min(left_ns.values()) < 0:
            self._list_finished()

    def _name_left(self) -> None:
        """Name the recordings that a killed process or a full disk left, as finished ones."""
        finished = sorted(self._place.glob(LEFT_NAMES))
        active = self._place / (OPEN_NAME + ACTIVE_SUFFIX)
        for path in (*finished, *([active] if active.exists() else [])):
            try:
                self._name(path)
            except (OSError, RecordingError) as error:
                self._problems.finish = f"{path}: cannot be repaired, so it is not learned from: {error}"
        try:
            self._list_finished()
        except OSError as error:
            self._problems.finish = f"{self._place}: cannot be read: {error.strerror}"

    def _name(self, path: Path) -> None:
        """Repair it if it was not ended, and name it by its times; too short a recording is deleted."""
        if path.name.endswith(ACTIVE_SUFFIX):
            recovery = repair_in_place(path)
            if recovery is None:
                return
            path = recovery.path
        span = _span(path)
        if _seconds(span) < SHORTEST_RECORDING_S:
            path.unlink()
        else:
            path.rename(self._path(span))


def raws_of(path: Path) -> Iterator[Raw]:
    """The samples of a recording, in order.

    Raises:
        RecordingError: it cannot be read.
    """
    for envelope in read_recording(path, ("raw",)):
        assert isinstance(envelope.message, Raw)
        yield envelope.message


def _span(path: Path) -> TimeSpan:
    """First and last time of the samples of a recording; (0, 0) if there are none."""
    first = next(raws_of(path), None)
    if first is None:
        return 0, 0
    return int(first.host_receive_t_ns[0]), last_message_ns(path) or max(map(last_t_ns, raws_of(path)))


def _seconds(span: TimeSpan) -> float:
    return (span[1] - span[0]) / NS_PER_S


def last_t_ns(raw: Raw) -> int:
    """Receipt of the newest of samples, ns since 1970."""
    return int(raw.host_receive_t_ns[-1])

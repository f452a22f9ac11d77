"""The healthy history of a tray: recordings of raw samples from times without an alarm, for learning.

    FOLDER/healthy/FIRST-LAST.mcap   one recording of healthy running; FIRST and LAST are times in ns since 1970

A sample enters a recording only when the fans have been judged for `hold_back_s` after it without an alarm, since a
fault begins before its alarm. Until there is a twin, nobody can raise an alarm, and nothing is held back: the fans must
be healthy.
"""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.learning.versions import TimeSpan, overlap
from pipeline.recordings.reading import RecordingError, read_recording
from pipeline.recordings.records import ACTIVE_SUFFIX, CORRUPT_DATA_ERRORS, indexed_reader
from pipeline.recordings.repair import repair_in_place
from pipeline.recordings.writing import RecordingWriter
from schemas.messages import Array, Raw
from schemas.topics import tray_key
from schemas.units import NS_PER_S

HEALTHY = "healthy"
OPEN_NAME = "open.mcap"
LEFT_NAMES = "open*.mcap"
"""of a recording that was finished and not renamed, or repaired beside such a one"""
SHORTEST_RECORDING_S = 60.0
"""a shorter recording is of no use for learning, and is deleted"""
LONGEST_RECORDING_NS = 8 * 3600 * NS_PER_S
"""of one recording"""
LONGEST_GAP_NS = 60 * NS_PER_S
"""after a longer pause of the samples a new recording begins; samples in a longer pause of the scores are discarded"""
LONGEST_LAG_NS = 1800 * NS_PER_S
"""of the scores behind the samples; samples that wait longer to be judged are discarded"""
_NAME = re.compile(r"(\d+)-(\d+)\.mcap")


@dataclass(frozen=True)
class HealthyRecording:
    """A finished recording of healthy running."""

    path: Path
    span: TimeSpan

    @property
    def seconds(self) -> float:
        """How long it is."""
        return _seconds(self.span)


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
        """hold_back_s: see above. kept_s: of healthy running in the recordings outside the excluded time spans, and as
        much in the others; older ones are deleted, except for the first."""
        self._folder = folder
        self._place = folder / HEALTHY
        self._key = tray_key(site, tray, "raw")
        self._metadata, self._attachments = metadata, attachments
        self._hold_back_ns = round(hold_back_s * NS_PER_S)
        self.kept_s = kept_s
        self._waiting: deque[Raw] = deque()
        self._writer: RecordingWriter | None = None
        self._span: TimeSpan = (0, 0)
        self._finished: list[HealthyRecording] = []
        """the finished recordings; nobody else writes or deletes them"""
        self._usable: list[HealthyRecording] = []
        """those outside the excluded time spans"""
        self._excluded: Sequence[TimeSpan] = ()
        self._resumes_t_ns = 0
        """samples up to then are not healthy"""
        self._judged_t_ns = 0
        """up to then fans were judged"""
        self.newest_t_ns = 0
        """time of the newest sample; 0: none yet"""
        self.end_t_ns = 0
        """end of the newest finished recording; 0: none yet"""
        self._write_problem = ""
        """shown until samples are on the disk again"""
        self._finish_problem = ""
        """of a recording that could not be finished or repaired; shown until the next one is finished"""
        self._name_left()

    @property
    def problem(self) -> str:
        """Why samples are not kept, or a recording was not; empty if all is well."""
        return "; ".join(filter(None, (self._write_problem, self._finish_problem)))

    @property
    def seconds(self) -> float:
        """Healthy running in the recordings outside the excluded time spans, the open one as well."""
        return self.seconds_since(0)

    def seconds_since(self, t_ns: int) -> float:
        """The same of those recordings that begin at a time or later."""
        finished = sum(each.seconds for each in self._usable if each.span[0] >= t_ns)
        counts = self._span[0] >= t_ns and not self._is_excluded(self._span)
        return finished + (_seconds(self._span) if counts else 0.0)

    def exclude(self, spans: Sequence[TimeSpan]) -> None:
        """Recordings that overlap these time spans no longer count; a new one begins where such a span ends."""
        self._excluded = spans
        self._usable = [each for each in self._finished if not self._is_excluded(each.span)]

    def add(self, raw: Raw, *, has_alarm: bool, is_watched: bool) -> None:
        """Take samples. has_alarm: a fan of the tray has an alarm now. is_watched: there is a twin, so that samples
        are held until `judged` releases them."""
        if not len(raw.host_receive_t_ns):
            return
        t_ns = _last_t_ns(raw)
        if t_ns < self.newest_t_ns - self._hold_back_ns:
            self._begin_again(t_ns)
        self.newest_t_ns = t_ns
        if has_alarm:
            self._stop()
        if int(raw.host_receive_t_ns[0]) <= self._resumes_t_ns:
            return
        self._waiting.append(raw)
        if is_watched:
            self._discard_up_to(t_ns - self._hold_back_ns - LONGEST_LAG_NS)
        else:
            self._release(t_ns)

    def judged(self, t_ns: Array, *, had_alarm: bool) -> None:
        """The fans were judged at these times, rising. had_alarm: one had an alarm, then or since the times before.

        What was held before a pause of these times is discarded: nobody would have seen a fault.
        """
        if had_alarm:
            self._stop()
        if not len(t_ns):
            return
        # not beyond the newest sample: older scores still come after the clock was set back
        times = np.minimum(np.concatenate(([self._judged_t_ns], t_ns)), self.newest_t_ns)
        after_pause = times[1:][np.diff(times) > LONGEST_GAP_NS]
        if len(after_pause):
            self._discard_up_to(int(after_pause[-1]))
        self._judged_t_ns = int(times[-1])
        self._release(self._judged_t_ns - self._hold_back_ns)

    def finish(self) -> None:
        """End the open recording, so that it can be learned from; what is held back stays."""
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
            self._write_problem = self._finish_problem = ""
        except (OSError, RecordingError) as error:
            self._finish_problem = f"{writer.path}: the healthy history cannot be kept: {error}"
            self._name_left()

    def flush(self) -> None:
        """Write to disk, so that a crash loses only the samples held back and those added since."""
        if self._writer:
            try:
                self._writer.flush()
                self._write_problem = ""
            except RecordingError as error:
                self._fail(error)

    def close(self) -> None:
        """End the open recording; what is held back is dropped."""
        self._waiting.clear()
        self.finish()

    def begin_after(self, t_ns: int) -> None:
        """Samples up to then enter no recording any more: fans are commissioned again."""
        self.close()
        self._resumes_t_ns = max(self._resumes_t_ns, t_ns)

    @property
    def kept_since_t_ns(self) -> int:
        """Beginning of the oldest recording but the first, which is kept for ever; 0 without one."""
        return self._finished[1].span[0] if len(self._finished) > 1 else 0

    def _begin_again(self, t_ns: int) -> None:
        """The clock was set back: times from before say nothing about samples from now on."""
        self.close()
        self._resumes_t_ns = min(self._resumes_t_ns, t_ns + self._hold_back_ns)
        self._judged_t_ns = 0

    def _stop(self) -> None:
        """A fan has an alarm: neither what is held is healthy, nor what comes shortly after."""
        self.close()
        self._resumes_t_ns = self.newest_t_ns + self._hold_back_ns

    def _discard_up_to(self, t_ns: int) -> None:
        while self._waiting and int(self._waiting[0].host_receive_t_ns[0]) <= t_ns:
            self._waiting.popleft()

    def _release(self, t_ns: int) -> None:
        """Write what is held and ends at a time or earlier."""
        while self._waiting and _last_t_ns(self._waiting[0]) <= t_ns:
            self._write(self._waiting.popleft())

    def _write(self, raw: Raw) -> None:
        first_t_ns, last_t_ns = int(raw.host_receive_t_ns[0]), _last_t_ns(raw)
        if self._writer and not self._continues(first_t_ns, last_t_ns):
            self.finish()
        try:
            if self._writer is None:
                self._writer = RecordingWriter(
                    self._place / OPEN_NAME, self._metadata, self._attachments, t_ns=first_t_ns, overwrite=True
                )
                self._span = (first_t_ns, last_t_ns)
            self._writer.add_message(self._key, raw, last_t_ns)
            self._span = (self._span[0], last_t_ns)
        except RecordingError as error:
            self._fail(error)

    def _continues(self, first_t_ns: int, last_t_ns: int) -> bool:
        """Whether samples belong into the open recording."""
        follows = 0 <= first_t_ns - self._span[1] <= LONGEST_GAP_NS
        fits = last_t_ns - self._span[0] <= LONGEST_RECORDING_NS
        return follows and fits and self._is_excluded((first_t_ns, last_t_ns)) == self._is_excluded(self._span)

    def _is_excluded(self, span: TimeSpan) -> bool:
        return overlap((span,), self._excluded)

    def _fail(self, error: RecordingError) -> None:
        """A write failed: the recording ends after what is on the disk, and the next sample starts another."""
        writer, self._writer, self._span = self._writer, None, (0, 0)
        if writer:
            with suppress(OSError):
                writer.discard()  # if it has not ended
        self._write_problem = f"nothing is learned: {error}"
        self._name_left()

    def _path(self, span: TimeSpan) -> Path:
        return self._place / f"{span[0]}-{span[1]}.mcap"

    def _list_finished(self) -> None:
        self._finished = healthy_recordings(self._folder)
        self.end_t_ns = max((each.span[1] for each in self._finished), default=0)
        self.exclude(self._excluded)

    def _delete_oldest(self) -> None:
        """Excluded recordings take no place of others; of them as much is kept, since they may be used again."""
        left_ns = dict.fromkeys((False, True), round(self.kept_s * NS_PER_S))
        for each in reversed(self._finished[1:]):
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
                self._finish_problem = f"{path}: cannot be repaired, so it is not learned from: {error}"
        try:
            self._list_finished()
        except OSError as error:
            self._finish_problem = f"{self._place}: cannot be read: {error.strerror}"

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


def _span(path: Path) -> TimeSpan:
    """First and last time of the samples of a recording; (0, 0) if there are none."""
    first = next(_raws(path), None)
    if first is None:
        return 0, 0
    return int(first.host_receive_t_ns[0]), _indexed_end_t_ns(path) or max(map(_last_t_ns, _raws(path)))


def _indexed_end_t_ns(path: Path) -> int:
    """The newest receipt by the index of a recording, that of its last samples; 0 if it has no index."""
    with path.open("rb") as file, suppress(*CORRUPT_DATA_ERRORS):
        summary = indexed_reader(file).get_summary()
        return summary.statistics.message_end_time if summary and summary.statistics else 0
    return 0


def _seconds(span: TimeSpan) -> float:
    return (span[1] - span[0]) / NS_PER_S


def _last_t_ns(raw: Raw) -> int:
    return int(raw.host_receive_t_ns[-1])

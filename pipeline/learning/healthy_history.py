"""The history of a tray for learning: recordings of raw samples from times without an alarm, and of those near one.

    FOLDER/healthy/FIRST-LAST.mcap       one recording of healthy running; FIRST and LAST are times in ns since 1970
    FOLDER/near_alarms/FIRST-LAST.mcap   one of running while a fan had an alarm, shortly before and after

A sample counts as healthy only when the fans have been judged for `hold_back_s` after it without an alarm, since a
fault begins before its alarm. Until there is a twin, nobody can raise an alarm, and nothing is held back: the fans must
be healthy. No twin takes over that was learned from samples near an alarm; they show when most fans have changed alike.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from fantwin.pipeline.learning.history_recordings import (
    LONGEST_GAP_NS,
    HistoryProblems,
    HistoryRecording,
    HistoryRecordings,
    last_t_ns,
    raws_of,
    recordings_in,
)
from fantwin.pipeline.learning.versions import TimeSpan
from fantwin.schemas.messages import Array, Raw
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import NS_PER_S

HEALTHY, NEAR_ALARMS = "healthy", "near_alarms"
HOLD_BACK_S = 600.0
"""a fault begins before its alarm: of so long before one, nothing is learned"""
KEPT_S = 7 * 24 * 3600.0
"""healthy running that is kept: what a plant does on each day of the week"""
NEAR_ALARMS_KEPT_S = 24 * 3600.0
"""of running near alarms: about so much, in whole recordings"""
LONGEST_LAG_NS = 1800 * NS_PER_S
"""of the scores behind the samples; samples that wait longer to be judged are discarded"""


def healthy_recordings(folder: Path, excluded: Sequence[TimeSpan] = ()) -> list[HistoryRecording]:
    """The finished recordings of healthy running of a tray; see `recordings_in`."""
    return recordings_in(folder / HEALTHY, excluded)


def recordings_near_alarms(folder: Path, excluded: Sequence[TimeSpan] = ()) -> list[HistoryRecording]:
    """The finished recordings of a tray's running near alarms; see `recordings_in`."""
    return recordings_in(folder / NEAR_ALARMS, excluded)


def recorded_raws(folder: Path) -> Iterator[Raw]:
    """The samples of healthy running of a tray, in order.

    Raises:
        RecordingError: a recording cannot be read.
    """
    for each in healthy_recordings(folder):
        yield from raws_of(each.path)


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
        hold_back_s: float = HOLD_BACK_S,
        kept_s: float = KEPT_S,
    ) -> None:
        """hold_back_s: see above. kept_s: of healthy running outside the excluded time spans, and as much within them;
        older recordings are deleted, except for the first."""
        key = tray_key(site, tray, "raw")
        self._problems = HistoryProblems()
        given = key, metadata, attachments, self._problems
        self._healthy = HistoryRecordings(folder / HEALTHY, *given, kept_s=kept_s, keeps_first=True)
        self._near_alarms = HistoryRecordings(
            folder / NEAR_ALARMS, *given, kept_s=NEAR_ALARMS_KEPT_S, keeps_first=False
        )
        self._both = self._healthy, self._near_alarms
        self._hold_back_ns = round(hold_back_s * NS_PER_S)
        self._waiting: deque[Raw] = deque()
        self._commissioned_t_ns = 0
        """samples up to then are of fans as they were before"""
        self._resumes_t_ns = 0
        """samples up to then are near an alarm"""
        self._judged_t_ns = 0
        """up to then fans were judged"""
        self.newest_t_ns = 0
        """time of the newest sample; 0: none yet"""

    @property
    def problem(self) -> str:
        """Why samples are not kept, or a recording was not; empty if all is well."""
        return "; ".join(filter(None, (self._problems.write, self._problems.finish)))

    @property
    def end_t_ns(self) -> int:
        """End of the newest finished recording; 0: none yet."""
        return max(each.end_t_ns for each in self._both)

    @property
    def seconds(self) -> float:
        """Healthy running in the recordings outside the excluded time spans, the open one as well."""
        return self.seconds_since(0)

    def seconds_since(self, t_ns: int) -> float:
        """The same of those recordings that begin at a time or later."""
        return self._healthy.seconds_since(t_ns)

    def seconds_near_alarms_since(self, t_ns: int) -> float:
        """The same of running near alarms."""
        return self._near_alarms.seconds_since(t_ns)

    @property
    def kept_since_t_ns(self) -> int:
        """Beginning of the oldest recording of healthy running but the first, which is kept for ever; 0 without one."""
        return self._healthy.kept_since_t_ns

    def exclude(self, spans: Sequence[TimeSpan]) -> None:
        """Recordings that overlap these time spans no longer count; a new one begins where such a span ends."""
        for each in self._both:
            each.exclude(spans)

    def add(self, raw: Raw, *, has_alarm: bool, is_watched: bool) -> None:
        """Take samples. has_alarm: a fan of the tray has an alarm now. is_watched: there is a twin, so that samples
        are held until `judged` releases them."""
        if not len(raw.host_receive_t_ns):
            return
        t_ns = last_t_ns(raw)
        if t_ns < self.newest_t_ns - self._hold_back_ns:
            self._begin_again(t_ns)
        self.newest_t_ns = t_ns
        if has_alarm:
            self._stop()
        first_t_ns = int(raw.host_receive_t_ns[0])
        if first_t_ns <= self._commissioned_t_ns:
            return
        if first_t_ns <= self._resumes_t_ns:
            self._near_alarms.write(raw)
            return
        self._near_alarms.finish()
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
        """End the open recordings, so that they can be learned from; what is held back stays."""
        for each in self._both:
            each.finish()

    def flush(self) -> None:
        """Write to disk, so that a crash loses only the samples held back and those added since."""
        for each in self._both:
            each.flush()

    def close(self) -> None:
        """End the open recordings; what is held back is dropped."""
        self._waiting.clear()
        self.finish()

    def begin_after(self, t_ns: int) -> None:
        """Samples up to then enter no recording any more: fans are commissioned again."""
        self.close()
        self._commissioned_t_ns = max(self._commissioned_t_ns, t_ns)

    def _begin_again(self, t_ns: int) -> None:
        """The clock was set back: times from before say nothing about samples from now on."""
        self.close()
        self._commissioned_t_ns = min(self._commissioned_t_ns, t_ns + self._hold_back_ns)
        self._resumes_t_ns = min(self._resumes_t_ns, t_ns + self._hold_back_ns)
        self._judged_t_ns = 0

    def _stop(self) -> None:
        """A fan has an alarm: neither what is held is healthy, nor what comes shortly after."""
        self._healthy.finish()
        while self._waiting:
            self._near_alarms.write(self._waiting.popleft())
        self._resumes_t_ns = self.newest_t_ns + self._hold_back_ns

    def _discard_up_to(self, t_ns: int) -> None:
        while self._waiting and int(self._waiting[0].host_receive_t_ns[0]) <= t_ns:
            self._waiting.popleft()

    def _release(self, t_ns: int) -> None:
        """Write what is held and ends at a time or earlier."""
        while self._waiting and last_t_ns(self._waiting[0]) <= t_ns:
            self._healthy.write(self._waiting.popleft())

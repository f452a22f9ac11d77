"""The messages to play: a stretch of the recordings of a run, their parts in order, each message once.

The learned versions of a recording's twins are published again for stages that judge the replay. The integrator of a
recorded site said on topic `twin` which version it had changed to, and at which sample. A replay turns this into
messages of topic `new_twin`, as the learner sends them, which also name that sample.

A message must arrive before its sample, and samples from `raw` come by way of the resampler. So each version is
published in advance: as soon as the one before it takes over. What the replay keeps for stages that start later is then
the version in force and the next one.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import islice
from pathlib import Path
from typing import Any

from fantwin.pipeline.recordings.indexed import last_message_ns, rare_messages
from fantwin.pipeline.recordings.parts import Seen, in_order
from fantwin.pipeline.recordings.reading import RecordingError, read_recording
from fantwin.pipeline.recordings.run_recordings import describe, recordings_of
from fantwin.pipeline.replay.live.player import sample_times
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import ModelCard, NewTwin
from fantwin.schemas.topics import tray_of
from fantwin.schemas.units import NS_PER_S

TWIN, NEW_TWIN = "twin", "new_twin"


@dataclass(frozen=True)
class Version:
    """A learned twin, and the time of the first sample that it predicts."""

    card: ModelCard
    first_t_ns: int


def read_versions(files: Iterable[Path]) -> dict[str, list[Version]]:
    """The versions of each tray in the order they took over; files: the parts of a recording in order.

    Raises:
        RecordingError: a file cannot be read.
    """
    seen = Seen()
    producers: dict[str, str] = {}
    versions: dict[str, list[Version]] = {}
    for entry in (entry for file in files for entry in rare_messages(file, TWIN)):
        card = entry.message
        assert isinstance(card, ModelCard)
        tray, header = tray_of(entry.key), card.header
        if not card.content or not seen.is_new(entry):
            continue
        known = versions.setdefault(tray, [])
        before, producers[tray] = producers.get(tray, header.producer), header.producer
        if known and known[-1].card.sha256 == card.sha256:
            continue
        first_t_ns = card.t_ns
        if before != header.producer:
            # An integrator that was restarted predicts old samples again. The version is new for those after its start.
            first_t_ns = max(first_t_ns, entry.received_t_ns)
        known.append(Version(card, max(first_t_ns, known[-1].first_t_ns) if known else first_t_ns))
    return versions


class ComingVersions:
    """The versions that one round of a replay has still to publish."""

    def __init__(
        self, versions: Mapping[str, Sequence[Version]], end_ns: int | None = None, *, is_first_round: bool = True
    ) -> None:
        """end_ns: later versions do not take over in this round; None: all do."""
        self._coming = {
            tray: [each for each in of_tray if end_ns is None or each.first_t_ns <= end_ns]
            for tray, of_tray in versions.items()
        }
        self._is_first_round = is_first_round
        self._begin_ns: dict[str, int] = {}
        """by tray: time of its first sample in this round"""
        self._published_until_ns: dict[str, int] = {}
        """by tray: when the newest version that was published takes over"""

    def before(self, entry: Envelope) -> Iterator[Envelope]:
        """What is to be published before a message: at the first samples of a tray the version then in force; then
        each version as soon as the one before it takes over."""
        tray = tray_of(entry.key)
        coming, times = self._coming.get(tray), sample_times(entry.message)
        if not coming or not len(times):
            return
        oldest_ns, newest_ns = int(times[0]), int(times[-1])
        begin_ns = self._begin_ns.setdefault(tray, oldest_ns)
        while len(coming) > 1 and coming[1].first_t_ns <= begin_ns:
            del coming[0]
        while coming and self._published_until_ns.get(tray, oldest_ns) <= newest_ns:
            version = coming.pop(0)
            first_t_ns = version.first_t_ns
            if not self._is_first_round:
                # Not at samples of the round before. In the first round there are none; its grid may begin a little
                # before its first raw sample.
                first_t_ns = max(first_t_ns, begin_ns)
            self._published_until_ns[tray] = first_t_ns
            yield _message(entry, version.card, oldest_ns, first_t_ns)


def _message(entry: Envelope, card: ModelCard, t_ns: int, first_t_ns: int) -> Envelope:
    key = entry.key.rpartition("/")[0] + f"/{NEW_TWIN}"
    message = NewTwin(t_ns=t_ns, twin=card.twin, sha256=card.sha256, content=card.content, first_sample_t_ns=first_t_ns)
    return Envelope.of(key, message, entry.received_t_ns)


LOOP_GAP_NS = 10_000_000  # between two rounds of a recording without a grid, whose period would say more
OUT_OF_ORDER_NS = 10 * NS_PER_S
"""how much later than its followers a message may be recorded, because it was recovered from its producer"""
LATCHED_TOPIC = TWIN
"""the topic whose last message before the stretch still holds at its start"""


class RecordingPlayback:
    """The messages of a recording, of some topics, in the order they were received."""

    def __init__(
        self, files: Sequence[Path], topics: Collection[str], start_s: float = 0.0, end_s: float = math.inf
    ) -> None:
        """Read the first message of each file; `start_s` and `end_s` count from the first message of all.

        With topic `new_twin`, which is not recorded, the learned versions of the twins are played too, if there are
        any.

        Raises:
            RecordingError: a file is not a recording, or no file holds a message.
        """
        firsts = {file: entry for file in in_order(files) for entry in islice(read_recording(file), 1)}
        if not firsts:
            raise RecordingError(f"{files[0]}: there is no message in it")
        self.files = list(firsts)
        self._recordings = recordings_of(map(describe, self.files))
        first = self.first = firsts[self.files[0]]
        # with start_s = 0 everything is played, also messages that were recorded out of order
        self._start_ns = first.received_t_ns + round(start_s * NS_PER_S) if start_s else 0
        self._end_ns = first.received_t_ns + round(end_s * NS_PER_S) if math.isfinite(end_s) else None
        self._versions = read_versions(self.files) if NEW_TWIN in topics else {}
        self.topics = tuple(topic for topic in topics if topic != NEW_TWIN or self._versions)
        """those that are played"""
        self.damage: tuple[str, ...] = ()
        """what could not be read of the files that were played, a line a file"""

    def seconds_at(self, t_ns: int) -> float:
        """Seconds since the first message of the recording."""
        return (t_ns - self.first.received_t_ns) / NS_PER_S

    def end_s(self) -> float:
        """The end of the stretch in seconds since the first message."""
        recorded = max(map(last_message_ns, self.files))
        return self.seconds_at(min(recorded, self._end_ns) if self._end_ns is not None else recorded)

    def __iter__(self) -> Iterator[Envelope]:
        """One round."""
        return self._round(is_first=True)

    def rounds(self) -> Iterator[tuple[int, Envelope]]:
        """Endless rounds, each message with its round's number; times are shifted so that they never go back."""
        number, by_ns = 0, 0
        while True:
            extent = TimeExtent()
            for entry in self._round(is_first=not number):
                extent.add(entry)
                yield number, shifted(entry, by_ns)
            number, by_ns = number + 1, by_ns + extent.length_ns()
            if not by_ns:
                return

    def _round(self, *, is_first: bool) -> Iterator[Envelope]:
        versions = ComingVersions(self._versions, self._end_ns, is_first_round=is_first)
        seen = Seen()
        latched: dict[str, Envelope] = {}
        damage: dict[Path, str] = {}
        recordings = [self._messages(parts, damage) for parts in self._recordings]
        try:
            for entry in heapq.merge(*recordings, key=lambda each: each.received_t_ns):
                if not seen.is_new(entry):
                    continue  # also in the part before, or in the recording of another shard
                if self._end_ns is not None and entry.received_t_ns > self._end_ns:
                    if entry.received_t_ns > self._end_ns + OUT_OF_ORDER_NS:
                        return
                    continue
                if entry.received_t_ns >= self._start_ns:
                    yield from latched.values()
                    latched.clear()
                    yield from versions.before(entry)
                    yield entry
                elif entry.topic == LATCHED_TOPIC:
                    latched[entry.key] = entry.received_at(self._start_ns)
        finally:  # also when the stretch or the playback ends before the files
            for messages in recordings:
                messages.close()
            self.damage = tuple(damage.values())

    def _messages(self, parts: Sequence[Path], damage: dict[Path, str]) -> Generator[Envelope, None, None]:
        """The messages of one recording. damage: of each part what could not be read, added when it has been played."""
        for file in parts:
            reading = read_recording(file, self.topics)
            try:
                yield from reading
            finally:
                if reading.damage:
                    damage[file] = reading.damage


class TimeExtent:
    """The first and the last time of messages, by receipt or by sample."""

    def __init__(self) -> None:
        self._times_ns: list[int] = []
        """first and last, once there was a message"""
        self._periods_ns: set[int] = set()

    def add(self, entry: Envelope) -> None:
        """Include a message."""
        times = sample_times(entry.message)
        times_ns = [*self._times_ns, entry.received_t_ns, *times[:1].tolist(), *times[-1:].tolist()]
        self._times_ns = [min(times_ns), max(times_ns)]
        if (period_ns := getattr(entry.message, "period_ns", 0)) > 0:
            self._periods_ns.add(period_ns)

    def length_ns(self) -> int:
        """The shift in ns of the next round: a whole number of grid periods. 0: there was no message."""
        if not self._times_ns:
            return 0
        period_ns = math.lcm(*self._periods_ns) if self._periods_ns else LOOP_GAP_NS
        first_ns, last_ns = self._times_ns
        return ((last_ns - first_ns) // period_ns + 1) * period_ns


def shifted(entry: Envelope, by_ns: int) -> Envelope:
    """The same message with all its times later."""
    if not by_ns:
        return entry
    message = entry.message
    times = {f.name: _later(getattr(message, f.name), by_ns) for f in fields(message) if f.name.endswith("t_ns")}
    return Envelope.of(entry.key, replace(message, **times), entry.received_t_ns + by_ns)


def _later(t_ns: Any, by_ns: int) -> Any:
    """A time, or an array of times, shifted. Values that stand for `never` or `until it clears` are not."""
    is_none = isinstance(t_ns, int) and not 0 < t_ns < 2**63 - 1
    return t_ns if is_none else t_ns + by_ns

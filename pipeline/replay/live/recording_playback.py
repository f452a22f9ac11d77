"""What is played: the parts of a recording one after another, each message once, from one time to another."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader

from pipeline.recordings.order import Seen, in_order
from pipeline.recordings.reading import RecordingError, read_recording
from schemas.envelope import Envelope
from schemas.messages import Array, Grid, Message, Prediction, Raw, Score
from schemas.units import NS_PER_S

LOOP_GAP_NS = 10_000_000  # between two rounds where no grid says how far samples are apart
OUT_OF_ORDER_NS = 10 * NS_PER_S
"""a message that was fetched from the bus later is recorded at a later time than some that follow it"""
CARRIED = "twin"
"""the topic whose last message before the start is in force at the start"""


class RecordingPlayback:
    """The messages of a recording, of some topics, in the order they were received."""

    def __init__(
        self, files: Sequence[Path], topics: Collection[str], start_s: float = 0.0, end_s: float = math.inf
    ) -> None:
        """Look at the first message of each file; `start_s` and `end_s` count from the very first.

        Raises:
            RecordingError: a file is no recording, or no file holds a message.
        """
        firsts = {file: entry for file in in_order(files) for entry in islice(read_recording(file), 1)}
        if not firsts:
            raise RecordingError(f"{files[0]}: there is no message in it")
        self.files = list(firsts)
        self._topics = topics
        first = self.first = firsts[self.files[0]]
        self._start_ns = (
            first.received_t_ns + round(start_s * NS_PER_S) if start_s else 0
        )  # all of it, whatever its times
        self._end_ns = first.received_t_ns + round(end_s * NS_PER_S) if math.isfinite(end_s) else None
        self.damage: tuple[str, ...] = ()
        """what could not be read, a line for each file, once the messages are through"""

    def seconds_at(self, t_ns: int) -> float:
        """Seconds since the first message of the recording."""
        return (t_ns - self.first.received_t_ns) / NS_PER_S

    def end_s(self) -> float | None:
        """Where it ends, in seconds since its first message; None where no file says so."""
        recorded = max(map(_last_received_t_ns, self.files))
        if not recorded:
            return None
        return self.seconds_at(min(recorded, self._end_ns) if self._end_ns is not None else recorded)

    def __iter__(self) -> Iterator[Envelope]:
        """One round."""
        seen: dict[tuple[str, str], Seen] = {}
        carried: dict[str, Envelope] = {}
        damage: list[str] = []
        for file in self.files:
            reading = read_recording(file, self._topics)
            try:
                for entry in reading:
                    header = entry.message.header
                    if not seen.setdefault((entry.key, header.producer), Seen()).is_new(header.sequence):
                        continue  # the part before this one had it, too
                    if self._end_ns is not None and entry.received_t_ns > self._end_ns:
                        if entry.received_t_ns > self._end_ns + OUT_OF_ORDER_NS:
                            return
                        continue
                    if entry.received_t_ns >= self._start_ns:
                        yield from carried.values()
                        carried.clear()
                        yield entry
                    elif entry.topic == CARRIED:
                        carried[entry.key] = entry.received_at(self._start_ns)
            finally:  # also when the stretch ends or playback stops before the end of the file
                damage += filter(None, [reading.damage])
                self.damage = tuple(damage)

    def rounds(self) -> Iterator[tuple[int, Envelope]]:
        """Round after round without end, each with its number; times are shifted so that they never run back."""
        number, by_ns = 0, 0
        while True:
            extent = Extent()
            for entry in self:
                extent.note(entry)
                yield number, shifted(entry, by_ns)
            number, by_ns = number + 1, by_ns + extent.length_ns()
            if not by_ns:
                return


class Extent:
    """From when to when messages go: by the times they were received, and by those of their samples."""

    def __init__(self) -> None:
        self._spans: dict[str, tuple[int, int]] = {}
        self._steps_ns: set[int] = set()

    def note(self, entry: Envelope) -> None:
        """Take a message in."""
        self._widen("received", entry.received_t_ns)
        times = sample_times(entry.message)
        if len(times):
            self._widen("sampled", int(times[0]))
            self._widen("sampled", int(times[-1]))
        if (period_ns := getattr(entry.message, "period_ns", 0)) > 0:
            self._steps_ns.add(period_ns)

    def length_ns(self) -> int:
        """By how much a next round has to be later; a whole number of grid steps. 0: there was no message."""
        if not self._spans:
            return 0
        period_ns = math.lcm(*self._steps_ns) if self._steps_ns else LOOP_GAP_NS
        longest_ns = max(last - first for first, last in self._spans.values())
        return (longest_ns // period_ns + 1) * period_ns

    def _widen(self, span: str, t_ns: int) -> None:
        first, last = self._spans.get(span, (t_ns, t_ns))
        self._spans[span] = (min(first, t_ns), max(last, t_ns))


def sample_times(message: Message) -> Array:
    """(samples,) ns since the epoch; of a message without samples none."""
    if isinstance(message, Raw):
        return message.host_receive_t_ns
    return message.t_ns if isinstance(message, Grid | Prediction | Score) else np.zeros(0, np.int64)


def shifted(entry: Envelope, by_ns: int) -> Envelope:
    """The same, later."""
    if not by_ns:
        return entry
    message = entry.message
    times = {f.name: _later(getattr(message, f.name), by_ns) for f in fields(message) if f.name.endswith("t_ns")}
    return Envelope.of(entry.key, replace(message, **times), entry.received_t_ns + by_ns)


def _later(t_ns: Any, by_ns: int) -> Any:
    """A time of a message, or an array of them. What is no time of an alarm (never, until it clears) stays so."""
    is_none = isinstance(t_ns, int) and not 0 < t_ns < 2**63 - 1
    return t_ns if is_none else t_ns + by_ns


def _last_received_t_ns(file: Path) -> int:
    """When the last message was received, as the file's index says; 0 where it has none."""
    with suppress(McapError, OSError, ValueError), file.open("rb") as opened:
        summary = make_reader(opened).get_summary()
        if summary and summary.statistics:
            return summary.statistics.message_end_time
    return 0

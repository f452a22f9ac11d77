"""The samples and the overview of a tray in a range of time, from the recordings of a run that still grows.

Only the chunks of the range are opened, one at a time: a day is read in seconds, whatever the size of the recordings.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TypeAlias

from mcap.opcode import Opcode

from fantwin.pipeline.recordings.indexed import IndexedRecording
from fantwin.pipeline.recordings.parts import part_files
from fantwin.pipeline.recordings.reading import read_metadata
from fantwin.pipeline.recordings.records import (
    ACTIVE_SUFFIX,
    CORRUPT_DATA_ERRORS,
    MESSAGE,
    RECORD,
    RecordingError,
    chunk_at,
    whole_number,
)
from fantwin.schemas.codec import CodecError, decode_together
from fantwin.schemas.messages import Overview, Raw, Score
from fantwin.schemas.units import NS_PER_S

LATEST_NS = 60 * NS_PER_S
"""longest time between samples and the receipt of their message"""
Recorded: TypeAlias = Score | Raw | Overview
_KINDS: dict[str, type[Recorded]] = {"score": Score, "raw": Raw, "overview": Overview}
_WITHOUT_SCORES = ("raw", "overview")
"""the topics that together tell of a fan what scores would, these second by second where it was judged"""
_ENDLESS_NS = (1 << 63) - 1


def _payloads(data: bytes, channels: Mapping[int, str], begin_ns: int) -> dict[str, list[bytes]]:
    """Messages of these channels in a chunk whose newest sample is not older, by topic; nothing else is looked at.

    channels: topics by number.
    """
    found: dict[str, list[bytes]] = {}
    at, end = 0, len(data)
    while at < end:
        opcode, length = RECORD.unpack_from(data, at)
        at += RECORD.size
        if opcode == Opcode.MESSAGE:
            channel, _, _, newest_t_ns = MESSAGE.unpack_from(data, at)
            if channel in channels and newest_t_ns >= begin_ns:
                found.setdefault(channels[channel], []).append(data[at + MESSAGE.size : at + length])
        at += length
    return found


class RecordedRange:
    """The recordings of a run; used in several threads."""

    def __init__(self, recordings: Sequence[Path]) -> None:
        """recordings: the first part of each, NAME.mcap."""
        self._recordings = recordings
        self._spans: dict[tuple[Path, int], tuple[int, int]] = {}
        """times of receipt of the first and last message of each finished part, by path and size"""

    def blocks(
        self, tray: str, begin_ns: int, end_ns: int, columns: Collection[str], unread: set[str]
    ) -> Iterator[Recorded]:
        """The scores of a tray, and where a part has none, its raw samples and its overview, in the order they were
        recorded, of a chunk the samples first.

        The first and last messages may reach beyond the range. unread: gets the names of files that cannot be read in
        full.
        """
        for path in self._parts(begin_ns, end_ns + LATEST_NS):
            try:
                indexed = IndexedRecording(path, tuple(_KINDS), tray)
            except (OSError, RecordingError):
                unread.add(path.name)
                continue
            topics = {topic for _, topic in indexed.channels.values()}
            wanted = ("score",) if "score" in topics else _WITHOUT_SCORES
            channels = {number: topic for number, (_, topic) in indexed.channels.items() if topic in wanted}
            for chunk in indexed.chunks if channels else ():
                if chunk.message_end_time < begin_ns or chunk.message_start_time > end_ns + LATEST_NS:
                    continue
                try:
                    with indexed.file.open("rb") as file:
                        found = _payloads(chunk_at(file, chunk), channels, begin_ns)
                    for topic in filter(found.get, wanted):
                        yield from decode_together(_KINDS[topic], found[topic], columns)
                except (OSError, CodecError, *CORRUPT_DATA_ERRORS):
                    unread.add(path.name)

    def _parts(self, begin_ns: int, end_ns: int) -> list[Path]:
        """Those that may have messages received in the range, the oldest first."""
        found: list[Path] = []
        for recording in self._recordings:
            with suppress(OSError):
                for _, path in sorted(part_files(recording)):
                    with suppress(OSError, RecordingError):
                        first_ns, last_ns = self._span(path)
                        found += [path] if first_ns <= end_ns and last_ns >= begin_ns else []
        return found

    def _span(self, path: Path) -> tuple[int, int]:
        if path.name.endswith(ACTIVE_SUFFIX):
            return whole_number(read_metadata(path).metadata.get("started_t_ns", "")) or 0, _ENDLESS_NS
        key = path, path.stat().st_size
        if key not in self._spans:
            indexed = IndexedRecording(path)
            self._spans[key] = indexed.first_ns, indexed.last_ns
        return self._spans[key]

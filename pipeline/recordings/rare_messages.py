"""The messages of a topic that a recording has few of, without reading the rest."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from fantwin.pipeline.recordings.reading import Reading, read_recording
from fantwin.pipeline.recordings.records import CORRUPT_DATA_ERRORS, chunk_at, indexed_reader
from fantwin.schemas.codec import CodecError
from fantwin.schemas.envelope import Envelope


def rare_messages(path: Path, topic: str) -> list[Envelope]:
    """The messages of a topic in the order they were recorded; those that cannot be decoded are left out.

    They are found by the file's index. If it has none, as after a crash, or something is damaged, the whole file is
    read.

    Raises:
        RecordingError: the file cannot be read or is not a recording.
    """
    try:
        return list(_by_index(path, topic))
    except (OSError, CodecError, *CORRUPT_DATA_ERRORS):
        return list(read_recording(path, (topic,)))


def last_messages(path: Path, topic: str) -> dict[str, bytes]:
    """The last message of a topic on each key, as bytes. It is found by the file's index; none without one.

    Raises:
        OSError: the file cannot be read.
    """
    reading = Reading(path, (topic,), None)
    channels: dict[int, tuple[str, str]] = {}
    found: dict[str, bytes] = {}
    with suppress(*CORRUPT_DATA_ERRORS), path.open("rb") as file:
        summary = indexed_reader(file).get_summary()
        for channel in summary.channels.values() if summary else ():
            reading.add_channel(channel, channels)
        for chunk in reversed(summary.chunk_indexes) if summary else ():
            missing = {number for number, (key, _) in channels.items() if key not in found}
            if not missing.isdisjoint(chunk.message_index_offsets):
                envelopes = reading.envelopes_in(chunk_at(file, chunk.chunk_start_offset, chunk.chunk_length), channels)
                found = {envelope.key: envelope.payload for envelope in envelopes} | found
    return found


def last_message_ns(path: Path) -> int:
    """When the last message of a finished recording was received; 0 if its index does not say it."""
    try:
        with path.open("rb") as file:
            summary = indexed_reader(file).get_summary()
    except (OSError, LookupError, *CORRUPT_DATA_ERRORS):
        return 0
    return summary.statistics.message_end_time if summary and summary.statistics else 0


def _by_index(path: Path, topic: str) -> Iterator[Envelope]:
    reading = Reading(path, (topic,), None)
    channels: dict[int, tuple[str, str]] = {}
    with path.open("rb") as file:
        summary = indexed_reader(file).get_summary()
        if summary is None or not summary.chunk_indexes:
            raise ValueError("no index")
        for channel in summary.channels.values():
            reading.add_channel(channel, channels)
        for chunk in summary.chunk_indexes:
            if not channels.keys().isdisjoint(chunk.message_index_offsets):
                data = chunk_at(file, chunk.chunk_start_offset, chunk.chunk_length)
                for envelope in reading.envelopes_in(data, channels):
                    _ = envelope.message
                    yield envelope

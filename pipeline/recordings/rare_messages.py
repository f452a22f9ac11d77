"""The messages of a topic that a recording has few of, without reading the rest."""

from __future__ import annotations

from pathlib import Path

from fantwin.pipeline.recordings.indexed import IndexedRecording
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.recordings.records import CORRUPT_DATA_ERRORS, may_hold
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
        if indexed := IndexedRecording.of(path, (topic,)):
            return [envelope for envelope in indexed if envelope.message]
    except (OSError, CodecError, *CORRUPT_DATA_ERRORS):
        pass  # reading all of it reports what is wrong
    return list(read_recording(path, (topic,)))


def last_messages(path: Path, topic: str) -> dict[str, bytes]:
    """The last message of a topic on each key, as bytes. Found as in `rare_messages`.

    Raises:
        RecordingError: the file cannot be read or is not a recording.
    """
    found: dict[str, bytes] = {}
    try:
        if indexed := IndexedRecording.of(path, (topic,)):
            for chunk in reversed(indexed.chunks):
                missing = {number for number, (key, _) in indexed.channels.items() if key not in found}
                if missing and may_hold(chunk, missing):
                    found = {envelope.key: envelope.payload for envelope in indexed.envelopes(chunk)} | found
            return found
    except (OSError, *CORRUPT_DATA_ERRORS):
        pass
    return {envelope.key: envelope.payload for envelope in rare_messages(path, topic)}


def last_message_ns(path: Path) -> int:
    """When the last message of a finished recording was received; 0 if its index does not say it.

    Raises:
        RecordingError: it is of an unknown format.
    """
    try:
        indexed = IndexedRecording.of(path)
    except OSError:
        return 0
    return indexed.last_ns if indexed else 0

"""The contents of a recording: from its index and ledger, or, without these, by reading all of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

from fantwin.pipeline.recordings.disk import is_being_written
from fantwin.pipeline.recordings.indexed import IndexedRecording
from fantwin.pipeline.recordings.reading import METADATA_NAME
from fantwin.pipeline.recordings.records import CORRUPT_DATA_ERRORS, RecordReader, check_format, indexed_reader
from fantwin.pipeline.recordings.run_recordings import RECORDING_KEY
from fantwin.pipeline.recordings.scan import NO_LOSS, TRUNCATED, Contents, scan
from fantwin.pipeline.recordings.sequence_ledger import (
    BEFORE_NAME,
    ENDED,
    LEDGER_NAME,
    MessageCounts,
    StreamCounts,
    before_from_metadata,
    counts_from_metadata,
    recovered_from_metadata,
    sum_by_key,
)
from fantwin.schemas.topics import HEALTH, known_topic

TWIN = "twin"


def contents_of(path: Path) -> Contents:
    """What is in a file. If it has an index and a ledger, only these are read: damage elsewhere does not show.

    Raises:
        RecordingError: it cannot be read, or is not an MCAP file.
    """
    check_format(path)
    try:
        with path.open("rb") as file:
            found = _by_index(path, file)
    except (OSError, *CORRUPT_DATA_ERRORS, LookupError):
        found = None
    if found:
        return found
    is_written = is_being_written(path)
    return replace(scan(path), is_being_written=is_written)


def continuity(parts: Sequence[Contents]) -> list[str]:
    """Where parts of a recording do not continue one another as they should, one line each; parts in their order of
    time, also of several recordings."""
    by_name = {part.path.name: part for part in parts}
    first = {part.metadata.get(RECORDING_KEY): part for part in reversed(parts)}
    lines = []
    for part in parts:
        name = part.metadata.get("continues", "")
        earlier = by_name.get(name)
        is_first = part is first[part.metadata.get(RECORDING_KEY)]
        if name and earlier is None and not is_first:  # those before the first were not asked for, or deleted
            lines.append(f"{part.path.name} continues {name}, which is not among these files")
        ends_at = earlier.next if earlier else {}
        for stream, due in part.before.items():
            ends = ends_at.get(stream, due)
            if ends != due:
                lines.append(
                    f"{part.path.name} starts at message {due} of {' '.join(stream)}, but {name} ends before {ends}"
                )
    return lines


def losses_of(found: Contents) -> list[str]:
    """What is missing, or may be, one line each; empty if nothing is."""
    missing = [
        f"{key}: {messages_as_text(counts.missing)} of {producer} missing in between"
        for (key, producer), counts in found.streams.items()
        if counts.missing
    ]
    return [*losses_outside_counts(found), *missing]


def losses_outside_counts(found: Contents) -> list[str]:
    """The losses that the counts of its streams do not show."""
    lines = [line for line in found.damage if line not in NO_LOSS | {TRUNCATED}]
    if not found.is_ended:
        flush_s = found.metadata.get("flush_interval_s")
        may = f"messages received in the last {flush_s} s" if flush_s else "messages of the unfinished chunk"
        lines.insert(0, f"{TRUNCATED}: {may} may be missing")
        lines += [
            f"{key}: {messages_as_text(count)} of {producer} published after the last one here, according to its health"
            for (key, producer), count in found.counts.ledger.unrecorded().items()
        ]
    return [*found.recovered, *lines]


def messages_as_text(count: int) -> str:
    """The number with its noun."""
    return "1 message" if count == 1 else f"{count} messages"


def _by_index(path: Path, file: BinaryIO) -> Contents | None:
    reader = indexed_reader(file)
    summary = reader.get_summary()
    if summary is None or summary.statistics is None:
        return None
    records = {record.name: record.metadata for record in reader.iter_metadata()}
    if LEDGER_NAME not in records:
        return None
    statistics, ledger = summary.statistics, records[LEDGER_NAME]
    streams = counts_from_metadata(ledger)
    held = {channel.topic: statistics.channel_message_counts.get(id, 0) for id, channel in summary.channels.items()}
    if any(counts.messages > held.get(key, 0) for key, counts in sum_by_key(streams.items()).items()):
        return None  # somebody has removed messages: reading all of it tells which
    counts = MessageCounts()
    for envelope in IndexedRecording(path, (HEALTH, TWIN)):
        counts.add(envelope.key, envelope.received_t_ns, envelope.payload)
    counts.ledger.counts = streams
    counts.others = {topic: StreamCounts(messages=count) for topic, count in held.items() if known_topic(topic) is None}
    found = Contents(
        path,
        RecordReader(path),
        messages=statistics.message_count,
        first_ns=statistics.message_start_time if statistics.message_count else None,
        last_ns=statistics.message_end_time if statistics.message_count else None,
        counts=counts,
        recorded=streams,
        before=before_from_metadata(records.get(BEFORE_NAME, {})),
        has_ended=ENDED in ledger,
        recovered=recovered_from_metadata(ledger),
        metadata=records.get(METADATA_NAME, {}),
        attachments=[index.name for index in summary.attachment_indexes],
        is_ended=True,
        has_index=True,
    )
    found.reader.size = path.stat().st_size
    return found

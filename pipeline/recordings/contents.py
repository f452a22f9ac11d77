"""The contents of a recording: from its index and ledger, or, without these, by reading all of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

from fantwin.pipeline.recordings.disk import is_being_written
from fantwin.pipeline.recordings.indexed import IndexedRecording
from fantwin.pipeline.recordings.reading import METADATA_NAME
from fantwin.pipeline.recordings.records import CORRUPT_DATA_ERRORS, check_format, indexed_reader
from fantwin.pipeline.recordings.run_recordings import RECORDING_KEY
from fantwin.pipeline.recordings.scan import Scan, scan
from fantwin.pipeline.recordings.sequence_ledger import (
    BEFORE_NAME,
    ENDED,
    LEDGER_NAME,
    MessageCounts,
    StreamCounts,
    before_from_metadata,
    counts_from_metadata,
    next_sequences,
    recovered_from_metadata,
    sum_by_key,
)
from fantwin.schemas.health import Health
from fantwin.schemas.messages import ModelCard
from fantwin.schemas.streams import StreamId
from fantwin.schemas.topics import HEALTH, known_topic

TWIN = "twin"
TRUNCATED = "it is truncated, as after a crash"
NOT_A_RECORD = "bytes that belong to no intact record"
NO_INDEX = "it has no index"
STILL_WRITTEN = "it is still being written"
NO_LOSS = frozenset((NO_INDEX, STILL_WRITTEN))
"""the damage lines of a file that has lost nothing"""


@dataclass(frozen=True)
class Contents:
    """The contents of one file. Times are times of receipt; None if it has no message."""

    path: Path
    size_bytes: int
    metadata: Mapping[str, str]
    attachments: tuple[str, ...]
    streams: Mapping[StreamId, StreamCounts]
    others: Mapping[str, int]
    """messages on channels that are not fantwin's, by topic"""
    before: Mapping[StreamId, int]
    """the next expected sequence number of each stream at the start of the file"""
    first_ns: int | None
    last_ns: int | None
    messages: int
    sessions: tuple[Health, ...]
    """the last health of each session, in the order of the file"""
    cards: Mapping[str, ModelCard]
    has_ended: bool
    """the recorder was stopped in order with this file"""
    recovered: tuple[str, ...] = ()
    """what an earlier repair reported as lost, one line each"""
    damage: tuple[str, ...] = ()
    """what is wrong with the file, one line each"""

    @property
    def healths(self) -> list[Health]:
        """The last health of each stage and tray."""
        return list({(health.stage, health.instance): health for health in self.sessions}.values())

    @property
    def next(self) -> dict[StreamId, int]:
        """The next expected sequence number of each stream after this file."""
        return next_sequences(self.before, self.streams)


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
    contents = _by_scan(scan(path))
    return replace(contents, damage=(STILL_WRITTEN,)) if is_written else contents


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


def damage_of(found: Scan) -> tuple[str, ...]:
    """What is wrong with a file that was scanned, one line each."""
    lines = (
        (not found.is_ended, TRUNCATED),
        (found.is_ended and not found.has_index, NO_INDEX),
        (found.discarded_bytes, f"{NOT_A_RECORD}: {found.discarded_bytes}"),
        *((count, f"damaged {kind}: {count}") for kind, count in found.damaged.items()),
        (found.lacking and not found.is_damaged, f"messages that its ledger counts and that are gone: {found.lacking}"),
        (found.nameless, f"messages whose channel is damaged: {found.nameless}"),
        (found.counts.undecodable, f"messages that do not have the type of their channel: {found.counts.undecodable}"),
    )
    return tuple(line for is_so, line in lines if is_so)


def losses_of(found: Scan) -> list[str]:
    """What is missing, or may be, one line each; empty if nothing is."""
    missing = [
        f"{key}: {messages_as_text(counts.missing)} of {producer} missing in between"
        for (key, producer), counts in found.streams.items()
        if counts.missing
    ]
    return [*losses_outside_counts(found), *missing]


def losses_outside_counts(found: Scan) -> list[str]:
    """The losses that the counts of its streams do not show."""
    lines = [line for line in damage_of(found) if line not in NO_LOSS | {TRUNCATED}]
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


def _by_scan(found: Scan) -> Contents:
    return Contents(
        path=found.path,
        size_bytes=found.reader.size,
        metadata=found.metadata,
        attachments=tuple(found.attachments),
        streams=found.streams,
        others={topic: counts.messages for topic, counts in found.counts.others.items()},
        before=found.before,
        first_ns=found.first_ns,
        last_ns=found.last_ns,
        messages=found.messages,
        sessions=tuple(found.counts.sessions.values()),
        cards=found.counts.cards,
        has_ended=found.has_ended,
        recovered=found.recovered,
        damage=damage_of(found),
    )


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
    last = MessageCounts()
    for envelope in IndexedRecording(path, (HEALTH, TWIN)):
        last.add(envelope.key, envelope.received_t_ns, envelope.payload)
    return Contents(
        path=path,
        size_bytes=path.stat().st_size,
        metadata=records.get(METADATA_NAME, {}),
        attachments=tuple(index.name for index in summary.attachment_indexes),
        streams=streams,
        others={topic: count for topic, count in held.items() if known_topic(topic) is None},
        before=before_from_metadata(records.get(BEFORE_NAME, {})),
        first_ns=statistics.message_start_time if statistics.message_count else None,
        last_ns=statistics.message_end_time if statistics.message_count else None,
        messages=statistics.message_count,
        sessions=tuple(last.sessions.values()),
        cards=last.cards,
        has_ended=ENDED in ledger,
        recovered=recovered_from_metadata(ledger),
    )

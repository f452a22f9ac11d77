"""What is in a recording: by its index and its ledger where it has them, and else by going through all of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.summary import Summary

from pipeline.recordings.disk import unwritten
from pipeline.recordings.reading import METADATA_NAME
from pipeline.recordings.records import CORRUPT_DATA_ERRORS, MESSAGE, RECORD, chunk_data, parse, records_in
from pipeline.recordings.scan import Scan, scan
from pipeline.recordings.sequence_ledger import (
    BEFORE_NAME,
    ENDED,
    LEDGER_NAME,
    StreamCounts,
    StreamId,
    accounts_of,
    before_of,
    next_of,
    recovered_of,
)
from schemas.codec import CodecError, decode
from schemas.messages import Health, Message, ModelCard
from schemas.topics import topic_of

BREAKS_OFF = "it breaks off, as after a crash"
NOTHING_WHOLE = "bytes that are nothing whole"
NO_INDEX = "it has no index"
STILL_WRITTEN = "it is still being written"
NO_LOSS = frozenset((NO_INDEX, STILL_WRITTEN))
"""what is said of a file that has lost nothing"""


@dataclass(frozen=True)
class Contents:
    """Of one file. Times are those of receipt; None where there is no message."""

    path: Path
    size_bytes: int
    metadata: Mapping[str, str]
    attachments: tuple[str, ...]
    accounts: Mapping[StreamId, StreamCounts]
    others: Mapping[str, int]
    """messages on channels that are none of ours, by topic"""
    before: Mapping[StreamId, int]
    first_ns: int | None
    last_ns: int | None
    messages: int
    healths: Mapping[str, Health]
    """the last of each key"""
    cards: Mapping[str, ModelCard]
    has_ended: bool
    """its recorder ended in order with this file"""
    recovered: tuple[str, ...] = ()
    """what was lost, or may have been, when it was mended, one line each"""
    damage: tuple[str, ...] = ()
    """what is wrong with the file, one line each"""

    @property
    def next(self) -> dict[StreamId, int]:
        """With which number each producer should go on after this file."""
        return next_of(self.before, self.accounts)


def contents_of(path: Path) -> Contents:
    """What is in a file. Where it has an index and a ledger, damage in the middle of it does not show.

    Raises:
        RecordingError: it cannot be read, or is no MCAP file.
    """
    try:
        with path.open("rb") as file:
            found = _by_index(path, file)
    except (OSError, *CORRUPT_DATA_ERRORS, LookupError):
        found = None
    if found:
        return found
    is_written = _is_being_written(path)
    contents = _by_scan(scan(path))
    return replace(contents, damage=(STILL_WRITTEN,)) if is_written else contents


def _is_being_written(path: Path) -> bool:
    try:
        with unwritten(path):
            return False
    except BlockingIOError:
        return True
    except OSError:  # which reading it will tell
        return False


def continuity(parts: Sequence[Contents]) -> list[str]:
    """Where parts do not go on from one another as they should, one line each; parts in their order of time."""
    by_name = {part.path.name: part for part in parts}
    lines = []
    for part in parts:
        name = part.metadata.get("continues", "")
        earlier = by_name.get(name)
        if name and earlier is None and part is not parts[0]:  # those before the first were not asked for, or deleted
            lines.append(f"{part.path.name} continues {name}, which is not among these files")
        ends_at = earlier.next if earlier else {}
        for line, due in part.before.items():
            ends = ends_at.get(line, due)
            if ends != due:
                lines.append(f"{part.path.name} goes on at {due} of {' '.join(line)}, but {name} ends before {ends}")
    return lines


def damage_of(found: Scan) -> tuple[str, ...]:
    """What is wrong with a file that was gone through, one line each."""
    lines = (
        (not found.is_ended, BREAKS_OFF),
        (found.is_ended and not found.has_index, NO_INDEX),
        (found.thrown_away_bytes, f"{NOTHING_WHOLE}: {found.thrown_away_bytes}"),
        (found.damaged_chunks, f"damaged chunks: {found.damaged_chunks}"),
        (found.damaged_records, f"damaged records: {found.damaged_records}"),
        (found.damaged_attachments, f"damaged attachments: {found.damaged_attachments}"),
        (found.nameless, f"messages of channels without a name: {found.nameless}"),
        (found.census.undecodable, f"messages that are not what their channel says: {found.census.undecodable}"),
    )
    return tuple(line for is_so, line in lines if is_so)


def losses(found: Scan) -> list[str]:
    """What is missing, or may be, one line each; nothing where nothing is."""
    missing = [
        f"{key}: {messages_as_text(account.missing)} of {producer} missing in between"
        for (key, producer), account in found.accounts.items()
        if account.missing
    ]
    return [*unaccounted(found), *missing]


def unaccounted(found: Scan) -> list[str]:
    """Those of the losses that do not stand in its accounts."""
    lines = [line for line in damage_of(found) if line not in NO_LOSS | {BREAKS_OFF}]
    if not found.is_ended:
        flush_s = found.metadata.get("flush_interval_s")
        may = f"what came in the last {flush_s} s" if flush_s else "what was in the unfinished chunk"
        lines.insert(0, f"{BREAKS_OFF}: {may} may be missing")
    for (key, producer), count in found.census.ledger.unrecorded().items() if not found.is_ended else ():
        lines.append(
            f"{key}: {messages_as_text(count)} of {producer} published, by its health, after the last one here"
        )
    return [*found.recovered, *lines]


def messages_as_text(count: int) -> str:
    """The number with its noun."""
    return "1 message" if count == 1 else f"{count} messages"


def _by_scan(found: Scan) -> Contents:
    return Contents(
        path=found.path,
        size_bytes=found.walk.size,
        metadata=found.metadata,
        attachments=tuple(found.attachments),
        accounts=found.accounts,
        others={topic: account.messages for topic, account in found.census.others.items()},
        before=found.before,
        first_ns=found.index.first_ns,
        last_ns=found.index.last_ns if found.messages else None,
        messages=found.messages,
        healths=found.census.healths,
        cards=found.census.cards,
        has_ended=found.has_ended,
        recovered=found.recovered,
        damage=damage_of(found),
    )


def _by_index(path: Path, file: BinaryIO) -> Contents | None:
    reader = make_reader(file)
    summary = reader.get_summary()
    if summary is None or summary.statistics is None:
        return None
    records = {record.name: record.metadata for record in reader.iter_metadata()}
    if LEDGER_NAME not in records:
        return None
    statistics = summary.statistics
    accounts = accounts_of(records[LEDGER_NAME])
    news = [_last_message(file, summary, number) for number in _channels_of_news(summary)]
    return Contents(
        path=path,
        size_bytes=path.stat().st_size,
        metadata=records.get(METADATA_NAME, {}),
        attachments=tuple(index.name for index in summary.attachment_indexes),
        accounts=accounts,
        others={
            channel.topic: statistics.channel_message_counts.get(number, 0)
            for number, channel in summary.channels.items()
            if _kind(channel.topic) is None
        },
        before=before_of(records.get(BEFORE_NAME, {})),
        first_ns=statistics.message_start_time if statistics.message_count else None,
        last_ns=statistics.message_end_time if statistics.message_count else None,
        messages=statistics.message_count,
        healths={key: message for key, message in news if isinstance(message, Health)},
        cards={key: message for key, message in news if isinstance(message, ModelCard)},
        has_ended=ENDED in records[LEDGER_NAME],
        recovered=recovered_of(records[LEDGER_NAME]),
    )


def _channels_of_news(summary: Summary) -> list[int]:
    """Those of which the last message says how things stand."""
    return [
        number
        for number, channel in summary.channels.items()
        if _kind(channel.topic) in (Health, ModelCard)
        and any(number in c.message_index_offsets for c in summary.chunk_indexes)
    ]


def _last_message(file: BinaryIO, summary: Summary, number: int) -> tuple[str, Message | None]:
    key = summary.channels[number].topic
    chunk = next(chunk for chunk in reversed(summary.chunk_indexes) if number in chunk.message_index_offsets)
    file.seek(chunk.chunk_start_offset + RECORD.size)
    data = chunk_data(parse(Chunk, file.read(chunk.chunk_length - RECORD.size)))
    payloads = [
        data[start + MESSAGE.size : end]
        for _, opcode, start, end in records_in(data)
        if opcode == Opcode.MESSAGE and MESSAGE.unpack_from(data, start)[0] == number
    ]
    kind = _kind(key)
    assert kind is not None
    try:
        return key, decode(kind, payloads[-1])
    except CodecError:
        return key, None


def _kind(topic: str) -> type[Message] | None:
    try:
        return topic_of(topic).message
    except KeyError:
        return None

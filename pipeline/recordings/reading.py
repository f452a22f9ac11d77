"""Reading recordings: their messages, as bytes or decoded, and their metadata and attachments.

A channel is a key of the bus; its messages are the protobuf bytes that were sent. A truncated or damaged file is read
as far as possible. See docs/reference/recordings.md.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata

from fantwin.pipeline.recordings.disk import is_being_written
from fantwin.pipeline.recordings.records import (
    CORRUPT_DATA_ERRORS,
    MESSAGE,
    METADATA_NAME,
    RECORD,
    RecordingError,
    RecordReader,
    check_format,
    chunk_data,
    parse,
    summary_of,
)
from fantwin.schemas.codec import CodecError
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.messages import StatedTacho
from fantwin.schemas.tacho import INSTANTANEOUS, Tacho, tachos_from_json
from fantwin.schemas.topics import HEALTH_CHUNK, known_topic

__all__ = ["METADATA_NAME", "Reading", "RecordingError", "RecordingMetadata", "read_metadata", "read_recording"]

TACHO_KEY, NAMES_KEY = "tacho", "fan_names"
"""with the name of a tray: its tachos, as schemas.tacho writes them"""
LEFT_OUT_KEY = "left_out"
"""topics that were left out on purpose, separated by commas"""


@dataclass
class Reading:
    """The messages of a file in the order they were recorded; one chunk at a time is in memory.

    What cannot be read is skipped and counted. The counts are those up to the newest message of the iteration.
    """

    path: Path
    topics: Collection[str] | None
    tray: str | None
    truncated: bool = field(default=False, init=False)
    """the file has no end: its recorder was killed, or lost power, or still writes it"""
    being_written: bool = field(default=False, init=False)
    """a recorder was writing the file when the iteration began"""
    damaged_chunks: int = field(default=0, init=False)
    undecodable: int = field(default=0, init=False)
    """messages that do not have the type of their channel"""
    without_channel: int = field(default=0, init=False)
    """messages of channels that only damaged chunks declared"""
    _declared: set[int] = field(default_factory=set, init=False)
    """ids of all channels declared so far"""

    @property
    def damage(self) -> str:
        """One line about what could not be read; empty if nothing is missing."""
        found = (
            ("it is still being written; read up to its last flush", self.truncated and self.being_written),
            ("it is truncated, as after a crash; read up to that point", self.truncated and not self.being_written),
            (f"damaged chunks left out: {self.damaged_chunks}", self.damaged_chunks),
            (f"messages left out that cannot be decoded: {self.undecodable}", self.undecodable),
            (f"messages left out whose channel is damaged: {self.without_channel}", self.without_channel),
        )
        text = "; ".join(line for line, is_so in found if is_so)
        return f"{self.path}: {text}" if text else ""

    def __iter__(self) -> Iterator[Envelope]:
        """The messages, decoded; those that cannot be decoded are skipped."""
        self.undecodable = 0
        for envelope in self.undecoded():
            try:
                _ = envelope.message
            except CodecError:
                self.undecodable += 1
            else:
                yield envelope

    def undecoded(self) -> Iterator[Envelope]:
        """The messages as bytes; `Envelope.message` decodes one, and may raise CodecError."""
        self.truncated, self.damaged_chunks, self.without_channel = False, 0, 0
        self.being_written = is_being_written(self.path)
        channels: dict[int, tuple[str, str]] = {}
        self._declared.clear()
        has_summary = False
        corrupt = 0
        reader = RecordReader(self.path)
        for record in reader:
            self.damaged_chunks = corrupt + len(reader.damaged_ranges)
            if self.damaged_chunks and not has_summary:
                has_summary = True
                for channel in summary_of(self.path).channels.values():
                    self.add_channel(channel, channels)
            try:
                if isinstance(record.parsed, Chunk):
                    envelopes = self.envelopes_in(chunk_data(record.parsed), channels)
                elif record.opcode in (Opcode.CHANNEL, Opcode.MESSAGE):
                    envelopes = self.envelopes_in(record.data, channels)
                else:
                    continue
            except CORRUPT_DATA_ERRORS:
                corrupt += 1
            else:
                yield from envelopes
        self.truncated = not reader.is_complete
        self.damaged_chunks = corrupt + len(reader.damaged_ranges)

    def envelopes_in(self, data: bytes, channels: dict[int, tuple[str, str]]) -> list[Envelope]:
        """The wanted messages in the records of a chunk; their channels are added to `channels`."""
        envelopes = []
        at, end = 0, len(data)
        while at < end:
            opcode, length = RECORD.unpack_from(data, at)
            at += RECORD.size
            if opcode == Opcode.MESSAGE:
                channel, _, received_t_ns, newest_t_ns = MESSAGE.unpack_from(data, at)
                if channel in channels:
                    payload = data[at + MESSAGE.size : at + length]
                    envelopes.append(Envelope(*channels[channel], payload, received_t_ns, None, newest_t_ns))
                elif channel not in self._declared:
                    self.without_channel += 1
            elif opcode == Opcode.CHANNEL:
                self.add_channel(parse(Channel, data[at : at + length]), channels)
            at += length
        return envelopes

    def add_channel(self, channel: Channel, channels: dict[int, tuple[str, str]]) -> None:
        """Add a channel to `channels`, by its id, if its messages are wanted."""
        key = channel.topic
        self._declared.add(channel.id)
        topic = known_topic(key)  # None: not a channel of fantwin
        is_wanted = topic is not None and (self.topics is None or topic.name in self.topics)
        if topic and is_wanted and (self.tray is None or key.split("/")[2] in (self.tray, HEALTH_CHUNK)):
            channels[channel.id] = (key, topic.name)


def read_recording(path: Path, topics: Collection[str] | None = None, tray: str | None = None) -> Reading:
    """The messages of a recording, to iterate over: of all topics and trays, or only of those named. The health of
    stages belongs to no tray, and is read with any.

    Raises:
        RecordingError: the file cannot be opened, is not a recording, or is of an unknown format.
    """
    check_format(path)
    return Reading(path, None if topics is None else set(topics), tray)


@dataclass(frozen=True)
class RecordingMetadata:
    """The metadata and attachments of a recording."""

    metadata: Mapping[str, str]
    attachments: Mapping[str, bytes]
    is_damaged: bool = False
    """something before the first message cannot be read: what is not here may have been there"""

    @property
    def trays(self) -> tuple[str, ...]:
        """The trays that it names."""
        return tuple(filter(None, self.metadata.get("trays", "").split(",")))

    def speed_unit(self, tray: str) -> str:
        """The unit in which people see a tray's speeds: the tray's, the recording's, or rad/s."""
        return self.metadata.get(f"speed_unit.{tray}") or self.metadata.get("speed_unit", "rad/s")

    def names(self, tray: str | None = None) -> FanNames:
        """Names of the fans of a tray; without one of the only tray."""
        trays = self.trays if tray is None else (tray,)
        return FanNames.from_json(self.metadata.get(f"{NAMES_KEY}.{trays[0]}", "")) if len(trays) == 1 else NO_NAMES

    @property
    def left_out(self) -> tuple[str, ...]:
        """The topics that the recorder left out on purpose (`recorder.topics`), in the order of their table."""
        return left_out_of(self.metadata)

    def tacho(self, tray: str, stated: Sequence[StatedTacho] = ()) -> tuple[Tacho, ...]:
        """How the speeds of a tray were measured; instantaneous where the recording does not say.

        stated: by its raw messages; counts where the metadata do not say it.

        Raises:
            RecordingError: what it says cannot be read.
        """
        text = self.metadata.get(f"{TACHO_KEY}.{tray}")
        try:
            return tachos_from_json(text) if text else tuple(each.tacho for each in stated) or INSTANTANEOUS
        except ValueError as error:
            where = f"metadata are damaged: {TACHO_KEY}.{tray} is" if text else "raw messages state a tacho that is"
            raise RecordingError(f"the {where} not one of this version") from error


def left_out_of(metadata: Mapping[str, str]) -> tuple[str, ...]:
    """The topics that a recording's metadata name as left out."""
    return tuple(filter(None, metadata.get(LEFT_OUT_KEY, "").split(",")))


def read_metadata(path: Path) -> RecordingMetadata:
    """The metadata and attachments of a recording.

    Raises:
        RecordingError: the file cannot be opened or is not a recording.
    """
    metadata: dict[str, str] = {}
    attachments: dict[str, bytes] = {}
    is_damaged = False
    reader = RecordReader(path)
    for record in reader:
        if isinstance(record.parsed, Metadata) and record.parsed.name == METADATA_NAME:
            metadata.update(record.parsed.metadata)
        elif isinstance(record.parsed, Attachment):
            attachments[record.parsed.name] = record.parsed.data
        elif record.opcode == Opcode.CHUNK:
            break
        is_damaged |= record.parsed is None and record.opcode in (Opcode.METADATA, Opcode.ATTACHMENT)
    return RecordingMetadata(metadata, attachments, is_damaged or bool(reader.damaged_ranges))

"""The files of a ROS bag, and their messages in the order in which they were written.

They are not read by rosbags, which ends at the first byte that is missing, and skips topics whose QoS is another text
in metadata.yaml than in the file.
"""

from __future__ import annotations

import re
import sqlite3
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO, NamedTuple

from mcap.exceptions import McapError
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Header, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from zstandard import ZstdDecompressor, ZstdError

from fantwin.pipeline.sources.column_file import LogError, in_one_line

MCAP_START, SQLITE_START, ROS_1_START = b"\x89MCAP0\r\n", b"SQLite format 3\0", b"#ROSBAG V2.0"
ZSTD_START = b"\x28\xb5\x2f\xfd"
METADATA_FILE = "metadata.yaml"
_DIGITS = re.compile(r"(\d+)")
_SUFFIXES = (".mcap", ".db3", ".mcap.zstd", ".db3.zstd")
_RECORD_LIMIT = 256 << 20
_DAMAGED = (McapError, ZstdError, struct.error, ValueError, EOFError, OverflowError, MemoryError, RuntimeError)


class Topic(NamedTuple):
    """A topic as a bag describes it. definition: of its type, in this language; may be empty, as in old bags."""

    name: str
    type: str
    encoding: str
    definition: str = ""
    language: str = ""


@dataclass
class BagFiles:
    """The files of a bag.

    Attributes:
        counts: messages by topic, as metadata.yaml has them.
        notes: what is unusual, a line each; more of them once the messages have been read.
    """

    files: Sequence[Path]
    counts: Counter[str] = field(default_factory=Counter[str])
    notes: list[str] = field(default_factory=list[str])

    def messages(self) -> Iterator[tuple[Topic, int, bytes]]:
        """Each message that can be read: its topic, time of receipt in ns, and data. Raises LogError."""
        for path in self.files:
            try:
                yield from self._of_file(path)
            except LogError as error:
                if len(self.files) == 1:
                    raise
                self.notes.append(f"left out: {error}")

    def _of_file(self, path: Path) -> Iterator[tuple[Topic, int, bytes]]:
        with _decompressed(path) as file:
            start = _start(file)
            if start.startswith(MCAP_START):
                yield from self._of_mcap(path, file)
            elif start.startswith(SQLITE_START):
                yield from self._of_sqlite(path, file)
            elif start.startswith(ROS_1_START):
                yield from _of_ros_1(path)
            else:
                what = "its beginning is lost" if path.stat().st_size else "empty"
                raise LogError(f"{path}: no ROS bag that can be read: {what}")

    def _of_mcap(self, path: Path, file: Path) -> Iterator[tuple[Topic, int, bytes]]:
        found, lost, profile = 0, Counter[str](), ""
        with file.open("rb") as stream:
            schemas, topics = _described_at_the_end(stream)
            try:
                for record in StreamReader(stream, emit_chunks=True, record_size_limit=_RECORD_LIMIT).records:
                    for each in _records_in(record, lost):
                        match each:
                            case Message() if each.channel_id in topics:
                                found += 1
                                yield topics[each.channel_id], each.log_time, each.data
                            case Message():
                                lost["messages of topics that are described in these"] += 1
                            case Header():
                                profile = each.profile
                            case Schema():
                                schemas[each.id] = each
                            case Channel():
                                topics[each.id] = _topic_of(each, schemas.get(each.schema_id))
                            case Metadata(name="fantwin") if not profile:
                                raise LogError(
                                    f"{path}: is a recording of fantwin already; `fantwin info {path}` shows it"
                                )
                            case _:
                                pass
            except _DAMAGED:
                self._cut(path, file, found, f"`fantwin info --repair {path} -o FIXED.mcap`")
        self.notes += [f"{path.name}: {what}, left out: {count}" for what, count in lost.items()]

    def _of_sqlite(self, path: Path, file: Path) -> Iterator[tuple[Topic, int, bytes]]:
        found = 0
        try:
            with closing(self._database(file)) as database:
                topics = _topics_of(database)
                for topic, t_ns, data in database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id"):
                    if topic in topics:
                        found += 1
                        yield topics[topic], t_ns, data
        except sqlite3.Error as error:
            if not found:
                raise LogError(f"{path}: no ROS bag that can be read: {in_one_line(error)}") from error
            self._cut(path, file, found, f"`sqlite3 {path} .recover | sqlite3 FIXED.db3`")

    def _cut(self, path: Path, file: Path, found: int, command: str) -> None:
        more = f"; if there are more behind, {command} saves them" if path == file else ""
        self.notes.append(f"{path.name} is cut or damaged after {found} messages{more}")

    def _database(self, file: Path) -> sqlite3.Connection:
        """A connection that writes nothing, and reads a file that was cut as far as it goes."""
        try:
            return _opened(f"{file.absolute().as_uri()}?mode=ro")
        except sqlite3.OperationalError:  # a folder that cannot be written, for a file with a write-ahead log
            if file.with_name(f"{file.name}-wal").exists():
                self.notes.append(f"{file.name}-wal cannot be read in a folder that cannot be written: copy the bag")
            return _opened(f"{file.absolute().as_uri()}?immutable=1")


def bag_files(path: Path) -> BagFiles:
    """The files of a bag, which is a folder or one file. Raises LogError."""
    if path.is_file():
        return BagFiles([path])
    there = files_in(path)
    if (path / METADATA_FILE).exists():
        bag = _listed(path)
        unlisted = [each.name for each in there if each not in bag.files]
        if bag.files and unlisted:
            bag.notes.append(f"{', '.join(unlisted)}: left out, as {METADATA_FILE} does not list it; import it by name")
        if bag.files:
            return bag
    else:
        bag = BagFiles([], notes=[f"{METADATA_FILE} is missing, as after a recording that was not finished"])
    if len({_bag_name(each) for each in there}) != 1:
        several = f"{len(there)} bags in it: name one, such as {there[0]}" if there else ""
        raise LogError(f"{path}: {several or '; '.join((*bag.notes, 'no bag file is there'))}")
    return BagFiles(there, bag.counts, bag.notes)


def files_in(folder: Path) -> list[Path]:
    """The files of bags in a folder, part 2 before part 10; not a compressed one beside itself."""
    found = [each for each in folder.iterdir() if each.is_file() and each.name.endswith(_SUFFIXES)]
    found = [each for each in found if each.suffix != ".zstd" or each.with_suffix("") not in found]
    return sorted(found, key=lambda each: [int(part) if part.isdigit() else part for part in _DIGITS.split(each.name)])


def _bag_name(path: Path) -> str:
    return re.sub(r"_?\d*(\.\w+)+$", "", path.name)


def _listed(folder: Path) -> BagFiles:
    """What metadata.yaml lists, as far as it is there."""
    from ruamel.yaml import YAML, YAMLError  # noqa: PLC0415  an extra

    try:
        found = YAML(typ="safe").load(folder / METADATA_FILE)["rosbag2_bagfile_information"]
        names = [Path(str(name)).name for name in found["relative_file_paths"]]
        counts = Counter(
            {
                str(each["topic_metadata"]["name"]): int(each["message_count"])
                for each in found["topics_with_message_count"]
            }
        )
    except (YAMLError, OSError, LookupError, TypeError, ValueError) as error:
        return BagFiles([], notes=[f"{METADATA_FILE} cannot be read ({in_one_line(error)})"])
    bag = BagFiles([], counts)
    for name in names:
        either = (folder / name, folder / f"{name}.zstd", folder / name.removesuffix(".zstd"))
        there = [each for each in either if each.is_file()][:1]
        bag.files = [*bag.files, *there]
        bag.notes += [] if there else [f"{name}, which {METADATA_FILE} lists, is missing"]
    return bag


def _described_at_the_end(stream: BinaryIO) -> tuple[dict[int, Schema], dict[int, Topic]]:
    """The topics in the summary of an MCAP file, for those whose first description is damaged; none: it has no end."""
    try:
        summary = SeekingReader(stream, record_size_limit=_RECORD_LIMIT).get_summary()
    except (*_DAMAGED, OSError):
        summary = None
    stream.seek(0)
    if summary is None:
        return {}, {}
    return summary.schemas, {
        number: _topic_of(each, summary.schemas.get(each.schema_id)) for number, each in summary.channels.items()
    }


def _records_in(record: McapRecord, lost: Counter[str]) -> Sequence[McapRecord]:
    """The records of a chunk, or the record itself. lost: counts damaged chunks."""
    if not isinstance(record, Chunk):
        return [record]
    try:
        return breakup_chunk(record, validate_crc=True)
    except _DAMAGED:
        lost["damaged chunks"] += 1
        return []


@contextmanager
def _decompressed(path: Path) -> Iterator[Path]:
    """The file, or a copy without its compression, as far as it goes."""
    if not _start(path).startswith(ZSTD_START):
        yield path
        return
    with TemporaryDirectory() as folder:
        copy = Path(folder, path.stem)
        with path.open("rb") as packed, copy.open("wb") as file:
            try:
                ZstdDecompressor().copy_stream(packed, file)
            except ZstdError as error:
                raise LogError(f"{path}: cannot be decompressed: {in_one_line(error)}") from error
        yield copy


def _of_ros_1(path: Path) -> Iterator[tuple[Topic, int, bytes]]:
    from rosbags.rosbag1 import Reader, ReaderError  # noqa: PLC0415  an extra

    try:
        with Reader(path) as reader:
            for each, t_ns, data in reader.messages():
                yield Topic(each.topic, each.msgtype, "ros1", each.msgdef.data, "ros1msg"), t_ns, data
    except (ReaderError, *_DAMAGED) as error:
        raise LogError(
            f"{path}: no ROS 1 bag that can be read: {in_one_line(error)}; `rosbag reindex` mends one that was not "
            "finished"
        ) from error


def _start(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(len(SQLITE_START))
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror}") from error


def _topic_of(channel: Channel, schema: Schema | None) -> Topic:
    if schema is None:
        return Topic(channel.topic, "without a name", channel.message_encoding)
    return Topic(
        channel.topic, schema.name, channel.message_encoding, schema.data.decode("utf-8", "replace"), schema.encoding
    )


def _opened(uri: str) -> sqlite3.Connection:
    database = sqlite3.connect(uri, uri=True)
    try:
        database.execute("PRAGMA writable_schema = ON")  # else SQLite refuses a file with fewer pages than it states
        database.execute("SELECT count(*) FROM sqlite_master").fetchone()
    except sqlite3.Error:
        database.close()
        raise
    return database


def _topics_of(database: sqlite3.Connection) -> dict[int, Topic]:
    definitions: dict[str, tuple[str, str]] = {}
    if database.execute("SELECT 1 FROM sqlite_master WHERE name = 'message_definitions'").fetchone():
        rows = database.execute("SELECT topic_type, encoded_message_definition, encoding FROM message_definitions")
        definitions = {kind: (text, language) for kind, text, language in rows}
    topics = database.execute("SELECT id, name, type, serialization_format FROM topics")
    return {
        number: Topic(name, kind, encoding, *definitions.get(kind, ("", ""))) for number, name, kind, encoding in topics
    }

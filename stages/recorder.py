"""Recorder: keeps everything that goes over the bus in an MCAP file.

Reads   every topic of the table that is to be recorded, of all trays, and the health of all stages
Writes  nothing on the bus; a recording, docs/recordings.md
Units   as in the messages: bytes are kept as they came
Timing  a message is safe from a crash of this process after `flush_interval_s` at most
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Protocol

from pydantic import Field

from pipeline.recordings.reading import RecordingError
from pipeline.recordings.writing import RecordingWriter
from pipeline.stage import Context, Core, Packet, Parts, Stage, StageConfig, StageError
from schemas.messages import Message
from schemas.topics import TOPICS

CONFIGURATION = "configuration.toml"
_LOG = logging.getLogger(__name__)


class RecorderConfig(StageConfig):
    """Section `[recorder]`."""

    file: Path = Field(
        default=Path("recording.mcap"),
        description="relative to run_folder; if it exists, NAME-2.mcap and so on is taken",
    )
    flush_interval_s: float = Field(default=1.0, gt=0, description="at most this much is lost in a crash")


class Writer(Protocol):
    """What the core needs of a recording; see `pipeline.recordings.writing.RecordingWriter`."""

    written: Counter[str]
    pending: Counter[str]

    def write(self, key: str, payload: bytes, message: Message, log_time_ns: int) -> None: ...  # noqa: D102
    def flush(self) -> None: ...  # noqa: D102
    def close(self) -> None: ...  # noqa: D102


class Recorder(Core):
    """Hands every packet to the writer. Once the disk has refused, counts what is not recorded and says so."""

    def __init__(self, writer: Writer, flush_interval_s: float) -> None:
        self._writer = writer
        self._flush_interval_ns = round(flush_interval_s * 1e9)
        self._flushed_ns = 0
        self._problem = ""
        self._unwritten = 0

    def step(self, item: Packet) -> Sequence[Message]:
        """Record one packet."""
        if self._problem:
            self._unwritten += 1
        else:
            self._attempt(lambda: self._writer.write(item.key, item.payload, item.message, item.received_t_ns))
        return ()

    def tick(self, now_ns: int) -> Sequence[Message]:
        """Flush when it is time."""
        if not self._problem and now_ns - self._flushed_ns >= self._flush_interval_ns:
            self._flushed_ns = now_ns
            self._attempt(self._writer.flush)
        return ()

    def close(self) -> Sequence[Message]:
        """Finish the file."""
        if not self._problem:
            self._attempt(self._writer.close)
        return ()

    def counters(self) -> Mapping[str, int]:
        """How many messages of each topic are in the file for good, and how many could not be written."""
        recorded = {f"recorded_{topic}": count for topic, count in self._writer.written.items()}
        return recorded | {"lost_unwritten": self._unwritten}

    def problem(self) -> str:
        """Why nothing is recorded any more, if so."""
        return self._problem

    def _attempt(self, write: Callable[[], None]) -> None:
        try:
            write()
        except RecordingError as error:
            self._problem = f"NOTHING IS RECORDED: {error}"
            self._unwritten += self._writer.pending.total()


def head(context: Context) -> tuple[dict[str, str], dict[str, bytes]]:
    """Metadata and attachments of a recording: what is needed to read it, and to judge it again, anywhere."""
    metadata = {
        "made_by": f"fantwin {version('fantwin')}",
        "site": context.site,
        "started": datetime.fromtimestamp(context.started_t_ns / 1e9, UTC).isoformat(timespec="milliseconds"),
        "started_t_ns": str(context.started_t_ns),
        "trays": ",".join(tray.name for tray in context.trays),
    }
    if context.overrides:
        metadata["overrides"] = json.dumps(context.overrides)
    attachments = {CONFIGURATION: context.configuration_text.encode()}
    for tray in context.trays:
        metadata[f"fans.{tray.name}"] = str(tray.fans)
        metadata[f"speed_unit.{tray.name}"] = tray.speed_unit
        if tray.twin is not None:
            path = context.resolve(tray.twin)
            try:
                twin = path.read_bytes()
            except OSError as error:
                _LOG.warning("%s: the twin is not in the recording: %s", path, error.strerror)
                continue
            metadata[f"twin_sha256.{tray.name}"] = hashlib.sha256(twin).hexdigest()
            attachments[f"{tray.name}.onnx"] = twin
    return metadata, attachments


def build(context: Context) -> Parts:
    """Begin the file.

    Raises:
        StageError: it cannot be written there.
    """
    config: RecorderConfig = context.config
    metadata, attachments = head(context)
    try:
        writer = RecordingWriter(context.run_folder / config.file, metadata, attachments, t_ns=context.started_t_ns)
    except RecordingError as error:
        raise StageError(f"{error} (recorder.file)") from error
    if writer.left_over:
        _LOG.warning("a recorder had been killed; what it has recorded is kept as %s", writer.left_over)
    return Parts(Recorder(writer, config.flush_interval_s))


def check(context: Context) -> list[str]:
    """A folder that the file cannot be written in."""
    folder = (context.run_folder / context.config.file).parent
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    if existing.is_dir() and os.access(existing, os.W_OK | os.X_OK):
        return []
    return [f"{folder}: {existing} is no folder this user may write in; change run_folder or recorder.file"]


STAGE = Stage(
    name="recorder",
    about="keeps every message, with configuration and twin, in an MCAP file",
    reads=tuple(topic.name for topic in TOPICS if topic.recorded),
    writes=(),
    config=RecorderConfig,
    build=build,
    core_per_tray=False,
    wants_packets=True,
    check=check,
)

"""A recorder in this process, its messages, and a stand-in for its disk, which refuses, vanishes and fills at will."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import NoReturn

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.recordings.clips.alarm_clips import AlarmClips
from fantwin.pipeline.recordings.clips.tracker import ClipTracker, CutResult
from fantwin.pipeline.recordings.disk import DiskError
from fantwin.pipeline.recordings.parts import RecordingParts
from fantwin.pipeline.recordings.reading import RecordingError
from fantwin.pipeline.recordings.recorder import Recorder
from fantwin.pipeline.recordings.recorder_config import RecorderConfig
from fantwin.pipeline.recordings.sequence_ledger import SequenceLedger, StreamId
from fantwin.pipeline.recordings.stored_recordings import Stored, StoredPart
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.runtime.stage import Context
from fantwin.schemas.codec import encode
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Message, Raw
from fantwin.schemas.topics import health_key, topic_of, tray_key
from tests.support.made_messages import filled

SECOND_NS = 1_000_000_000
NOW_NS = 10 * SECOND_NS
RAW_KEY = tray_key("plant", "tray1", "raw")


def context(folder: Path, tray: TrayConfig | None = None, **config) -> Context:
    return Context(
        site="plant",
        trays=(tray or TrayConfig(name="tray1", fans=2, speed_unit="rpm"),),
        config=RecorderConfig(**config),
        folder=folder,
        run_folder=folder / "runs",
        started_t_ns=1_800_000_000_250_000_000,
        configuration_text="site = 'plant'\n",
    )


def envelope(message: Message, topic: str, received_t_ns: int = 5) -> Envelope:
    key = health_key("plant", "scorer", "all") if topic == "health" else tray_key("plant", "tray1", topic)
    return Envelope(key, topic, encode(message), received_t_ns, message)


def raw(sequence: int, samples: int = 1) -> Raw:
    header = Header("acquisition-1", sequence, "tray1")
    return filled(Raw, samples, 2, header=header, host_receive_t_ns=sequence, command=1.0, speed_rad_s=1.0)


class Part(RecordingWriter):
    """A stand-in for a part whose disk refuses after some number of messages. `flush` makes them permanent."""

    def __init__(self, disk: Disk, name: str, t_ns: int, ledger: SequenceLedger, about: Mapping[str, str]) -> None:
        self.path, self.t_ns, self.about, self.ledger = Path(name), t_ns, dict(about), ledger
        self._disk = disk
        self.written: Counter[str] = Counter()
        self.waiting: list[Envelope] = []
        self.content: list[Envelope] = []
        self.flushes = self.restored = self.lost = 0
        self.closed = ""
        self.size_bytes = 0

    @property
    def size(self) -> int:
        return self.size_bytes

    @property
    def pending(self) -> list[Envelope]:
        return self.waiting

    def add(self, envelope: Envelope) -> None:
        self._touch()
        self.waiting.append(envelope)
        if len(self.content) + len(self.pending) > self._disk.room:
            self._refuse()

    def flush(self) -> None:
        self._touch()
        if self._disk.refuses:
            self._refuse()
        for envelope in self.pending:
            header = envelope.message.header
            self.ledger.add(envelope.key, header.producer, header.sequence, envelope.received_t_ns)
        self.written.update(topic_of(pending.key).name for pending in self.pending)
        self.size_bytes += sum(len(pending.payload) for pending in self.pending)
        self.content += self.pending
        self.waiting = []
        self.flushes += 1

    def stay_in_place(self) -> None: ...

    def finish(self, *, has_ended: bool = False) -> None:
        self.flush()
        self.closed = "at the end" if has_ended else "before the next"

    def discard(self) -> None:
        raise AssertionError("it has messages")

    def _refuse(self) -> NoReturn:
        self.closed = "early"
        raise DiskError("r.mcap: cannot be written any more: No space left on device")

    def _touch(self) -> None:
        assert not self.closed, "nothing touches a part that has ended"


class Disk(RecordingParts):
    """A stand-in for the folder in which parts are created."""

    def __init__(self) -> None:
        self.before: dict[StreamId, int] = {}
        self.parts: list[Part] = []
        self.free = 1 << 40
        self.room = 1 << 40
        self.refuses = False
        self.disk = 1 << 44
        self.old: list[StoredPart] = []
        self.deleted: list[Path] = []
        self.freed_by_each = 0
        self.gone = self.refuses_to_list = self.undeletable = ""

    def begin(self, t_ns: int, ledger: SequenceLedger, about: Mapping[str, str]) -> Part:
        if self.refuses:
            raise DiskError("r.mcap: cannot be written: No space left on device")
        self.parts.append(Part(self, f"r-{len(self.parts) + 1}.mcap", t_ns, ledger, about))
        return self.parts[-1]

    def free_bytes(self) -> int:
        if self.gone:
            raise DiskError(self.gone)
        return self.free

    def disk_bytes(self) -> int:
        return self.disk

    def stored(self) -> Stored:
        if self.refuses_to_list:
            raise RecordingError(self.refuses_to_list)
        numbered = enumerate(self.parts, 1000)
        ended = [StoredPart(part.t_ns, number, part.path) for number, part in numbered if part.closed]
        stored = [part for part in (*self.old, *ended) if part.path not in self.deleted]
        return Stored(tuple(stored), len(stored) * self.freed_by_each, 0)

    def delete(self, part: StoredPart) -> None:
        if self.undeletable:
            raise RecordingError(self.undeletable)
        self.free += self.freed_by_each
        self.deleted.append(part.path)
        self.old = [kept for kept in self.old if kept != part]

    @property
    def old_names(self) -> list[str]:
        return [part.path.name for part in self.old]


def old_parts(*names: str, last_ns: int = NOW_NS) -> list[StoredPart]:
    return [StoredPart(last_ns, number, Path(name)) for number, name in enumerate(names)]


def recorder(disk: Disk, **config) -> Recorder:
    return Recorder(disk, RecorderConfig(**config), NOW_NS, uncut_clips(Path("recording.mcap")))


def uncut_clips(recording: Path) -> AlarmClips:
    """Clips that are empty."""
    return AlarmClips(ClipTracker((), 0), recording, lambda clip: CutResult(clip.name))

"""What the recorder's core needs of its folder and of the part that it writes: tests stand in for both."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol

from fantwin.pipeline.recordings.indexed import PartIndex
from fantwin.pipeline.recordings.sequence_ledger import SequenceLedger
from fantwin.pipeline.recordings.stored_recordings import Stored, StoredPart
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.streams import StreamId


class OpenPart(Protocol):
    """The methods of `pipeline.recordings.writing.RecordingWriter` that the core uses."""

    path: Path
    written: Counter[str]
    restored: int
    lost: int

    @property
    def pending(self) -> Sequence[Envelope]: ...  # noqa: D102
    @property
    def size(self) -> int: ...  # noqa: D102
    def index(self) -> PartIndex: ...  # noqa: D102
    def add(self, envelope: Envelope) -> None: ...  # noqa: D102
    def flush(self) -> None: ...  # noqa: D102
    def stay_in_place(self) -> None: ...  # noqa: D102
    def finish(self, *, has_ended: bool = False) -> None: ...  # noqa: D102
    def discard(self) -> None: ...  # noqa: D102


class PartsFolder(Protocol):
    """The methods of `pipeline.recordings.parts.RecordingParts` that the core uses."""

    @property
    def before(self) -> Mapping[StreamId, int]: ...  # noqa: D102
    def begin(self, t_ns: int, ledger: SequenceLedger, about: Mapping[str, str]) -> OpenPart: ...  # noqa: D102
    def free_bytes(self) -> int: ...  # noqa: D102
    def disk_bytes(self) -> int: ...  # noqa: D102
    def stored(self) -> Stored: ...  # noqa: D102
    def delete(self, part: StoredPart) -> None: ...  # noqa: D102

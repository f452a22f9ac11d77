"""Messages of a topic that a recording has few of: found by its index, or by one that is made of its chunk headers."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.opcode import Opcode
from mcap.records import ChunkIndex

from fantwin.pipeline.recordings import indexed
from fantwin.pipeline.recordings.indexed import last_messages, rare_messages
from fantwin.pipeline.recordings.records import RecordReader
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.codec import decode
from fantwin.schemas.header import Header
from fantwin.schemas.messages import ModelCard
from fantwin.schemas.topics import tray_key
from tests.support.replay_data import START_NS, STEP_NS, raw_of

AT = (0, 1500, 2999)
"""raw messages before which there is a card"""


@pytest.fixture(params=["finished", "killed"])
def recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Path:
    """A recording of many chunks, with an index and without one."""
    monkeypatch.setattr("fantwin.pipeline.recordings.writing.CHUNK_BYTES", 4096)
    with RecordingWriter(tmp_path / "r.mcap", {"trays": "tray1"}) as writer:
        for sample in range(3000):
            if sample in AT:
                card = ModelCard(header=Header("t", sample, "tray1"), t_ns=1, twin="a", kind="hybrid", sha256="")
                writer.add_message(tray_key("demo", "tray1", "twin"), card, START_NS + sample * STEP_NS)
            writer.add_message(tray_key("demo", "tray1", "raw"), raw_of(sample, 1), START_NS + sample * STEP_NS)
    path = tmp_path / "r.mcap"
    if request.param == "killed":
        (*_, ledger) = [record for record in RecordReader(path) if record.opcode == Opcode.METADATA]
        path.write_bytes(path.read_bytes()[: ledger.offset - 10])
    return path


def found(path: Path) -> list[tuple[str, int, int]]:
    return [(e.key, e.message.header.sequence, e.received_t_ns) for e in rare_messages(path, "twin")]


CARDS = [(tray_key("demo", "tray1", "twin"), sample, START_NS + sample * STEP_NS) for sample in AT]


def test_they_are_found_by_the_index_without_reading_the_rest(recording, monkeypatch):
    def read(*_: object) -> None:
        raise AssertionError("the whole file is read")

    monkeypatch.setattr("fantwin.pipeline.recordings.indexed.read_recording", read)
    assert found(recording) == CARDS
    assert rare_messages(recording, "grid") == []


def test_the_last_one_of_each_key_is_found_from_the_end(recording, monkeypatch):
    read: list[int] = []

    def chunk_at(file, chunk: ChunkIndex) -> bytes:
        read.append(chunk.chunk_start_offset)
        return whole(file, chunk)

    whole = indexed.chunk_at
    monkeypatch.setattr(indexed, "chunk_at", chunk_at)
    (payload,) = last_messages(recording, "twin").values()
    assert decode(ModelCard, payload).header.sequence == AT[-1]
    assert len(set(read)) <= 3, "with those that describe a channel"
    assert last_messages(recording, "grid") == {}

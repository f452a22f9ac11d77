"""Reading messages as bytes: they equal the decoded ones, and damage is skipped."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.opcode import Opcode

from fantwin.pipeline.recordings.reading import RecordingError, read_recording
from fantwin.pipeline.recordings.records import RECORD, RecordReader
from fantwin.pipeline.recordings.scan import scan
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.codec import decode, encode
from fantwin.schemas.messages import newest_t_ns

GOLDEN = Path(__file__).parents[2] / "support" / "data" / "golden.mcap"


def test_the_messages_read_as_bytes_are_those_read_decoded():
    topics = ("raw", "score", "alarm")
    as_bytes, decoded = list(read_recording(GOLDEN, topics).undecoded()), list(read_recording(GOLDEN, topics))
    assert [(e.key, e.topic, e.received_t_ns) for e in as_bytes] == [(e.key, e.topic, e.received_t_ns) for e in decoded]
    for one, other in zip(as_bytes, decoded, strict=True):
        assert encode(decode(type(other.message), one.payload)) == encode(other.message)
        assert one.newest_t_ns == newest_t_ns(other.message)
    assert list(read_recording(GOLDEN, ("raw",), tray="tray1").undecoded())
    assert not list(read_recording(GOLDEN, ("raw",), tray="tray2").undecoded())


def test_a_file_that_is_still_being_written_is_no_crash(tmp_path):
    with RecordingWriter(tmp_path / "r.mcap", {}) as writer:
        for envelope in read_recording(GOLDEN, ("raw",)).undecoded():
            writer.add_message(envelope.key, envelope.message, envelope.received_t_ns)
        writer.flush()
        reading = read_recording(tmp_path / "r.mcap.active")
        assert list(reading.undecoded())
        assert reading.damage == f"{tmp_path}/r.mcap.active: it is still being written; read up to its last flush"
    whole = read_recording(tmp_path / "r.mcap")
    assert list(whole.undecoded())
    assert not whole.damage


@pytest.mark.parametrize("what", ["content", "length"])
def test_a_damaged_chunk_costs_only_that_chunk(tmp_path, what):
    damaged, flushed = tmp_path / "damaged.mcap", tmp_path / "flushed.mcap"
    with RecordingWriter(flushed, {}) as writer:
        for number, envelope in enumerate(read_recording(GOLDEN)):
            writer.add_message(envelope.key, envelope.message, envelope.received_t_ns)
            if number % 100 == 0:
                writer.flush()
    content = bytearray(flushed.read_bytes())
    chunks = [record for record in RecordReader(flushed) if record.opcode == Opcode.CHUNK]
    chunk = chunks[len(chunks) // 2]
    if what == "content":
        content[chunk.end - 10] ^= 0xFF
    else:
        RECORD.pack_into(content, chunk.offset, Opcode.CHUNK, 1 << 62)
    damaged.write_bytes(content)
    reading, whole = read_recording(damaged), list(read_recording(flushed))
    for found in (list(reading), list(reading.undecoded())):
        assert len(found) == len(whole) - 100
        assert found[-1].received_t_ns == whole[-1].received_t_ns
        assert reading.damage == f"{damaged}: damaged chunks left out: 1"


def test_messages_of_a_channel_that_only_a_damaged_chunk_declared_are_counted_where_the_file_has_no_end(tmp_path):
    path, envelopes = tmp_path / "r.mcap", list(read_recording(GOLDEN, ("raw",)).undecoded())[:4]
    with RecordingWriter(path, {}) as writer:
        for envelope in envelopes:
            writer.add_message(envelope.key, envelope.message, envelope.received_t_ns)
            writer.flush()
    first, *_, last = (record for record in RecordReader(path) if record.opcode == Opcode.CHUNK)
    content = bytearray(path.read_bytes())
    content[first.end - 10] ^= 0xFF
    path.write_bytes(content)
    assert len(list(read_recording(path))) == 3
    path.write_bytes(content[: last.end])
    reading = read_recording(path)
    assert list(reading) == []
    assert reading.damage.endswith("damaged chunks left out: 1; messages left out whose channel is damaged: 3")


def test_a_recording_that_is_renamed_while_it_is_read_is_one_line(tmp_path, monkeypatch):
    """The recorder that finishes it renames it."""
    path, read = tmp_path / "one.mcap", RecordReader.__iter__
    path.write_bytes(GOLDEN.read_bytes())

    def then_renamed(reader):
        yield from read(reader)
        path.rename(tmp_path / "other.mcap")

    monkeypatch.setattr(RecordReader, "__iter__", then_renamed)
    with pytest.raises(RecordingError, match="one.mcap: cannot read the recording: No such file"):
        scan(path)

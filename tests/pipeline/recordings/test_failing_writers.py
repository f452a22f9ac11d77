"""Recordings whose writer is killed, fails, or has a disk that is full or refuses: what is in the file is counted."""

import errno
import os
from itertools import count
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC
from mcap_protobuf.decoder import DecoderFactory

from fantwin.pipeline.recordings import writing
from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.recordings.disk import AtomicAppendFile, DiskError
from fantwin.pipeline.recordings.reading import RecordingError, read_recording
from fantwin.pipeline.recordings.writing import RecordingWriter
from tests.support.failing_writers import disk_of
from tests.support.written_recordings import RAW_KEY, raw

SMALL_BYTES = 8 * 1024


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few messages fill a chunk."""
    monkeypatch.setattr(writing, "CHUNK_BYTES", SMALL_BYTES)


def test_an_exception_while_writing_leaves_no_file(tmp_path):
    with pytest.raises(ZeroDivisionError), RecordingWriter(tmp_path / "r.mcap", {}) as writer:
        writer.add_message(RAW_KEY, raw(0), 0)
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_a_flush_syncs_the_file_once_and_its_name_is_synced_too(tmp_path, monkeypatch):
    synced = []
    monkeypatch.setattr(os, "fdatasync", lambda descriptor: synced.append(os.fstat(descriptor).st_size))
    monkeypatch.setattr(os, "fsync", lambda descriptor: synced.append(Path(f"/proc/self/fd/{descriptor}").readlink()))
    writer = RecordingWriter(tmp_path / "r.mcap", {})
    assert synced == [tmp_path]
    writer.add_message(RAW_KEY, raw(0), 0)
    writer.flush()
    writer.flush()
    assert synced == [tmp_path, writer.size], "once, as long as there is nothing new"
    writer.finish()
    assert synced[2:] == [(tmp_path / "r.mcap").stat().st_size, tmp_path]


@pytest.mark.parametrize("for_ever", [False, True])
def test_a_failed_sync_is_reported_and_the_file_ends_readable(tmp_path, monkeypatch, for_ever):
    writer = RecordingWriter(tmp_path / "r.mcap", {})
    for sequence in range(500):
        writer.add_message(RAW_KEY, raw(sequence), sequence)
    writer.flush()
    sync, failures = os.fdatasync, count()

    def fail(descriptor: int) -> None:
        if for_ever or next(failures) == 0:
            raise OSError(errno.EIO, "Input/output error")
        sync(descriptor)

    monkeypatch.setattr(os, "fdatasync", fail)
    for sequence in range(500, 1001):
        writer.add_message(RAW_KEY, raw(sequence), sequence)
    with pytest.raises(DiskError, match="r.mcap: cannot be written any more: Input/output error; it ends here"):
        writer.flush()
    reading = read_recording(tmp_path / "r.mcap")
    assert [envelope.message.header.sequence for envelope in reading] == list(range(500)), "what was on the disk before"
    assert [pending.message.header.sequence for pending in writer.pending] == list(range(500, 1001))
    assert (writer.written["raw"], contents_of(writer.path).streams[RAW_KEY, "acquisition-1"].messages) == (500, 500)
    assert reading.damage == ""
    assert (tmp_path / "r.mcap").read_bytes().count(MCAP0_MAGIC) == 2, "one beginning, one end"


def test_a_writer_that_is_never_flushed_uses_bounded_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(writing, "UNSYNCED_BYTES", 2 * SMALL_BYTES)
    with RecordingWriter(tmp_path / "r.mcap", {}) as writer:
        for sequence in range(500):
            writer.add_message(RAW_KEY, raw(sequence), sequence)
            assert sum(len(pending.payload) for pending in writer.pending) < 4 * SMALL_BYTES


@pytest.mark.parametrize("size", [SMALL_BYTES + 1234, 30_000])
def test_a_full_disk_ends_the_file_after_the_last_intact_chunk(tmp_path, size):
    path = tmp_path / "r.mcap"
    writer = RecordingWriter(path, {})
    written = 0
    with disk_of(size), pytest.raises(RecordingError, match="File too large; it ends here and is readable"):
        for written in count():
            writer.add_message(RAW_KEY, raw(written), written)
    assert writer.written["raw"] > 0
    unwritten = [pending.message.header.sequence for pending in writer.pending]
    assert unwritten == list(range(writer.written["raw"], written + 1))
    reading = read_recording(path)
    assert [e.message.header.sequence for e in reading] == list(range(writer.written["raw"]))
    assert reading.damage == ""
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_summary() is None, "there was no room for an index either"
        messages = list(reader.iter_decoded_messages())
    assert len(messages) == writer.written["raw"]


def test_a_file_that_cannot_be_begun_is_reported_in_one_line_and_leaves_nothing(tmp_path, monkeypatch):
    with disk_of(20), pytest.raises(RecordingError, match=r"r\.mcap: cannot be written: File too large; name another"):
        RecordingWriter(tmp_path / "r.mcap", {})
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match=r"cannot be written: (Not a directory|File exists)"):
        RecordingWriter(tmp_path / "file" / "r.mcap", {})

    def read_only(*_: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(AtomicAppendFile, "write", read_only)
    monkeypatch.setattr(Path, "unlink", read_only)
    with pytest.raises(DiskError, match="r.mcap: cannot be written: Read-only file system"):
        RecordingWriter(tmp_path / "r.mcap", {})

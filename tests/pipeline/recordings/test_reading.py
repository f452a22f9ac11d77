"""Reading messages as bytes: they equal the decoded ones, and damage is skipped."""

from __future__ import annotations

from pathlib import Path

import pytest

from fantwin.pipeline.recordings.reading import RecordingError, read_recording
from fantwin.pipeline.recordings.records import RecordReader
from fantwin.pipeline.recordings.scan import scan
from fantwin.pipeline.recordings.writing import RecordingWriter

GOLDEN = Path(__file__).parents[2] / "support" / "data" / "golden.mcap"


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

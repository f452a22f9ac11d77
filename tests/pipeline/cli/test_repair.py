"""`fantwin info --repair`: a damaged recording is repaired, and the exit code says whether anything was lost."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from mcap.opcode import Opcode

from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.recordings.records import RecordReader
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.health import Output
from fantwin.schemas.topics import health_key
from tests.support import made_messages
from tests.support.fantwin_command import fantwin
from tests.support.written_recordings import RAW_KEY, chunk_ends, raw, read_by_others, small


@pytest.fixture
def whole(tmp_path) -> Path:
    return small(tmp_path / "whole.mcap")


@pytest.fixture
def truncated(tmp_path, whole) -> Path:
    path = tmp_path / "r.mcap.active"
    path.write_bytes(whole.read_bytes()[: chunk_ends(whole)[3][0] + 100])
    return path


def test_a_truncated_file_is_repaired_under_its_name_and_the_loss_reported(tmp_path, truncated):
    done = fantwin("info", "--repair", truncated)
    assert done.exit_code == 3
    assert f"{truncated}: 20 messages recovered in {tmp_path / 'r.mcap'}; the original is kept as" in done.stdout
    (line,) = [line for line in done.stdout.splitlines() if line.startswith("tray1/raw")]
    assert line.split()[1:4] == ["20", "0", "0"]
    assert "it is truncated, as after a crash: messages of the unfinished chunk may be missing" in done.stdout
    assert len(read_by_others(tmp_path / "r.mcap")) == 20
    assert (tmp_path / "r.mcap.original").exists()


@pytest.mark.parametrize("number", [0, 2])
def test_info_reports_the_losses_of_a_repaired_file(tmp_path, number):
    """Whichever chunk is damaged: the ledger of the file still has its messages."""
    path, keys = tmp_path / "r.mcap", health_key("plant", "scorer", "all")
    with RecordingWriter(path, {}) as writer:
        for chunk in range(3):
            for sequence in range(5):
                writer.add_message(RAW_KEY, raw(5 * chunk + sequence), 1000)
            writer.add_message(keys, made_messages.health("scorer", producer=f"scorer-{chunk}"), 1000)
            writer.flush()
    chunks = [record for record in RecordReader(path) if record.opcode == Opcode.CHUNK]
    content = bytearray(path.read_bytes())
    content[(chunks[number].offset + chunks[number].end) // 2] ^= 0xFF
    path.write_bytes(content)
    assert fantwin("info", "--repair", path, "-o", tmp_path / "out.mcap").exit_code == 3
    done = fantwin("info", tmp_path / "out.mcap", "--json")
    assert done.exit_code == 3
    shown = json.loads(done.stdout)
    assert shown["topics"][RAW_KEY]["missing"] == 5
    assert shown["topics"][keys]["missing"] == 1
    (file,) = shown["files"]
    assert (file["recovered"][1:], file["damage"]) == (["damaged chunks: 1"], [])
    assert contents_of(tmp_path / "out.mcap").next[RAW_KEY, "acquisition-1"] == 15
    assert "repaired earlier: damaged chunks: 1" in fantwin("info", tmp_path / "out.mcap").stdout
    assert fantwin("info", "--repair", tmp_path / "out.mcap").exit_code == 3, "it still is what it is"


def test_messages_that_health_reports_as_published_and_that_are_not_there_are_reported(tmp_path):
    writer = RecordingWriter(tmp_path / "r.mcap", {"flush_interval_s": "0.5"})
    writer.add_message(RAW_KEY, raw(0), 1)
    published = (Output(key=RAW_KEY, published=4),)
    health = made_messages.health("acquisition", "tray1", "acquisition-1", t_ns=2, outputs=published)
    writer.add_message(health_key("plant", "acquisition", "tray1"), health, 2)
    writer.flush()
    writer._file.close()
    done = fantwin("info", "--repair", tmp_path / "r.mcap.active")
    assert done.exit_code == 3
    assert "messages received in the last 0.5 s may be missing" in done.stdout
    assert (
        f"{RAW_KEY}: 3 messages of acquisition-1 published after the last one here, according to its health"
        in done.stdout
    )

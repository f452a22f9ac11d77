"""The parts of a recording: names, metadata that link them, and the file that a killed recorder leaves."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import NoReturn

import pytest
from mcap.opcode import Opcode

from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.recordings.parts import RecordingParts
from fantwin.pipeline.recordings.reading import RecordingError, read_metadata, read_recording
from fantwin.pipeline.recordings.records import RecordReader
from fantwin.pipeline.recordings.sequence_ledger import SequenceLedger
from fantwin.pipeline.recordings.writing import RecordingWriter
from tests.support.failing_writers import disk_of, kill_a_recorder
from tests.support.written_recordings import RAW_KEY, part, parts_in, raw, read_by_others, sequences, write

STREAM = (RAW_KEY, "acquisition-1")


def killed(writer: RecordingWriter) -> None:
    """Close the file as kill -9 does: the unfinished chunk is lost."""
    writer._file.close()


def refuse(*_: object) -> NoReturn:
    raise OSError(errno.EMFILE, "Too many open files")


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_parts_are_numbered_say_what_the_recorder_says_and_name_the_part_before(tmp_path):
    place = parts_in(tmp_path)
    ledger = SequenceLedger()
    for first in (0, 10, 20):
        part(place, range(first, first + 10), ledger).finish()
        ledger = ledger.for_next_part()
    writer = part(place)
    assert names(tmp_path) == ["r-2.mcap", "r-3.mcap", "r-4.mcap.active", "r.mcap"]
    assert place.stored().open_bytes == writer.size
    assert "r-4.mcap.active" not in [each.path.name for each in place.stored().parts], "it is not deleted"
    writer.finish()
    heads = [read_metadata(tmp_path / name) for name in ("r.mcap", "r-2.mcap", "r-3.mcap")]
    assert all(head.attachments == {"configuration.toml": b"site = 'plant'"} for head in heads)
    metadata = [head.metadata for head in heads]
    assert all(each["site"] == "plant" for each in metadata)
    assert [(m["part"], m["session"], m.get("continues")) for m in metadata] == [
        ("1", "s1", None),
        ("2", "s1", "r.mcap"),
        ("3", "s1", "r-2.mcap"),
    ]
    assert metadata[2]["started_t_ns"] == "5000000000"
    assert contents_of(tmp_path / "r-3.mcap").before == {STREAM: 20}


def oldest_deleted(place: RecordingParts) -> str | None:
    for oldest in place.stored().parts[:1]:
        place.delete(oldest)
        return oldest.path.name
    return None


def test_the_oldest_part_is_deleted_first_and_its_name_is_not_used_again(tmp_path):
    place = parts_in(tmp_path)
    for _ in range(11):
        part(place, [0]).finish()
    assert [oldest_deleted(place) for _ in range(10)] == ["r.mcap", *(f"r-{n}.mcap" for n in range(2, 11))]
    assert oldest_deleted(place) == "r-11.mcap"
    assert oldest_deleted(place) is None
    part(place).finish()
    assert names(tmp_path) == ["r-12.mcap"]


def test_what_other_recorders_wrote_counts_and_what_recorders_did_not_write_is_never_deleted(tmp_path):
    for name, at in (("2-of-2.r.mcap", 5_000), ("earlier.mcap", 1_000)):
        with RecordingParts(tmp_path / name, {}, {}, "other").begin(0, SequenceLedger(), {}) as writer:
            writer.add_message(RAW_KEY, raw(0), at)
    part(parts_in(tmp_path), [3_000]).finish()
    write(tmp_path / "import.mcap", 3)
    (tmp_path / "r-2.mcap").write_bytes(b"not ours")
    about = {"recording": "dated.mcap", "session": "s", "started_t_ns": "9" * 5000}
    RecordingWriter(tmp_path / "dated.mcap", about).finish()
    (tmp_path / "kept-by-me.mcap").write_bytes((tmp_path / "r.mcap").read_bytes())
    (tmp_path / "clips").mkdir()
    (tmp_path / "clips" / "c.mcap").write_bytes(bytes(100))
    place = parts_in(tmp_path)
    written = sum((tmp_path / name).stat().st_size for name in ("2-of-2.r.mcap", "earlier.mcap", "r.mcap"))
    assert (place.stored().finished_bytes, place.stored().clips_bytes) == (written, 100)
    assert [oldest_deleted(place) for _ in range(4)] == ["earlier.mcap", "r.mcap", "2-of-2.r.mcap", None]
    assert names(tmp_path) == ["clips", "dated.mcap", "import.mcap", "kept-by-me.mcap", "r-2.mcap"]


def test_a_new_recorder_takes_a_number_above_all_existing_ones(tmp_path):
    for name in ("r.mcap", "r-7.mcap", "r-9.mcap.original"):
        (tmp_path / name).touch()
    part(parts_in(tmp_path)).finish()
    assert "r-10.mcap" in names(tmp_path)


def test_the_file_of_a_killed_recorder_is_repaired_and_continued(tmp_path):
    kill_a_recorder(tmp_path / "r.mcap", flushed=40)
    place = parts_in(tmp_path, "s2")
    assert f"was repaired and is {tmp_path / 'r.mcap'}: 40 messages" in place.remarks[0]
    assert sequences(tmp_path / "r.mcap") == list(range(40))
    assert read_recording(tmp_path / "r.mcap").damage == ""
    assert contents_of(tmp_path / "r.mcap").damage == ()
    assert len(read_by_others(tmp_path / "r.mcap")) == 40
    assert names(tmp_path) == ["r.mcap"]


def kill_with_a_part_open(writer: RecordingWriter) -> None:
    writer.flush()
    killed(writer)


@pytest.mark.parametrize(
    "end",
    [kill_with_a_part_open, RecordingWriter.finish, lambda writer: writer.finish(has_ended=True)],
    ids=["killed", "killed in a pause", "stopped in order"],
)
def test_the_next_recorder_continues_the_last_part_however_the_one_before_has_ended(tmp_path, end):
    end(part(parts_in(tmp_path), range(40)))
    place = parts_in(tmp_path, "s2")
    assert place.before == {STREAM: 40}
    part(place, [45]).finish()
    head = read_metadata(tmp_path / "r-2.mcap").metadata
    assert (head["session"], head["part"], head["continues"]) == ("s2", "1", "r.mcap")
    assert contents_of(tmp_path / "r-2.mcap").streams[STREAM].missing == 5


def test_another_recording_with_a_higher_number_does_not_hide_the_last_part(tmp_path):
    part(parts_in(tmp_path), range(40)).finish()
    write(tmp_path / "r-9.mcap", 3)
    place = parts_in(tmp_path, "s2")
    assert place.before == {STREAM: 40}
    part(place).finish()
    assert read_metadata(tmp_path / "r-10.mcap").metadata["continues"] == "r.mcap"


def damage_a_chunk(path: Path, number: int) -> None:
    chunk = [record for record in RecordReader(path) if record.opcode == Opcode.CHUNK][number]
    content = bytearray(path.read_bytes())
    content[(chunk.offset + chunk.end) // 2] ^= 0xFF
    path.write_bytes(content)


@pytest.mark.parametrize("content", [b"something else", bytes(5000), None])
def test_an_active_file_that_is_not_a_recording_or_of_which_nothing_is_intact_is_renamed(tmp_path, content):
    active = tmp_path / "r.mcap.active"
    kill_a_recorder(tmp_path / "r.mcap", flushed=5) if content is None else active.write_bytes(content)
    if content is None:
        damage_a_chunk(active, 0)
        content = active.read_bytes()
    place = parts_in(tmp_path)
    assert "cannot be repaired and was renamed to r.mcap.original: " in place.remarks[0]
    assert (tmp_path / "r.mcap.original").read_bytes() == content
    part(place).finish()
    assert names(tmp_path) == ["r-2.mcap", "r.mcap.original"]


def test_a_damaged_active_file_that_a_full_disk_keeps_from_being_repaired_is_continued(tmp_path):
    writer = part(parts_in(tmp_path), range(3000))
    writer.flush()
    killed(writer)
    damage_a_chunk(tmp_path / "r.mcap.active", 1)
    with disk_of(100):
        place = parts_in(tmp_path, "s2")
    assert f"refuses the repair of its recording, which stays {tmp_path / 'r.mcap.active'}" in place.remarks[0]
    assert place.before == {STREAM: 3000}
    part(place, [3000]).finish()
    assert read_metadata(tmp_path / "r-2.mcap").metadata["continues"] == "r.mcap"
    assert f"was repaired and is {tmp_path / 'r.mcap'}: " in parts_in(tmp_path, "s3").remarks[0]


def test_files_that_cannot_be_read_for_a_while_count_and_are_repaired_later(tmp_path, monkeypatch):
    part(parts_in(tmp_path), [0]).finish()
    kill_with_a_part_open(part(parts_in(tmp_path), [1]))
    with monkeypatch.context() as busy:
        busy.setattr(Path, "open", refuse)
        place = parts_in(tmp_path, "s2")
        assert place.stored().parts == ()
    (line,) = place.remarks
    assert f"which stays {tmp_path / 'r-2.mcap.active'}" in line
    assert [each.path.name for each in place.stored().parts] == ["r.mcap"] and place.stored().finished_bytes > 0
    assert f"was repaired and is {tmp_path / 'r-2.mcap'}: " in parts_in(tmp_path, "s3").remarks[0]


def test_recorders_killed_before_they_recorded_anything_do_not_hide_the_last_message(tmp_path):
    kill_a_recorder(tmp_path / "r.mcap", flushed=0)
    place = parts_in(tmp_path)
    assert (place.remarks, names(tmp_path)) == ([], [])
    first = part(place, range(40))
    first.flush()
    killed(first)
    for _ in range(3):
        killed(part(parts_in(tmp_path)))
    assert parts_in(tmp_path).before == {STREAM: 40}


def test_a_recording_that_is_being_written_is_not_touched(tmp_path):
    writer = part(parts_in(tmp_path), [0])
    with pytest.raises(RecordingError, match="r.mcap.active: another recorder is writing it; stop it"):
        parts_in(tmp_path)
    writer.finish()
    assert sequences(tmp_path / "r.mcap") == [0]


def test_a_folder_that_disappears_is_made_again(tmp_path):
    place = parts_in(tmp_path / "runs")
    (tmp_path / "runs").rmdir()
    assert place.free_bytes() > 0
    part(place, [0]).finish()
    assert names(tmp_path / "runs") == ["r.mcap"]

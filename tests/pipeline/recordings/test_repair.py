"""Repair: after truncation and damage every reader finds all intact chunks again."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.recordings.disk import AtomicAppendFile
from fantwin.pipeline.recordings.reading import RecordingError, read_metadata, read_recording
from fantwin.pipeline.recordings.repair import recover, repair_in_place
from fantwin.pipeline.recordings.scan import scan
from fantwin.pipeline.recordings.sequence_ledger import SequenceLedger, StreamCounts
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.health import Output
from fantwin.schemas.topics import health_key
from tests.support.failing_writers import disk_of
from tests.support.made_messages import health
from tests.support.written_recordings import ALARM_KEY, RAW_KEY, STREAM, chunk_ends, raw, read_by_others, small

NO_CHECK = [HealthCheck.function_scoped_fixture]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    return small(tmp_path_factory.mktemp("whole") / "r.mcap")


SIZE = 15_000
"""More than the file has: what is drawn beyond it is the whole file."""


@settings(max_examples=30, suppress_health_check=NO_CHECK)
@given(size=st.integers(0, SIZE))
def test_a_file_truncated_at_any_byte_is_recovered_up_to_its_last_intact_chunk_as_a_copy_and_in_place(
    tmp_path, whole, size
):
    content = whole.read_bytes()
    truncated, output, active = (tmp_path / name for name in ("truncated.mcap", "out.mcap", "a.mcap.active"))
    for path in tmp_path.iterdir():
        path.unlink()
    truncated.write_bytes(content[:size])
    active.write_bytes(content[:size])
    repaired = repair_in_place(active)
    assert not active.exists()
    expected = max((messages for end, messages in chunk_ends(whole) if end <= size), default=0)
    if not expected:
        with pytest.raises(RecordingError, match="nothing can be recovered|not a recording"):
            recover(truncated, output)
        assert repaired is None and not output.exists()
        return
    assert len(list(read_recording(truncated))) == expected
    recover(truncated, output)
    assert read_by_others(output) == read_by_others(whole)[:expected]
    assert read_metadata(output) == read_metadata(whole)
    assert scan(output).is_intact
    assert truncated.read_bytes() == content[:size]
    assert repaired is not None and repaired.path.name == "a.mcap"
    assert [each.payload for each in read_recording(repaired.path)] == [each.payload for each in read_recording(output)]
    assert read_metadata(repaired.path) == read_metadata(output)
    in_place, copy = contents_of(repaired.path), contents_of(output)
    assert (in_place.streams, in_place.recovered) == (copy.streams, copy.recovered)


def test_the_original_is_kept_beside_the_repaired_file_which_has_the_name_of_a_recording(tmp_path, whole):
    truncated = tmp_path / "r.mcap"
    before = whole.read_bytes()[:-300]
    for name in ("r.mcap.original", "r.mcap.original-2"):
        truncated.write_bytes(before)
        recovery = recover(truncated)
        assert (recovery.path, recovery.original) == (truncated, tmp_path / name)
        assert (tmp_path / name).read_bytes() == before
        assert len(read_by_others(truncated)) == 41
    (tmp_path / "r.mcap.active").write_bytes(before)
    assert recover(tmp_path / "r.mcap.active").path == tmp_path / "r-2.mcap"
    names = ["r-2.mcap", "r-2.mcap.original", "r.mcap", "r.mcap.original", "r.mcap.original-2"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names


@pytest.mark.parametrize("less", [0, 300])
@pytest.mark.parametrize("moment", range(6))
def test_a_kill_at_any_moment_leaves_the_recording_under_one_of_its_names(tmp_path, whole, monkeypatch, less, moment):
    active = tmp_path / "r.mcap.active"
    active.write_bytes(whole.read_bytes()[: whole.stat().st_size - less])
    done = 0

    def or_killed(action):
        def act(*args, **kwargs):
            nonlocal done
            if done == moment:
                raise KeyboardInterrupt
            done += 1
            return action(*args, **kwargs)

        return act

    for owner, name in ((os, "link"), (Path, "rename"), (Path, "replace"), (Path, "unlink")):
        monkeypatch.setattr(owner, name, or_killed(getattr(owner, name)))
    with suppress(KeyboardInterrupt):
        recover(active)
    monkeypatch.undo()
    found = [path for path in (tmp_path / "r.mcap", active) if path.exists()]
    assert found
    assert all(len(list(read_recording(path))) == 41 for path in found)


def test_an_intact_file_is_left_unchanged_or_copied(tmp_path, whole):
    path = tmp_path / "r.mcap"
    path.write_bytes(whole.read_bytes())
    inode = path.stat().st_ino
    assert recover(path).found.is_intact
    assert (path.stat().st_ino, sorted(p.name for p in tmp_path.iterdir())) == (inode, ["r.mcap"])
    recover(path, tmp_path / "copy.mcap")
    assert (tmp_path / "copy.mcap").read_bytes() == whole.read_bytes()


def test_the_ledger_of_a_file_that_lacks_only_its_index_is_kept_and_else_gaps_are_counted(tmp_path):
    with RecordingWriter(tmp_path / "r.mcap", {}) as writer:
        writer.add_message(RAW_KEY, raw(0), 1)
        writer.ledger.add_duplicated(*STREAM, 7)
    path = writer.path
    path.write_bytes(path.read_bytes()[:-40])
    found = recover(path).found
    assert found.is_ended
    assert contents_of(path).streams[STREAM].duplicated == 7
    writer = RecordingWriter(tmp_path / "killed.mcap", {})
    for sequence in (0, 1, 5):
        writer.add_message(RAW_KEY, raw(sequence), 1000 + sequence)
    writer.flush()
    writer._file.close()
    recovery = recover(tmp_path / "killed.mcap.active")
    assert contents_of(recovery.path).streams[STREAM] == StreamCounts(3, 3, 0, 0, 5, 1000, 1005)


@settings(max_examples=30, suppress_health_check=NO_CHECK)
@example(at=0.0, value=0)
@example(at=0.009765625, value=0)  # in the name of the format number
@given(at=st.floats(0, 1), value=st.integers(0, 255))
def test_a_changed_byte_costs_at_most_its_record(tmp_path, whole, at, value):
    content = bytearray(whole.read_bytes())
    ends = chunk_ends(whole)
    place = round(8 + at * (ends[-1][0] - 9))
    digit = content.index(b"format") + len("format") + 4
    assume(place != digit)  # a recording of another format is refused
    content[place] = value
    path, output = tmp_path / "r.mcap", tmp_path / "out.mcap"
    path.write_bytes(content)
    output.unlink(missing_ok=True)
    with suppress(RecordingError):  # its format may be unknown now
        assert len(list(read_recording(path))) <= 41
        read_metadata(path)
    recover(path, output)
    messages = read_by_others(output)
    assert len(messages) >= 41 - 6, "at most one chunk"
    assert scan(output).is_intact
    assert {name for name, _ in messages} <= {RAW_KEY, ALARM_KEY}


def test_a_damaged_metadata_record_is_left_out(tmp_path):
    path = tmp_path / "r.mcap"
    with RecordingWriter(path, {}, ledger=SequenceLedger({STREAM: 7})) as writer:
        writer.add_message(RAW_KEY, raw(7), 1000)
    content = path.read_bytes()
    path.write_bytes(content.replace(b"acquisition-1\x01\x00\x00\x007", b"acquisition-1\x01\x00\x00\x00x"))
    assert recover(path).found.damaged == {"records": 1}
    assert scan(path).is_intact
    assert len(read_by_others(path)) == 1


def test_a_repair_touches_no_file_that_exists_or_that_another_process_writes_or_repairs(tmp_path, whole):
    path = tmp_path / "r.mcap"
    path.write_bytes(whole.read_bytes()[:-300])
    other = AtomicAppendFile(tmp_path / "r.mcap.recovering")
    other.write(b"of the other")
    with pytest.raises(RecordingError, match="r.mcap is left as it was"):
        recover(path)
    assert (tmp_path / "r.mcap.recovering").read_bytes() == b"of the other"
    other.close()
    with pytest.raises(RecordingError, match=r"r\.mcap: exists; name another file with -o"):
        recover(whole, path)
    assert len(read_by_others(recover(path).path)) == 41
    with RecordingWriter(tmp_path / "open.mcap", {}) as writer:
        writer.add_message(RAW_KEY, raw(0), 0)
        writer.flush()
        with pytest.raises(RecordingError, match="a recorder is writing it; stop it first"):
            recover(tmp_path / "open.mcap.active")


@pytest.mark.parametrize("room", [0, 10_000])
def test_a_disk_that_fills_during_recovery_leaves_everything_as_it_was(tmp_path, whole, room):
    path = tmp_path / "r.mcap"
    truncated = whole.read_bytes()[:-300]
    path.write_bytes(truncated)
    with disk_of(room), pytest.raises(RecordingError, match="r.mcap is left as it was; make room"):
        recover(path)
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("r.mcap", truncated)]


def test_a_full_disk_costs_the_file_of_a_killed_recorder_only_its_index(tmp_path, whole):
    active = tmp_path / "r.mcap.active"
    active.write_bytes(whole.read_bytes()[: chunk_ends(whole)[4][0] + 100])
    with disk_of(active.stat().st_size):
        repaired = repair_in_place(active)
    assert repaired is not None
    assert len(list(read_recording(repaired.path))) == 26
    recover(repaired.path)
    assert len(read_by_others(repaired.path)) == 26


@pytest.mark.parametrize(
    ("chunked", "compression"),
    [(True, CompressionType.ZSTD), (True, CompressionType.LZ4), (True, CompressionType.NONE), (False, None)],
)
def test_a_truncated_file_from_another_writer_is_repaired_too(tmp_path, chunked, compression):
    path = tmp_path / "r.mcap"
    with path.open("wb") as file:
        writer = Writer(file, 200, compression or CompressionType.NONE, use_chunking=chunked)
        writer.start()
        schema = writer.register_schema("Pose", "jsonschema", b"{}")
        channel = writer.register_channel("/pose", "json", schema)
        for number in range(100):
            writer.add_message(channel, number, b'{"x": 1}', number)
        writer.finish()
    with path.open("rb") as file:
        all_of_it = [message.log_time for _, _, message in make_reader(file).iter_messages()]
    assert recover(path).found.is_intact
    path.write_bytes(path.read_bytes()[:3000])
    found = recover(path).found
    assert found.counts.others["/pose"].messages == found.messages > 20
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == found.messages
        assert [m.log_time for _, _, m in reader.iter_messages()] == all_of_it[: found.messages]


def test_what_a_killed_recorder_left_out_on_purpose_is_not_missing_in_the_repaired_file(tmp_path):
    metadata = {"site": "plant", "left_out": "grid,score"}
    writer = RecordingWriter(tmp_path / "r.mcap", metadata, ledger=SequenceLedger(left_out=("grid", "score")))
    keys = (RAW_KEY, RAW_KEY.replace("/raw", "/grid"))
    for number in range(2):
        outputs = tuple(Output(key=key, published=5 * number) for key in keys)
        message = health("acquisition", "tray1", "acquisition-1", number, outputs=outputs)
        writer.add_message(health_key("plant", "acquisition", "tray1"), message, number)
    writer.flush()
    killed = tmp_path / "killed.mcap"
    killed.write_bytes((tmp_path / "r.mcap.active").read_bytes())
    found = recover(killed).found
    assert found.counts.ledger.unrecorded() == {STREAM: 5}
    assert read_metadata(killed).left_out == ("grid", "score")

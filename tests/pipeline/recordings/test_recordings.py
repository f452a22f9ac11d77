"""Recordings: written messages are read back, by fantwin and by others, after crashes, full disks and damage too."""

import errno
import os
import resource
import signal
import subprocess
import sys
from contextlib import contextmanager
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.descriptor_pool import DescriptorPool
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC
from mcap_protobuf.decoder import DecoderFactory

from pipeline.recordings import writing
from pipeline.recordings.contents import contents_of
from pipeline.recordings.disk import AtomicAppendFile, DiskError
from pipeline.recordings.reading import RecordingError, read_metadata, read_recording
from pipeline.recordings.records import ACTIVE_SUFFIX
from pipeline.recordings.sequence_ledger import StreamCounts, counts_from_metadata
from pipeline.recordings.writing import CHUNK_BYTES, RecordingWriter
from schemas.envelope import Envelope
from schemas.messages import Alarm, Array, Command, Header, Message, Raw, Severity
from schemas.topics import tray_key

RAW_KEY = tray_key("plant", "tray1", "raw")
ALARM_KEY = tray_key("plant", "tray1", "alarm")


def noise(shape: tuple[int, ...], seed: int) -> Array:
    """Numbers that do not compress, so that sizes are as on a real disk."""
    return np.random.default_rng(seed).normal(size=shape)


def raw(sequence: int, samples: int = 10, fans: int = 2) -> Raw:
    return Raw(
        header=Header("acquisition-1", sequence, "tray1"),
        fans=fans,
        host_receive_t_ns=np.arange(samples) + sequence * samples,
        command=noise((samples, fans), sequence),
        speed_rad_s=noise((samples, fans), sequence + 1),
    )


def alarm(sequence: int) -> Alarm:
    return Alarm(
        header=Header("scorer-1", sequence, "tray1"),
        fan=1,
        active=True,
        severity=Severity.ALARM,
        t_ns=7,
        onset_t_ns=5,
        residual_rad_s=3.0,
        limit_rad_s=2.0,
        message="fan 1 is slower than its twin",
    )


def write(path: Path, messages: int, **options) -> Path:
    with RecordingWriter(path, {"site": "plant"}, {"configuration.toml": b"site = 'plant'"}, **options) as writer:
        for sequence in range(messages):
            writer.add_message(RAW_KEY, raw(sequence), 1000 + sequence)
        writer.add_message(ALARM_KEY, alarm(0), 5000)
    return writer.path


def sequences(path: Path) -> list[int]:
    return [envelope.message.header.sequence for envelope in read_recording(path, topics=("raw",))]


def test_messages_are_read_back_as_written_in_their_order(tmp_path):
    path = write(tmp_path / "r.mcap", 3)
    entries = list(read_recording(path))
    assert [(e.key, e.topic, e.received_t_ns) for e in entries] == [
        (RAW_KEY, "raw", 1000),
        (RAW_KEY, "raw", 1001),
        (RAW_KEY, "raw", 1002),
        (ALARM_KEY, "alarm", 5000),
    ]
    second = entries[1].message
    assert isinstance(second, Raw)
    assert second.header == Header("acquisition-1", 1, "tray1")
    np.testing.assert_array_equal(second.speed_rad_s, raw(1).speed_rad_s)
    assert entries[3].message.header.producer == "scorer-1"


def test_topics_can_be_chosen(tmp_path):
    path = write(tmp_path / "r.mcap", 3)
    assert [e.topic for e in read_recording(path, topics=("alarm",))] == ["alarm"]


def test_a_reading_can_be_iterated_again(tmp_path):
    reading = read_recording(write(tmp_path / "r.mcap", 3))
    assert len(list(reading)) == len(list(reading)) == 4
    assert reading.damage == ""


def test_metadata_and_attachments_are_read_back(tmp_path):
    head = read_metadata(write(tmp_path / "r.mcap", 0))
    assert head.metadata == {"site": "plant"}
    assert head.attachments == {"configuration.toml": b"site = 'plant'"}


def test_the_unit_of_speed_is_that_of_the_tray_or_of_the_recording_or_radians(tmp_path):
    path = tmp_path / "r.mcap"
    for metadata, unit in (
        ({}, "rad/s"),
        ({"speed_unit": "rpm"}, "rpm"),
        ({"speed_unit": "rpm", "speed_unit.tray1": "hz"}, "hz"),
    ):
        RecordingWriter(path, metadata, overwrite=True).finish()
        assert read_metadata(path).speed_unit("tray1") == unit


def test_other_readers_need_no_code_of_fantwin(tmp_path):
    path = write(tmp_path / "r.mcap", 5)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == 6
        assert {schema.name for schema in summary.schemas.values()} == {"fantwin.Raw", "fantwin.Alarm"}
        assert {channel.topic for channel in summary.channels.values()} == {RAW_KEY, ALARM_KEY}
        assert [a.name for a in reader.iter_attachments()] == ["configuration.toml"]
        assert {m.name: m.metadata for m in reader.iter_metadata()}["fantwin"] == {"site": "plant"}
        decoded = list(reader.iter_decoded_messages())
    _, channel, message, proto = decoded[2]
    assert (channel.message_encoding, message.log_time, message.sequence) == ("protobuf", 1002, 2)
    assert message.publish_time == proto.host_receive_t_ns[-1] == 29
    np.testing.assert_array_equal(proto.speed_rad_s, raw(2).speed_rad_s.ravel())


def test_the_embedded_schema_needs_no_other_file(tmp_path):
    from google.protobuf.descriptor_pb2 import FileDescriptorSet  # noqa: PLC0415

    path = write(tmp_path / "r.mcap", 1)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    files = FileDescriptorSet.FromString(next(iter(summary.schemas.values())).data)
    pool = DescriptorPool()
    for file_descriptor in files.file:
        pool.Add(file_descriptor)  # type: ignore[attr-defined]
    assert pool.FindMessageTypeByName("fantwin.Score").fields_by_name["band_variance"].number == 10


def test_a_recording_is_called_active_until_it_is_finished(tmp_path):
    path = tmp_path / "r.mcap"
    writer = RecordingWriter(path, {})
    assert [p.name for p in tmp_path.iterdir()] == ["r.mcap.active"]
    writer.finish()
    assert [p.name for p in tmp_path.iterdir()] == ["r.mcap"]


def test_closing_twice_is_closing_once(tmp_path):
    writer = RecordingWriter(tmp_path / "r.mcap", {})
    writer.finish()
    writer.finish()
    assert list(read_recording(writer.path)) == []


def test_a_finished_recording_is_never_overwritten_unasked(tmp_path):
    path = tmp_path / "r.mcap"
    assert [write(path, k).name for k in (1, 2, 3)] == ["r.mcap", "r-2.mcap", "r-3.mcap"]
    assert sequences(path) == [0]
    assert write(path, 5, overwrite=True) == path
    assert len(sequences(path)) == 5


def kill_a_recorder(path: Path, flushed: int) -> None:
    """Another process writes, flushes, and dies of kill -9 with unflushed messages."""
    program = f"""
import os, signal, sys
from pathlib import Path
from tests.pipeline.recordings.test_recordings import RAW_KEY, raw
from pipeline.recordings.writing import RecordingWriter
writer = RecordingWriter(Path(sys.argv[1]), {{}})
for sequence in range({flushed}):
    writer.add_message(RAW_KEY, raw(sequence), sequence)
writer.flush()
for sequence in range({flushed}, {flushed} + 3):
    writer.add_message(RAW_KEY, raw(sequence), sequence)
os.kill(os.getpid(), signal.SIGKILL)
"""
    child = subprocess.run([sys.executable, "-c", program, path], cwd=Path(__file__).parents[3], check=False)
    assert child.returncode == -signal.SIGKILL


def test_all_that_was_flushed_survives_kill_9(tmp_path):
    path = tmp_path / "r.mcap"
    kill_a_recorder(path, flushed=25)
    active = path.with_name(path.name + ACTIVE_SUFFIX)
    reading = read_recording(active)
    assert [e.message.header.sequence for e in reading] == list(range(25))
    assert reading.truncated
    assert "it is truncated" in reading.damage


def test_a_recording_that_is_being_written_is_not_touched(tmp_path):
    path = tmp_path / "r.mcap"
    with RecordingWriter(path, {}) as first:
        first.add_message(RAW_KEY, raw(0), 0)
        with pytest.raises(RecordingError, match="another recorder is writing it"):
            RecordingWriter(path, {})
    assert sequences(path) == [0]


def test_an_exception_while_writing_leaves_no_file(tmp_path):
    with pytest.raises(ZeroDivisionError), RecordingWriter(tmp_path / "r.mcap", {}) as writer:
        writer.add_message(RAW_KEY, raw(0), 0)
        raise ZeroDivisionError
    assert list(tmp_path.iterdir()) == []


def test_messages_counted_as_written_are_in_the_file(tmp_path):
    writer = RecordingWriter(tmp_path / "r.mcap", {})
    active = tmp_path / f"r.mcap{ACTIVE_SUFFIX}"
    for sequence in range(600):
        writer.add_message(RAW_KEY, raw(sequence), sequence)
        if sequence % 50 == 0:
            assert len(sequences(active)) >= writer.written["raw"]
            assert writer.written["raw"] + len(writer.pending) == sequence + 1
    writer.flush()
    assert (writer.written["raw"], len(writer.pending)) == (600, 0)
    writer.finish()


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
    with (tmp_path / "r.mcap").open("rb") as file:
        assert (make_reader(file).get_summary() is None) == for_ever
    assert (tmp_path / "r.mcap").read_bytes().count(MCAP0_MAGIC) == 2, "one beginning, one end"


def test_a_writer_that_is_never_flushed_uses_bounded_memory(tmp_path, monkeypatch):
    monkeypatch.setattr(writing, "UNSYNCED_BYTES", 2 * CHUNK_BYTES)
    with RecordingWriter(tmp_path / "r.mcap", {}) as writer:
        for sequence in range(2000):
            writer.add_message(RAW_KEY, raw(sequence), sequence)
            assert sum(len(pending.payload) for pending in writer.pending) < 4 * CHUNK_BYTES


def test_a_write_that_the_disk_refuses_leaves_the_file_as_it_was(tmp_path):
    file = AtomicAppendFile(tmp_path / "file")
    with disk_of(1000):
        file.write(b"a" * 900)
        with pytest.raises(OSError, match="File too large"):
            file.write(b"b" * 900)
        file.write(b"c" * 50)
    file.close()
    assert (tmp_path / "file").read_bytes() == b"a" * 900 + b"c" * 50


@contextmanager
def disk_of(size: int):
    """Files of this process cannot grow beyond `size` bytes: the system writes a part, then refuses."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("size", [3 * CHUNK_BYTES, 3 * CHUNK_BYTES + 1234, 200_000])
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
        messages = list(make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages())
    assert len(messages) == writer.written["raw"]


def test_without_room_for_an_index_the_file_is_still_readable(tmp_path):
    path = tmp_path / "r.mcap"
    writer = RecordingWriter(path, {})
    with pytest.raises(RecordingError, match="it ends here and is readable"):
        for sequence in count():
            writer.add_message(RAW_KEY, raw(sequence), sequence)
            if writer.written["raw"] > 500:
                resource.setrlimit(resource.RLIMIT_FSIZE, (writer.size + 100, resource.RLIM_INFINITY))
    resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    reading = read_recording(path)
    assert [e.message.header.sequence for e in reading] == list(range(writer.written["raw"]))
    assert reading.damage == ""
    with path.open("rb") as file:
        assert make_reader(file).get_summary() is None


def test_the_ledger_is_in_the_file(tmp_path):
    path = tmp_path / "r.mcap"
    with RecordingWriter(path, {}) as writer:
        for sequence in (3, 4, 7):
            writer.add_message(RAW_KEY, raw(sequence), 1000 + sequence)
    with path.open("rb") as file:
        records = {record.name: record.metadata for record in make_reader(file).iter_metadata()}
    assert counts_from_metadata(records["fantwin.ledger"]) == {
        (RAW_KEY, "acquisition-1"): StreamCounts(
            3, 2, 0, first_sequence=3, last_sequence=7, first_ns=1003, last_ns=1007
        )
    }


def test_a_ledger_that_is_refused_at_first_is_in_the_index_once(tmp_path, monkeypatch):
    writer = RecordingWriter(tmp_path / "r.mcap", {})
    writer.add_message(RAW_KEY, raw(0), 0)
    writer.flush()
    write_whole, refusals = AtomicAppendFile.write, iter([OSError(errno.ENOSPC, "No space left on device")])

    def refuse_once(file: AtomicAppendFile, data: bytes) -> None:
        for error in refusals:
            raise error
        write_whole(file, data)

    monkeypatch.setattr(AtomicAppendFile, "write", refuse_once)
    with pytest.raises(DiskError):
        writer.finish()
    with (tmp_path / "r.mcap").open("rb") as file:
        names = [record.name for record in make_reader(file).iter_metadata()]
    assert names == ["fantwin", "fantwin.ledger"]


def test_a_disk_that_is_full_from_the_start_is_reported_in_one_line(tmp_path):
    with disk_of(20), pytest.raises(RecordingError, match=r"r\.mcap: cannot be written: File too large; name another"):
        RecordingWriter(tmp_path / "r.mcap", {})
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_refuses_even_to_remove_the_unfinished_file_raises_the_first_error(tmp_path, monkeypatch):
    def read_only(*_: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(AtomicAppendFile, "write", read_only)
    monkeypatch.setattr(Path, "unlink", read_only)
    with pytest.raises(DiskError, match="r.mcap: cannot be written: Read-only file system"):
        RecordingWriter(tmp_path / "r.mcap", {})


def test_a_folder_that_cannot_be_made_is_reported_in_one_line(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(RecordingError, match=r"cannot be written: (Not a directory|File exists)"):
        RecordingWriter(tmp_path / "file" / "r.mcap", {})


def test_a_truncated_file_is_read_up_to_its_end(tmp_path):
    whole = write(tmp_path / "whole.mcap", 500).read_bytes()
    truncated = tmp_path / "truncated.mcap"
    found = []
    for size in range(8, len(whole), len(whole) // 40):
        truncated.write_bytes(whole[:size])
        reading = read_recording(truncated)
        found.append(len([e.message.header.sequence for e in reading]))
        assert reading.truncated
    assert found == sorted(found)
    assert found[0] == 0
    assert found[-1] >= 400


def test_a_damaged_chunk_is_left_out_and_the_rest_is_read(tmp_path):
    path = write(tmp_path / "r.mcap", 600)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    reading = read_recording(path)
    read = [e.message.header.sequence for e in reading if e.topic == "raw"]
    assert 0 < len(read) < 600
    assert (read[0], read[-1]) == (0, 599)
    assert reading.damaged_chunks == 1
    assert "damaged chunks left out: 1" in reading.damage


@settings(deadline=None, max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_changed_bytes_anywhere_never_make_a_reader_crash(tmp_path, data):
    path = tmp_path / "r.mcap"
    if not path.exists():
        write(path, 300)
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(8, len(content) - 1))] = data.draw(st.integers(0, 255))
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(content)
    assert len(list(read_recording(broken))) <= 301
    read_metadata(broken)


def test_channels_of_other_programs_are_skipped(tmp_path):
    from mcap.writer import Writer  # noqa: PLC0415

    path = tmp_path / "foreign.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/camera", "json", 0)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    assert list(read_recording(path)) == []


def test_a_payload_that_cannot_be_decoded_is_skipped_and_counted(tmp_path):
    with RecordingWriter(tmp_path / "r.mcap", {}) as writer:
        writer.add(Envelope(RAW_KEY, "raw", b"\xff\xff\xff", 0, raw(0)))
        writer.add_message(RAW_KEY, raw(1), 1)
    reading = read_recording(writer.path)
    assert [e.message.header.sequence for e in reading] == [1]
    assert "messages left out that cannot be decoded: 1" in reading.damage


@pytest.mark.parametrize("content", [b"", b"t,u,y\n0,1,2\n", bytes(100)])
def test_a_file_that_is_no_recording_is_reported_in_one_line(tmp_path, content):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    for read in (read_recording, read_metadata):
        with pytest.raises(RecordingError, match=r"x\.mcap: not a recording"):
            read(path)


def test_a_missing_file_is_reported_in_one_line(tmp_path):
    with pytest.raises(RecordingError, match=r"r\.mcap: cannot read the recording: No such file"):
        read_recording(tmp_path / "r.mcap")


def test_every_key_gets_its_own_channel(tmp_path):
    keys = [tray_key("plant", "a", "command"), tray_key("plant", "b", "command")]
    with RecordingWriter(tmp_path / "r.mcap", {}) as writer:
        for key in keys:
            message: Message = Command(fans=1, t_ns=1, command=np.ones(1), set_point_rad_s=np.ones(1))
            writer.add_message(key, message, 1)
    assert [e.key for e in read_recording(writer.path)] == keys
    with writer.path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert (len(summary.channels), len(summary.schemas)) == (2, 1)


def test_a_message_on_which_the_writer_crashes_is_not_counted_as_recorded(tmp_path, monkeypatch):
    def fails(_message: Message) -> int:
        raise ZeroDivisionError("on purpose")

    writer = RecordingWriter(tmp_path / "r.mcap", {})
    writer.add_message(RAW_KEY, raw(0), 1000)
    with monkeypatch.context() as patch:
        patch.setattr(writing, "newest_t_ns", fails)
        with pytest.raises(ZeroDivisionError):
            writer.add_message(RAW_KEY, raw(1), 1001)
    writer.finish()
    assert writer.written == {"raw": 1}
    assert [counts.messages for counts in contents_of(writer.path).streams.values()] == [1]
    assert len(list(read_recording(writer.path))) == 1

"""Recordings: written messages are read back, by fantwin and by others, whole or the few of a topic."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from mcap.opcode import Opcode
from mcap.records import ChunkIndex
from mcap.writer import Writer

from fantwin.pipeline.recordings import indexed
from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.recordings.indexed import last_message_ns, last_messages, rare_messages
from fantwin.pipeline.recordings.reading import RecordingError, read_metadata, read_recording
from fantwin.pipeline.recordings.records import RecordReader
from fantwin.pipeline.recordings.scan import scan
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.codec import decode
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import ModelCard, Raw
from fantwin.schemas.topics import tray_key
from tests.support.replay_data import START_NS, STEP_NS, raw_of
from tests.support.written_recordings import ALARM_KEY, RAW_KEY, raw, sequences, write


def test_messages_metadata_and_attachments_are_read_back_as_written_each_time_they_are_read(tmp_path):
    path = write(tmp_path / "r.mcap", 3)
    reading = read_recording(path)
    entries = list(reading)
    assert len(list(reading)) == len(entries) and reading.damage == ""
    assert [e.topic for e in read_recording(path, topics=("alarm",))] == ["alarm"]
    head = read_metadata(path)
    assert head.metadata == {"site": "plant", "format": "3", "made_by": f"fantwin {version('fantwin')}"}
    assert head.attachments == {"configuration.toml": b"site = 'plant'"}
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


def test_the_unit_of_speed_is_that_of_the_tray_or_of_the_recording_or_radians(tmp_path):
    path = tmp_path / "r.mcap"
    for metadata, unit in (
        ({}, "rad/s"),
        ({"speed_unit": "rpm"}, "rpm"),
        ({"speed_unit": "rpm", "speed_unit.tray1": "hz"}, "hz"),
    ):
        RecordingWriter(path, metadata, overwrite=True).finish()
        assert read_metadata(path).speed_unit("tray1") == unit


def by_another_writer(path: Path, **metadata: str) -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        if metadata:
            writer.add_metadata("fantwin", {"made_by": "another\n" * 100, **metadata})
        writer.add_message(writer.register_channel("/camera", "json", 0), 1, b"{}", 1)
        writer.finish()
    return path


@pytest.mark.parametrize(
    "read",
    [
        read_metadata,
        read_recording,
        contents_of,
        last_message_ns,
        lambda path: rare_messages(path, "alarm"),
        lambda path: last_messages(path, "alarm"),
    ],
)
def test_a_recording_of_another_format_is_refused_in_one_short_line_however_it_is_read(tmp_path, read):
    for number, words in (
        ({"format": "4"}, "a recording of format 4; this fantwin reads format 3: update fantwin"),
        ({"of": "before formats had numbers"}, "a recording without a format number; "),
        *(({"format": each}, "a recording of format '") for each in ("9" * 5000, "x" * 200_000, "\u0661", "1\n")),
    ):
        path = by_another_writer(tmp_path / "r.mcap", **number)
        with pytest.raises(RecordingError, match=rf"r\.mcap: {words}.*\(made by ano") as refused:
            read(path)
        assert len(str(refused.value)) < 300 + len(str(tmp_path)) and str(refused.value).isprintable()


def test_a_repair_refuses_a_later_format_and_takes_what_is_no_number_for_damage(tmp_path):
    with pytest.raises(RecordingError, match="a recording of format 4; this fantwin reads format 3: update fantwin"):
        scan(by_another_writer(tmp_path / "r.mcap", format="4"))
    assert scan(by_another_writer(tmp_path / "r.mcap", format="x"))


def test_a_file_of_another_program_has_no_messages(tmp_path):
    assert list(read_recording(by_another_writer(tmp_path / "foreign.mcap"))) == []


def test_a_finished_recording_is_never_overwritten_unasked(tmp_path):
    path = tmp_path / "r.mcap"
    assert [write(path, k).name for k in (1, 2, 3)] == ["r.mcap", "r-2.mcap", "r-3.mcap"]
    assert sequences(path) == [0]
    assert write(path, 5, overwrite=True) == path
    assert len(sequences(path)) == 5


def test_a_payload_that_cannot_be_decoded_is_skipped_and_counted(tmp_path):
    with RecordingWriter(tmp_path / "r.mcap", {}) as writer:
        writer.add(Envelope(RAW_KEY, "raw", b"\xff\xff\xff", 0, raw(0)))
        writer.add_message(RAW_KEY, raw(1), 1)
    reading = read_recording(writer.path)
    assert [e.message.header.sequence for e in reading] == [1]
    assert "messages left out that cannot be decoded: 1" in reading.damage


@pytest.mark.parametrize("content", [b"", b"t,u,y\n0,1,2\n", bytes(100)])
def test_a_file_that_is_no_recording_or_is_not_there_is_reported_in_one_line(tmp_path, content):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    of_alarms = (lambda path: rare_messages(path, "alarm"), lambda path: last_messages(path, "alarm"))
    for read in (read_recording, read_metadata, *of_alarms):
        with pytest.raises(RecordingError, match=r"x\.mcap: not a recording"):
            read(path)
    with pytest.raises(RecordingError, match=r"r\.mcap: cannot read the recording: No such file"):
        read_recording(tmp_path / "r.mcap")


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

"""Recordings: written messages are read back, by fantwin and by others, after damage too."""

from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer

from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.recordings.indexed import last_message_ns, last_messages, rare_messages
from fantwin.pipeline.recordings.reading import RecordingError, read_metadata, read_recording
from fantwin.pipeline.recordings.scan import scan
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Raw
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

"""The recorder stage: everything of the table is kept, and a disk that refuses is told and counted."""

import json
import logging
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.config import TrayConfig
from pipeline.recordings.reading import RecordingError, read_head, read_recording
from pipeline.recordings.writing import RecordingWriter
from pipeline.stage import Context, Packet, StageError
from schemas.codec import encode
from schemas.messages import Header, Message, Raw
from schemas.topics import TOPICS, health_key, tray_key
from stages.recorder import STAGE, Recorder, RecorderConfig
from tests.message_strategies import any_message, same

SECOND_NS = 1_000_000_000


def context(folder: Path, tray: TrayConfig | None = None, **config) -> Context:
    return Context(
        site="plant",
        trays=(tray or TrayConfig(name="tray1", fans=2, speed_unit="rpm"),),
        config=RecorderConfig(**config),
        folder=folder,
        run_folder=folder / "runs",
        started_t_ns=1_800_000_000_250_000_000,
        configuration_text="site = 'plant'\n",
    )


def packet(message: Message, topic: str, received_t_ns: int = 5) -> Packet:
    key = health_key("plant", "scorer", "all") if topic == "health" else tray_key("plant", "tray1", topic)
    return Packet(key, topic, encode(message), received_t_ns, message)


def raw(sequence: int) -> Raw:
    return Raw(
        header=Header("acquisition-1", sequence, "tray1"),
        fans=2,
        host_receive_t_ns=np.array([sequence]),
        command=np.ones((1, 2)),
        speed_rad_s=np.ones((1, 2)),
    )


class Disk:
    """A stand-in for a recording whose disk refuses after `room` messages. `flush` puts them in the file for good."""

    def __init__(self, room: int) -> None:
        self.room = room
        self.written: Counter[str] = Counter()
        self.pending: Counter[str] = Counter()
        self.flushes = 0
        self.closed = False

    def write(self, key: str, payload: bytes, message: Message, log_time_ns: int) -> None:
        assert key and payload and log_time_ns
        self.pending["raw"] += 1
        self._refuse_if_full()

    def flush(self) -> None:
        self._refuse_if_full()
        self.written += self.pending
        self.pending.clear()
        self.flushes += 1

    def close(self) -> None:
        self.flush()
        self.closed = True

    def _refuse_if_full(self) -> None:
        if self.written.total() + self.pending.total() > self.room:
            raise RecordingError("r.mcap: cannot be written any more: No space left on device")


@settings(deadline=None, max_examples=25)
@given(st.tuples(*(any_message(topic.message) for topic in TOPICS)))
def test_every_topic_of_the_table_is_recorded_as_it_came(tmp_path_factory, messages):
    run = context(tmp_path_factory.mktemp("recorder"))
    core = STAGE.build(run).core
    packets = [packet(m, topic.name, k + 1) for k, (m, topic) in enumerate(zip(messages, TOPICS, strict=True))]
    for item in packets:
        assert list(core.step(item)) == []
    core.close()
    entries = list(read_recording(run.run_folder / "recording.mcap"))
    assert [(e.key, e.topic, e.log_time_ns) for e in entries] == [(p.key, p.topic, p.received_t_ns) for p in packets]
    for entry, item in zip(entries, packets, strict=True):
        assert same(encode(entry.message), item.payload)
    assert core.counters() == {f"recorded_{topic.name}": 1 for topic in TOPICS} | {"lost_unwritten": 0}


def test_it_keeps_what_was_set_on_the_command_line(tmp_path):
    STAGE.build(replace(context(tmp_path), overrides=("scorer.on_delay_s=1",))).core.close()
    head = read_head(tmp_path / "runs" / "recording.mcap")
    assert json.loads(head.metadata["overrides"]) == ["scorer.on_delay_s=1"]


def test_it_keeps_the_configuration_and_the_twin(tmp_path):
    (tmp_path / "twin.onnx").write_bytes(b"the twin")
    tray = TrayConfig(name="tray1", fans=2, speed_unit="rpm", twin=Path("twin.onnx"))
    STAGE.build(context(tmp_path, tray)).core.close()
    head = read_head(tmp_path / "runs" / "recording.mcap")
    assert head.attachments == {"configuration.toml": b"site = 'plant'\n", "tray1.onnx": b"the twin"}
    assert head.speed_unit("tray1") == "rpm"
    assert head.metadata["site"] == "plant"
    assert head.metadata["trays"] == "tray1"
    assert head.metadata["fans.tray1"] == "2"
    assert head.metadata["started"] == "2027-01-15T08:00:00.250+00:00"
    assert head.metadata["started_t_ns"] == "1800000000250000000"
    assert len(head.metadata["twin_sha256.tray1"]) == 64


def test_a_twin_that_cannot_be_read_does_not_keep_it_from_recording(tmp_path, caplog):
    tray = TrayConfig(name="tray1", fans=2, twin=Path("nowhere.onnx"))
    with caplog.at_level(logging.WARNING):
        STAGE.build(context(tmp_path, tray)).core.close()
    assert "nowhere.onnx: the twin is not in the recording: No such file" in caplog.text


def test_it_says_under_which_name_the_recording_of_a_killed_recorder_is_kept(tmp_path, caplog):
    run = context(tmp_path)
    with RecordingWriter(run.run_folder / "recording.mcap", {}) as writer:
        writer.write_message(tray_key("plant", "tray1", "raw"), raw(0), 1)
    writer.path.rename(run.run_folder / "recording.mcap.active")
    with caplog.at_level(logging.WARNING):
        STAGE.build(run).core.close()
    assert "a recorder had been killed; what it has recorded is kept as" in caplog.text
    assert sorted(p.name for p in run.run_folder.iterdir()) == ["recording-2.mcap", "recording.mcap"]


def test_a_place_that_cannot_be_written_is_told_in_one_line_at_the_start(tmp_path):
    (tmp_path / "runs").touch()
    with pytest.raises(StageError, match=r"recording\.mcap: cannot be written: .*; name another .*\(recorder\.file\)"):
        STAGE.build(context(tmp_path))


def test_the_file_can_be_named(tmp_path):
    STAGE.build(context(tmp_path, file=Path("today") / "a.mcap")).core.close()
    assert (tmp_path / "runs" / "today" / "a.mcap").exists()


def test_it_flushes_when_the_interval_has_passed():
    disk = Disk(room=100)
    core = Recorder(disk, flush_interval_s=1.0)
    for tick in range(41):
        core.tick(10 * SECOND_NS + tick * SECOND_NS // 20)
    assert disk.flushes == 3


def test_a_disk_that_refuses_is_told_and_everything_unwritten_is_counted():
    disk = Disk(room=7)
    core = Recorder(disk, flush_interval_s=1.0)
    for sequence in range(5):
        core.step(packet(raw(sequence), "raw"))
    core.tick(10 * SECOND_NS)
    assert core.problem() == ""
    for sequence in range(5, 20):
        core.step(packet(raw(sequence), "raw"))
    assert core.problem().startswith("NOTHING IS RECORDED: r.mcap: cannot be written any more: No space left")
    assert core.counters() == {"recorded_raw": 5, "lost_unwritten": 15}


def test_after_the_disk_has_refused_nothing_touches_the_file_again():
    disk = Disk(room=0)
    core = Recorder(disk, flush_interval_s=1.0)
    core.step(packet(raw(0), "raw"))
    disk.room = 1000
    core.step(packet(raw(1), "raw"))
    core.tick(10 * SECOND_NS)
    core.close()
    assert (disk.flushes, disk.closed) == (0, False)
    assert core.counters() == {"lost_unwritten": 2}


def test_a_disk_that_refuses_the_last_chunk_is_counted_too():
    disk = Disk(room=3)
    core = Recorder(disk, flush_interval_s=1.0)
    for sequence in range(3):
        core.step(packet(raw(sequence), "raw"))
    disk.room = 2
    core.close()
    assert core.counters() == {"lost_unwritten": 3}
    assert core.problem()

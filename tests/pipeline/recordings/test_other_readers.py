"""Recordings in other readers: intact ones with index and summary, truncated ones as far as each reader goes."""

import shutil
import struct
import subprocess
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader

from fantwin.pipeline.recordings.records import ACTIVE_SUFFIX
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Command, Message, Raw, Score
from tests.support.score_data import made_up_tray
from tests.support.small_recordings import alarm, key_of, raw

METADATA = {"site": "plant", "trays": "tray1", "speed_unit": "rpm"}
ATTACHMENTS = {"configuration.toml": b"site = 'plant'\n", "tray1.onnx": bytes(range(256)) * 40}
START_NS = 1_700_000_000_000_000_000
SCORE = "fantwin/plant/tray1/score"
RAWS = 400

RERUN = shutil.which("rerun", path=Path(sys.executable).parent)
needs_rerun = pytest.mark.skipif(RERUN is None, reason="the extra `view` is not installed")


@dataclass(frozen=True)
class Files:
    """An intact recording, the file a killed recorder left of it, and the messages of each key in both."""

    whole: Path
    truncated: Path
    in_whole: Counter[str]
    in_truncated: Counter[str]


def messages() -> list[Message]:
    scores, _ = made_up_tray(seconds=2, gap_s=(1.0, 1.5))
    command = Command(header=Header("c", 0, "tray1"), fans=2, t_ns=5, command=np.array([0.5, np.nan]))
    return [command, *(raw(n) for n in range(RAWS)), *scores, alarm(0), alarm(1)]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    folder = tmp_path_factory.mktemp("recordings")
    sent = messages()
    keys = [key_of(message) for message in sent]
    with RecordingWriter(folder / "whole.mcap", METADATA, ATTACHMENTS, t_ns=START_NS) as writer:
        for number, message in enumerate(sent):
            writer.add_message(keys[number], message, START_NS + number)
    with pytest.raises(KeyboardInterrupt), RecordingWriter(folder / "r.mcap", METADATA, ATTACHMENTS) as writer:
        for number, message in enumerate(sent):
            writer.add_message(keys[number], message, START_NS + number)
            if number == RAWS + 10:
                writer.flush()
            if number == RAWS + 15:  # what is on the disk at this moment is what a kill -9 would leave
                shutil.copy(folder / f"r.mcap{ACTIVE_SUFFIX}", folder / "truncated.mcap")
                raise KeyboardInterrupt
    return Files(folder / "whole.mcap", folder / "truncated.mcap", Counter(keys), Counter(keys[: RAWS + 11]))


def run(*words: object, code: int = 0) -> str:
    done = subprocess.run([str(word) for word in words], capture_output=True, text=True, check=False)
    assert done.returncode == code, done.stderr
    return done.stdout


# ---- the mcap library for Python


def test_mcap_finds_index_statistics_attachments_and_metadata_and_a_stretch_of_one_topic(files):
    with files.whole.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        topics = {channel.id: channel.topic for channel in summary.channels.values()}
        counts = {topics[number]: count for number, count in summary.statistics.channel_message_counts.items()}
        assert counts == files.in_whole
        assert summary.statistics.message_start_time == START_NS
        assert summary.statistics.message_end_time == START_NS + files.in_whole.total() - 1
        assert summary.statistics.chunk_count == len(summary.chunk_indexes) > 1
        assert all(index.compression == "zstd" for index in summary.chunk_indexes)
        assert {a.name: a.data for a in reader.iter_attachments()} == ATTACHMENTS
        assert {m.name: m.metadata for m in reader.iter_metadata()}["fantwin"].items() >= METADATA.items()
        assert {schema.encoding for schema in summary.schemas.values()} == {"protobuf"}
        assert len(summary.channels) == len(files.in_whole) == len(summary.schemas), "a channel for each key"
        first, last = START_NS + RAWS - 5, START_NS + RAWS + 5
        found = list(reader.iter_messages(topics=[SCORE], starting_at=first, ending_before=last))
    assert [message.log_time - START_NS for _, _, message in found] == [RAWS + 1, RAWS + 2, RAWS + 3, RAWS + 4]
    assert {channel.topic for _, channel, _ in found} == {SCORE}
    scores = [message for message in messages() if isinstance(message, Score)]
    assert [message.publish_time for _, _, message in found] == [score.t_ns[-1] for score in scores[:4]]
    with files.whole.open("rb") as file:
        records = Counter(type(record).__name__ for record in StreamReader(file, validate_crcs=True).records)
    assert records[McapMessage.__name__] == files.in_whole.total()


def test_mcap_reads_all_that_reached_the_disk_of_a_truncated_file_and_then_raises(files):
    found: Counter[str] = Counter()
    with files.truncated.open("rb") as file, pytest.raises((McapError, struct.error)):
        for _, channel, _ in NonSeekingReader(file).iter_messages(log_time_order=False):
            found[channel.topic] += 1
    assert found == files.in_truncated
    with files.truncated.open("rb") as file, pytest.raises(McapError):
        make_reader(file).get_summary()


# ---- Rerun


def rerun_rows(path: Path) -> dict[str, list[dict[str, Any]]]:
    """The messages in a file of Rerun's, by entity, as structures."""
    from rerun.chunk import RrdReader  # noqa: PLC0415  the extra `view` may not be installed

    found: dict[str, list[dict[str, Any]]] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.startswith("fantwin.") and name.endswith(":message"):
                found.setdefault(chunk.entity_path, []).extend(row[0] for row in batch.column(name).to_pylist())
    return found


@needs_rerun
def test_rerun_reads_every_message_with_its_fields(files, tmp_path):
    run(RERUN, "mcap", "convert", files.whole, "--application-id", "fantwin", "-o", tmp_path / "r.rrd")
    found = rerun_rows(tmp_path / "r.rrd")
    assert {entity: len(rows) for entity, rows in found.items()} == {f"/{k}": n for k, n in files.in_whole.items()}
    raws = sorted(found["/fantwin/plant/tray1/raw"], key=lambda row: row["header"]["sequence"])
    for row, message in zip(raws, (m for m in messages() if isinstance(m, Raw)), strict=True):
        assert row["host_receive_t_ns"] == message.host_receive_t_ns.tolist()
        assert row["speed_rad_s"] == message.speed_rad_s.ravel().tolist()
    alarms = [message for message in messages() if isinstance(message, Alarm)]
    assert [row["message"] for row in found["/fantwin/plant/tray1/alarm"]] == [alarm.message for alarm in alarms]
    states = {state["name"] for row in found[f"/{SCORE}"] for state in row["state"]}
    assert {"FAN_STATE_NORMAL", "FAN_STATE_UNKNOWN"} <= states


@needs_rerun
def test_rerun_recovers_from_a_truncated_file_what_reached_the_disk(files, tmp_path):
    assert "PROBLEM" not in run(RERUN, "mcap", "check", "--recover", files.truncated)
    run(RERUN, "mcap", "convert", "--recover", files.truncated, "--application-id", "fantwin", "-o", tmp_path / "r.rrd")
    found = rerun_rows(tmp_path / "r.rrd")
    assert {entity: len(rows) for entity, rows in found.items()} == {f"/{k}": n for k, n in files.in_truncated.items()}

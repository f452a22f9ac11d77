"""Playback of recordings: parts in order, each message once, and a time range."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import ChunkIndex

from fantwin.pipeline.recordings.reading import RecordingError
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.replay.live.recording_playback import RecordingPlayback
from fantwin.schemas.header import Header
from fantwin.schemas.messages import ModelCard
from fantwin.schemas.topics import tray_key
from tests.support.replay_data import START_NS, STEP_NS, raw_of, write_raw

RAW = tray_key("demo", "tray1", "raw")


def part(path: Path, sequences: range, log_s: float = 0.0, **metadata: str) -> Path:
    with RecordingWriter(path, {"trays": "tray1", **metadata}) as writer:
        for sequence in sequences:
            writer.add_message(RAW, raw_of(sequence, 1), START_NS + round(log_s * 1e9) + sequence * STEP_NS)
    return path


def sequences(entries) -> list[int]:
    return [entry.message.header.sequence for entry in entries]


def test_parts_are_played_in_order_of_time_and_messages_in_two_parts_only_once(tmp_path):
    parts = [part(tmp_path / "z.mcap", range(20)), part(tmp_path / "b.mcap", range(15, 40), 1.0)]
    parts.append(part(tmp_path / "a.mcap", range(40, 50), 2.0))
    random.Random(3).shuffle(parts)
    playback = RecordingPlayback([*parts, parts[0]], ("raw",))
    assert [file.name for file in playback.files] == ["z.mcap", "b.mcap", "a.mcap"]
    assert sequences(playback) == list(range(50))
    assert sequences(playback) == list(range(50)), "a second time it is the same"


def test_parts_of_a_session_keep_their_order_where_the_hosts_clock_was_set_back(tmp_path):
    first = part(tmp_path / "r.mcap", range(50), 100.0, session="s", part="1")
    second = part(tmp_path / "r-2.mcap", range(50, 100), 0.0, session="s", part="2")
    playback = RecordingPlayback([second, first], ("raw",))
    assert sequences(playback) == list(range(100))


def test_a_message_that_was_fetched_later_does_not_end_a_stretch(tmp_path):
    path = tmp_path / "r.mcap"
    with RecordingWriter(path, {"trays": "tray1"}) as writer:
        for sequence, log_s in enumerate((0, 1, 2, 9, 9, 9, 3, 4, 5, 30)):
            writer.add_message(RAW, raw_of(sequence, 1), START_NS + log_s * 10**9)
    assert sequences(RecordingPlayback([path], ("raw",), 0.0, 6.0)) == [0, 1, 2, 6, 7, 8]


def test_a_stretch_begins_and_ends_in_seconds_since_the_first_message(tmp_path):
    playback = RecordingPlayback([write_raw(tmp_path / "r.mcap", 500)], ("raw",), 1.0, 2.5)
    assert sequences(playback) == list(range(100, 251))
    assert playback.end_s() == 2.5
    assert RecordingPlayback([tmp_path / "r.mcap"], ("raw",)).end_s() == pytest.approx(4.99)


def test_a_time_range_starts_with_the_card_of_the_twin_then_in_force(tmp_path):
    with RecordingWriter(tmp_path / "r.mcap", {"trays": "tray1"}) as writer:
        for number in range(2):
            card = ModelCard(
                header=Header("t", number, "tray1"), t_ns=0, twin=f"twin{number}", kind="hybrid", sha256=""
            )
            writer.add_message(tray_key("demo", "tray1", "twin"), card, START_NS + number)
        for sample in range(300):
            writer.add_message(RAW, raw_of(sample, 1), START_NS + sample * STEP_NS)
    first, second, *_ = RecordingPlayback([tmp_path / "r.mcap"], ("raw", "twin"), 1.0)
    assert isinstance(first.message, ModelCard)
    assert first.message.twin == "twin1"
    assert first.received_t_ns == START_NS + 10**9
    assert second.message.header.sequence == 100


def test_a_truncated_part_is_played_as_far_as_it_can_be_read_and_reported(tmp_path):
    whole = write_raw(tmp_path / "whole.mcap", 3000)
    truncated = tmp_path / "truncated.mcap"
    truncated.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    playback = RecordingPlayback([truncated], ("raw",))
    count = sum(1 for _ in playback)
    assert 0 < count < 3000
    (damage,) = playback.damage
    assert "truncated.mcap" in damage
    assert playback.end_s() == pytest.approx((count - 1) / 100, abs=0.011)


def test_damage_before_the_end_of_a_stretch_is_reported(tmp_path, monkeypatch):
    """Playback stops reading the file some seconds after the stretch; what it could not read until then counts."""
    path = tmp_path / "damaged.mcap"
    monkeypatch.setattr("fantwin.pipeline.recordings.writing.CHUNK_BYTES", 4096)
    write_raw(path, 4000, fans=1)
    content = bytearray(path.read_bytes())
    (chunk, *_) = (chunk for chunk in chunk_indexes(path) if chunk.message_start_time > START_NS + 5 * 10**9)
    content[chunk.chunk_start_offset + 100] ^= 0xFF
    path.write_bytes(content)
    playback = RecordingPlayback([path], ("raw",), 0.0, 15.0)
    played = sequences(playback)
    assert 1000 < len(played) < 1501 and played[-1] == 1500
    (line,) = playback.damage
    assert "damaged.mcap: damaged chunks left out: " in line


def chunk_indexes(path: Path) -> list[ChunkIndex]:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary
    return summary.chunk_indexes


def test_files_without_a_message_or_that_are_no_recording_are_one_line(tmp_path):
    empty = part(tmp_path / "empty.mcap", range(0))
    with pytest.raises(RecordingError, match="no message"):
        RecordingPlayback([empty], ("raw",))
    assert RecordingPlayback([empty, write_raw(tmp_path / "r.mcap", 5)], ("raw",)).files == [tmp_path / "r.mcap"]
    (tmp_path / "text").write_text("no recording")
    with pytest.raises(RecordingError, match="not a recording"):
        RecordingPlayback([tmp_path / "text"], ("raw",))

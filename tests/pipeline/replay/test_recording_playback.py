"""Playback of recordings: parts in order, each message once, a time range, and in a loop."""

from __future__ import annotations

import random
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import ChunkIndex

from fantwin.pipeline.recordings.reading import RecordingError
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.replay.live.recording_playback import RecordingPlayback, TimeExtent, shifted
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.fields import columns
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, ModelCard
from fantwin.schemas.topics import tray_key
from fantwin.scoring.alarms.alarm_state import UNTIL_IT_CLEARS_T_NS
from tests.support import made_messages
from tests.support.integrated_twins import grid_of
from tests.support.replay_data import START_NS, STEP_NS, raw_of, write_raw

RAW = tray_key("demo", "tray1", "raw")

ALARM_KEY = "fantwin/demo/tray1/alarm"


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


def test_times_continue_from_round_to_round_without_a_gap_and_on_the_grid(tmp_path):
    rounds = islice(RecordingPlayback([write_raw(tmp_path / "r.mcap", 200)], ("raw",), 0.5).rounds(), 450)
    numbers, entries = zip(*rounds, strict=True)
    assert [numbers.count(n) for n in range(3)] == [150, 150, 150]
    times = np.concatenate([entry.message.host_receive_t_ns for entry in entries])
    assert (np.diff(times) == STEP_NS).all()
    assert (np.diff([entry.received_t_ns for entry in entries]) == STEP_NS).all()
    assert sequences(entries)[:150] == sequences(entries)[150:300]


def test_a_recording_without_messages_to_replay_ends_even_in_a_loop(tmp_path):
    assert list(RecordingPlayback([write_raw(tmp_path / "r.mcap", 10)], ("score",)).rounds()) == []


@pytest.mark.parametrize("span_ns", [10 * 33_333_333, 10 * 33_333_333 + 5])
def test_a_round_is_a_whole_number_of_grid_steps_and_longer_than_all_that_is_in_it(span_ns):
    extent, grid = TimeExtent(), grid_of(np.zeros(1), period_ns=33_333_333)
    for t_ns in (START_NS, START_NS + span_ns):
        extent.add(Envelope.of("fantwin/demo/tray1/grid", replace(grid, t_ns=np.array([t_ns])), START_NS + 7))
    assert extent.length_ns() % 33_333_333 == 0
    assert span_ns < extent.length_ns() <= span_ns + 33_333_333


def test_all_times_of_a_message_are_shifted_and_nothing_else():
    alarm = made_messages.alarm(1, 50, onset_t_ns=40)
    later = shifted(Envelope.of(ALARM_KEY, alarm, 60), 1000)
    assert later.received_t_ns == 1060
    assert vars(later.message) == vars(replace(alarm, t_ns=1050, onset_t_ns=1040))
    for until, moved in ((70, 1070), (UNTIL_IT_CLEARS_T_NS, UNTIL_IT_CLEARS_T_NS)):
        shelved = shifted(Envelope.of(ALARM_KEY, replace(alarm, shelved_until_t_ns=until), 60), 1000).message
        assert isinstance(shelved, Alarm) and shelved.shelved_until_t_ns == moved
    raw = raw_of(3, 2)
    moved = shifted(Envelope.of("fantwin/demo/tray1/raw", raw, 60), 1000).message
    assert (moved.host_receive_t_ns == raw.host_receive_t_ns + 1000).all()  # type: ignore[union-attr]
    assert (moved.device_clock_us == raw.device_clock_us).all()  # type: ignore[union-attr]


def test_columns_in_ns_are_times_since_the_epoch_and_named_t_ns():
    assert {name for kind in made_messages.MESSAGE_TYPES for name in columns(kind) if name.endswith("_ns")} == {
        "host_receive_t_ns",
        "t_ns",
    }


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

"""The recorder stage: all topics are recorded, and a disk that refuses is reported and counted."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.recordings import disk, disk_room
from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.recordings.reading import read_metadata, read_recording
from fantwin.pipeline.recordings.recorder import Recorder
from fantwin.pipeline.recordings.scan import scan
from fantwin.pipeline.runtime.stage import Context, StageError
from fantwin.schemas.codec import encode
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.health import Output
from fantwin.schemas.messages import ModelCard, Raw, ScorerSnapshot
from fantwin.schemas.topics import TOPICS, health_key, tray_key
from fantwin.stages.recorder import STAGE
from tests.support.made_messages import health
from tests.support.message_strategies import any_message, same
from tests.support.stub_disk import NOW_NS, RAW_KEY, SECOND_NS, Disk, Part, context, envelope, raw, recorder


def sequences(part: Part) -> list[int]:
    return [pending.message.header.sequence for pending in part.content]


def record(core: Recorder, numbers: Iterable[int]) -> None:
    for sequence in numbers:
        core.step(envelope(raw(sequence), "raw", NOW_NS))


def card(sequence: int) -> ModelCard:
    return ModelCard(
        header=Header("twin_integrator-1", sequence, "tray1"), t_ns=3, twin="demo", kind="hybrid", sha256="ab"
    )


@settings(deadline=None, max_examples=3)
@given(st.tuples(*(any_message(topic.message) for topic in TOPICS)))
def test_every_topic_it_is_given_is_recorded_with_its_bytes(tmp_path_factory, messages):
    run = context(tmp_path_factory.mktemp("recorder"))
    core = STAGE.build(run).core
    envelopes = [envelope(m, topic.name, k + 1) for k, (m, topic) in enumerate(zip(messages, TOPICS, strict=True))]
    for item in envelopes:
        assert list(core.step(item)) == []
    core.close()
    entries = list(read_recording(run.run_folder / "recording.mcap"))
    assert [(e.key, e.topic, e.received_t_ns) for e in entries] == [
        (p.key, p.topic, p.received_t_ns) for p in envelopes
    ]
    for found, item in zip(entries, envelopes, strict=True):
        assert same(encode(found.message), item.payload)
    counted = {f"recorded_{topic.name}": 1 for topic in TOPICS}
    assert core.counters() == counted | {"lost_unwritten": 0, "parts": 1}


def test_configuration_twin_and_keys_of_the_command_line_are_in_the_recording(tmp_path, caplog):
    (tmp_path / "twin.onnx").write_bytes(b"the twin")
    tray = TrayConfig(name="tray1", fans=2, speed_unit="rpm", twin=Path("twin.onnx"))
    run = replace(context(tmp_path, tray, file=Path("today") / "a.mcap"), overrides=("scorer.alarm_share=1",))
    STAGE.build(run).core.close()
    head = read_metadata(tmp_path / "runs" / "today" / "a.mcap")
    assert json.loads(head.metadata["overrides"]) == ["scorer.alarm_share=1"]
    assert head.attachments == {"configuration.toml": b"site = 'plant'\n", "tray1.onnx": b"the twin"}
    assert head.speed_unit("tray1") == "rpm"
    expected = {
        "site": "plant",
        "trays": "tray1",
        "fans.tray1": "2",
        "started": "2027-01-15T08:00:00.250+00:00",
        "started_t_ns": "1800000000250000000",
    }
    assert head.metadata.items() >= expected.items()
    assert len(head.metadata["twin_sha256.tray1"]) == 64
    (tmp_path / "twin.onnx").unlink()
    with caplog.at_level(logging.WARNING):
        STAGE.build(run).core.close()
    assert "twin.onnx: the twin is not in the recording: No such file" in caplog.text


def test_a_path_that_cannot_be_written_is_refused_at_the_start(tmp_path, monkeypatch):
    (tmp_path / "runs").touch()
    with pytest.raises(StageError, match=r"recording\.mcap: cannot be written: .*; name another .*\(recorder\.file\)"):
        STAGE.build(context(tmp_path))
    monkeypatch.setattr(disk, "LEAST_FREE_BYTES", 1 << 60)
    monkeypatch.setattr(disk, "LEAST_FREE_SHARE", 1.0)
    (problem,) = STAGE.check(context(tmp_path / "other"))
    assert "nothing is recorded below" in problem


TICK_NS = SECOND_NS // 20


@pytest.fixture
def flushing_each_second(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fantwin.pipeline.recordings.recorder.LONGEST_FLUSH_S", 1.0)


@pytest.mark.usefixtures("flushing_each_second")
def test_every_message_is_on_the_disk_a_second_after_it_was_received_and_not_at_every_tick():
    disk = Disk()
    core = recorder(disk)
    for tick in range(200):
        now_ns = NOW_NS + tick * TICK_NS
        core.step(envelope(raw(tick), "raw", now_ns - 1))
        core.tick(now_ns)
        assert all(now_ns + TICK_NS - pending.received_t_ns <= SECOND_NS for pending in disk.parts[0].pending)
    assert disk.parts[0].flushes == 10
    for tick in range(200, 240):  # behind a backlog: not more often
        core.step(envelope(raw(tick), "raw", NOW_NS - 5 * SECOND_NS))
        core.tick(NOW_NS + tick * TICK_NS)
    assert disk.parts[0].flushes == 12


@pytest.mark.usefixtures("flushing_each_second")
def test_after_a_clock_is_set_back_flushes_disk_checks_and_parts_continue(monkeypatch):
    monkeypatch.setattr(disk_room, "PART_S", 60.0)
    disk = Disk()
    core = recorder(disk)
    core.step(envelope(raw(0), "raw", NOW_NS))
    core.tick(NOW_NS)
    back_ns = NOW_NS - 3600 * SECOND_NS
    core.tick(back_ns)
    assert sequences(disk.parts[0]) == [0]
    core.step(envelope(raw(1), "raw", back_ns))
    core.tick(back_ns + SECOND_NS)
    assert sequences(disk.parts[0]) == [0, 1]
    disk.free = 0
    core.tick(back_ns + 2 * SECOND_NS)
    assert core.problem()
    disk.free = 1 << 40
    core.tick(back_ns + 3 * SECOND_NS)
    assert core.problem() == ""
    core.tick(back_ns + 63 * SECOND_NS)
    assert len(disk.parts) == 3


def unsaved(core: Recorder) -> list[int]:
    return [each.message.header.sequence for each in core.unsaved()]


@pytest.mark.usefixtures("flushing_each_second")
def test_messages_that_come_while_the_disk_refuses_are_kept_reported_as_unsaved_and_recorded_later():
    disk = Disk()
    core = recorder(disk)
    record(core, range(5))
    assert unsaved(core) == list(range(5))
    core.tick(NOW_NS + SECOND_NS)
    assert core.problem() == "" and not unsaved(core)
    disk.room, disk.refuses = 7, True
    record(core, range(5, 20))
    assert unsaved(core) == list(range(5, 20))
    assert core.problem().startswith("NOTHING IS RECORDED: r.mcap: cannot be written any more: No space left")
    core.tick(NOW_NS + 3 * SECOND_NS)
    assert core.problem(), "it is still full"
    disk.room, disk.refuses = 1000, False
    core.tick(NOW_NS + 3 * SECOND_NS + SECOND_NS // 2)
    assert core.problem(), "it looks once a second"
    core.tick(NOW_NS + 4 * SECOND_NS)
    assert core.problem() == ""
    record(core, range(20, 22))
    core.close()
    first, second = disk.parts
    assert sequences(first) + sequences(second) == list(range(22))
    assert core.counters() == {"recorded_raw": 22, "lost_unwritten": 0, "parts": 2, "pauses": 1}


def test_the_part_after_a_pause_states_the_gap():
    disk = Disk()
    core = recorder(disk)
    disk.gone = "/mnt: the disk is no longer mounted"
    core.tick(NOW_NS + SECOND_NS)
    assert core.problem().startswith("NOTHING IS RECORDED: /mnt: the disk is no longer mounted")
    disk.gone = ""
    core.tick(NOW_NS + 5 * SECOND_NS)
    assert core.problem() == ""
    assert disk.parts[0].closed == "before the next", "no file of a missing disk stays open"
    shown = disk.parts[1].about
    assert int(shown["resumed_t_ns"]) - int(shown["paused_t_ns"]) == 4 * SECOND_NS
    assert shown["paused_because"].startswith("/mnt: the disk is no longer mounted")
    assert shown["lost_in_pause"] == "0"


@pytest.mark.usefixtures("flushing_each_second")
def test_a_pause_that_exceeds_memory_loses_the_oldest_messages_and_counts_them(monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.recordings.recorder.HELD_BYTES", 10 * len(encode(raw(100))))
    disk = Disk()
    core = recorder(disk)
    record(core, range(100, 103))
    disk.refuses = True
    core.tick(NOW_NS + SECOND_NS)
    record(core, range(103, 120))
    disk.refuses = False
    core.tick(NOW_NS + 2 * SECOND_NS)
    core.close()
    assert sequences(disk.parts[0]) == []
    assert sequences(disk.parts[1]) == list(range(110, 120))
    assert core.counters()["lost_unwritten"] == 10
    assert disk.parts[1].about["lost_in_pause"] == "10"
    assert disk.parts[1].ledger.counts[RAW_KEY, "acquisition-1"].missing == 10


def test_a_recorder_that_is_refused_before_it_received_anything_leaves_no_file(tmp_path):
    STAGE.build(context(tmp_path)).core.abort()
    assert not list((tmp_path / "runs").iterdir())
    core = STAGE.build(context(tmp_path)).core
    core.step(envelope(raw(0), "raw"))
    core.abort()
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["recording.mcap"]


def test_a_new_part_begins_at_the_limits_of_size_and_time(monkeypatch):
    monkeypatch.setattr(disk_room, "PART_BYTES", 1_000_000)
    disk = Disk()
    core = recorder(disk)
    for sequence in range(15):
        core.step(envelope(raw(sequence, samples=5_000), "raw", NOW_NS))
        core.tick(NOW_NS + sequence * SECOND_NS)
    core.close()
    assert len(disk.parts) > 2
    assert all(1_000_000 <= part.size < 1_400_000 for part in disk.parts[:-1])
    assert [number for part in disk.parts for number in sequences(part)] == list(range(15))
    assert [part.closed for part in disk.parts] == ["before the next"] * (len(disk.parts) - 1) + ["at the end"]
    disk = Disk()
    monkeypatch.setattr(disk_room, "PART_S", 60.0)
    core = recorder(disk)
    for second in range(150):
        core.tick(NOW_NS + second * SECOND_NS)
    assert [(part.t_ns - NOW_NS) // SECOND_NS for part in disk.parts] == [0, 60, 120]


def test_each_part_begins_with_the_last_card_of_each_twin(monkeypatch):
    monkeypatch.setattr(disk_room, "PART_S", 60.0)
    disk = Disk()
    core = recorder(disk)
    for item in (card(0), card(1), raw(0)):
        core.step(envelope(item, "raw" if isinstance(item, Raw) else "twin", NOW_NS))
    core.tick(NOW_NS + 60 * SECOND_NS)
    record(core, [1])
    core.close()
    first, second = ([(type(p.message).__name__, p.message.header.sequence) for p in q.content] for q in disk.parts)
    assert first == [("ModelCard", 0), ("ModelCard", 1), ("Raw", 0)]
    assert second == [("ModelCard", 1), ("Raw", 1)]
    assert disk.parts[1].content[0].received_t_ns == disk.parts[1].t_ns
    assert (tray_key("plant", "tray1", "twin"), "twin_integrator-1") not in disk.parts[1].ledger.counts


SAMPLES = ("raw", "grid", "prediction", "score")


def chosen(fans: int, *lines: str) -> set[str]:
    """The topics of samples that are recorded of a site with two trays of so many fans."""
    trays = "".join(f'[[tray]]\nname = "{name}"\nfans = {fans}\n' for name in ("a", "b"))
    config = parse_config(trays + "[recorder]\n" + "\n".join(lines), Path("c.toml"), (), ("recorder",))
    topics = STAGE.reads_as_configured(config)
    rare = {topic.name for topic in TOPICS if topic.recorded} - set(SAMPLES)
    assert rare <= set(topics), "what is rare is always recorded"
    assert {"overview", "alarm", "request", "command", "twin", "snapshot", "consumed", "health"} == rare
    return set(topics) & set(SAMPLES)


def test_raw_samples_are_recorded_and_others_only_if_they_are_chosen():
    assert chosen(1) == {"raw"}
    assert chosen(33, "topics = ['raw', 'grid', 'prediction', 'score']") == set(SAMPLES)
    assert chosen(2, "topics = []") == set()


def test_a_slow_line_is_flushed_every_two_minutes_what_happens_on_it_at_once_and_what_fills_memory_each_second():
    disk = Disk()
    core = recorder(disk)
    flushed_at: list[int] = []
    for second in range(1, 181):
        now_ns = NOW_NS + second * SECOND_NS
        core.step(envelope(raw(second), "raw", now_ns))
        if second == 150:
            core.step(envelope(card(0), "twin", now_ns))
        before = disk.parts[0].flushes
        core.tick(now_ns)
        flushed_at += [second] * (disk.parts[0].flushes - before)
    assert flushed_at == [121, 150]
    for tick in range(200):
        now_ns = NOW_NS + 181 * SECOND_NS + tick * TICK_NS
        core.step(envelope(raw(tick, samples=200), "raw", now_ns))
        core.tick(now_ns)
    assert 8 <= disk.parts[0].flushes - 2 <= 12
    assert sum(len(each.payload) for each in core.unsaved()) < 2 * 20 * len(encode(raw(0, samples=200)))


def test_of_healths_those_that_report_something_new_are_recorded_and_no_other_is_missing(tmp_path):
    run = context(tmp_path)
    core = STAGE.build(run).core
    start_ns = run.started_t_ns
    for second in range(1000):
        problem = f"tray{1 + second // 705}: no data for {second} s" if 700 <= second < 710 else ""
        status = StageStatus.DEGRADED if problem else StageStatus.OK
        lost = 1 if second >= 900 else 0
        output = Output(key=RAW_KEY, published=0 if second < 999 else 3)
        about = {"status": status, "problem": problem, "lost": lost, "outputs": (output,)}
        now = health("acquisition", producer="acquisition-1", sequence=second, **about)
        core.step(envelope(now, "health", start_ns + second * SECOND_NS))
        core.tick(start_ns + second * SECOND_NS)
    core.close()
    path = run.run_folder / "recording.mcap"
    assert [each.message.header.sequence for each in read_recording(path)] == [0, 700, 705, 710, 900, 999]
    streams = contents_of(path).streams
    assert streams[health_key("plant", "scorer", "all"), "acquisition-1"].missing == 0
    assert streams[RAW_KEY, "acquisition-1"].missing == 3, "the last one says what was published"
    assert scan(path).counts.ledger.counts[health_key("plant", "scorer", "all"), "acquisition-1"].missing == 0


def test_a_recording_says_which_topics_were_left_out_on_purpose(tmp_path):
    run = replace(context(tmp_path), reads=("raw", "alarm", *set(STAGE.reads) - {*SAMPLES, "alarm"}))
    core = STAGE.build(run).core
    for number in range(2):
        outputs = tuple(Output(key=tray_key("plant", "tray1", name), published=3 * number) for name in SAMPLES)
        core.step(envelope(health("scorer", producer="scorer-1", sequence=number, outputs=outputs), "health"))
    assert core.notes()[-1] == "not recorded: grid, prediction, score (recorder.topics)"
    core.close()
    path = run.run_folder / "recording.mcap"
    assert read_metadata(path).left_out == ("grid", "prediction", "score")
    missing = {key: counts.missing for (key, _), counts in contents_of(path).streams.items() if counts.missing}
    assert missing == {RAW_KEY: 3}, "only what should have been recorded is missing"
    STAGE.build(context(tmp_path)).core.close()
    assert read_metadata(run.run_folder / "recording-2.mcap").left_out == ()


def test_a_recorder_that_is_restarted_keeps_the_last_snapshots_of_its_trays_for_others(tmp_path):
    trays = tuple(TrayConfig(name=name, fans=2) for name in "abc")
    of_shard = replace(context(tmp_path), trays=trays[:2], instance="1-of-2", shard_number=1)

    def snapshot(tray: str, number: int) -> Envelope:
        made = ScorerSnapshot(header=Header("scorer-1", number, tray), t_ns=number, twin_sha256="x", state_json="{}")
        return Envelope.of(tray_key("plant", tray, "snapshot"), made, of_shard.started_t_ns + number)

    def kept_by(run: Context) -> Mapping[str, bytes]:
        built = STAGE.build(run)
        built.core.abort()
        return built.kept

    assert kept_by(of_shard) == {}
    for part in range(2):
        core = STAGE.build(of_shard).core
        for each in (snapshot("a", 2 * part), snapshot("a", 2 * part + 1), *([] if part else [snapshot("b", 7)])):
            core.step(each)
        core.close()
    assert {path.name for path in of_shard.run_folder.glob("*.mcap")} >= {"1-of-2.recording.mcap"}, "one of its own"
    last = {each.key: encode(each.message) for each in (snapshot("a", 3), snapshot("b", 7))}
    assert kept_by(of_shard) == last
    of_b = snapshot("b", 7).key
    assert kept_by(replace(of_shard, trays=trays[1:])) == {of_b: last[of_b]}, "of its trays only"

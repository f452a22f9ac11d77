"""`fantwin info`: the contents of a recording by its index, and the same by reading all of it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.writer import Writer

from fantwin.pipeline.recordings.sequence_ledger import SequenceLedger
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.header import Header
from fantwin.schemas.health import Counter, Health, Input, Note
from fantwin.schemas.messages import ModelCard
from fantwin.schemas.topics import health_key, tray_key
from tests.support import made_messages
from tests.support.fantwin_command import error_of, fantwin
from tests.support.written_recordings import ALARM_KEY, RAW_KEY, alarm, part, parts_in, raw, write

METADATA = {"site": "plant", "trays": "tray1", "fans.tray1": "2", "speed_unit.tray1": "rpm", "made_by": "fantwin"}
SECOND_NS = 1_000_000_000


def shown(*files: Path, exit_code: int = 0) -> dict[str, Any]:
    done = fantwin("info", *files, "--json")
    assert done.exit_code == exit_code, done.output
    return json.loads(done.stdout)


def recording(path: Path) -> Path:
    """A recording with a gap, a repeated message, a twin, and a stage that reports a problem."""
    with RecordingWriter(path, METADATA, {"configuration.toml": b"", "tray1.onnx": b"twin"}) as writer:
        for number, sequence in enumerate((0, 1, 4, 5, 5)):
            writer.add_message(RAW_KEY, raw(sequence), number * SECOND_NS)
        card = ModelCard(header=Header("ti-1", 0, "tray1"), t_ns=1, twin="demo", kind="hybrid", sha256="ab" * 32)
        writer.add_message(tray_key("plant", "tray1", "twin"), card, 5 * SECOND_NS)
        for number, problem in enumerate(("", "the line is silent: look at the cable")):
            lost, note = Counter(name="lost_samples", value=3 * number), Note(tray="tray1", text="grid of 10 Hz")
            more = {"instance": "tray1", "status": StageStatus.DEGRADED, "problem": problem, "lost": lost.value}
            health = made_messages.health(
                "acquisition", producer="acquisition-1", sequence=number, counters=(lost,), notes=(note,), **more
            )
            writer.add_message(health_key("plant", "acquisition", "tray1"), health, 6 * SECOND_NS)
    return path


def test_a_recording_of_a_single_message_lasts_as_long_as_its_samples(tmp_path):
    fantwin("simulate", "--fans", 1, "--recording", tmp_path / "one.mcap", "--duration", 0.5)
    (file,) = shown(tmp_path / "one.mcap")["files"]
    assert (file["messages"], round(file["duration_s"], 1)) == (1, 0.5)


def test_topics_metadata_twins_and_stages_are_in_the_json_and_in_the_text(tmp_path):
    whole = shown(recording(tmp_path / "r.mcap"), exit_code=3)
    assert whole["topics"][RAW_KEY] == {
        "messages": 5,
        "missing": 2,
        "duplicated": 1,
        "first_ns": 0,
        "last_ns": 4 * SECOND_NS,
        "rate_hz": 1.0,
    }
    (found,) = whole["files"]
    assert found["metadata"] == METADATA | {"format": "3"}
    assert (found["messages"], found["duration_s"]) == (8, 6.0)
    assert found["size_bytes"] == (tmp_path / "r.mcap").stat().st_size
    assert found["has_configuration"] is True
    assert found["twins"] == {"tray1": {"twin": "demo", "kind": "hybrid", "sha256": "ab" * 32, "closed_loop": False}}
    assert found["stages"] == {
        "acquisition/tray1": {
            "status": "degraded",
            "problem": "the line is silent: look at the cable",
            "notes": [{"tray": "tray1", "text": "grid of 10 Hz"}],
            "lost": 3,
            "counters": {"lost_samples": 3},
        }
    }
    assert found["damage"] == []
    output = fantwin("info", tmp_path / "r.mcap").stdout
    for words in (
        "r.mcap: 0.0",
        "8 messages",
        "6.0 s",
        "tray tray1, 2 fans, speeds in rpm",
        "twin of tray1: demo, hybrid, sha256 abababababab",
        "attached: configuration.toml, tray1.onnx",
        "acquisition/tray1: the line is silent: look at the cable\n",
        "acquisition/tray1, tray1: grid of 10 Hz\n",
        "lost, over all sessions of each stage: acquisition/tray1 3",
    ):
        assert words in output
    (line,) = (line for line in output.splitlines() if "tray1/raw" in line)
    assert line.split()[1:4] == ["5", "2", "1"]


def healths_of(*sessions: tuple[str, int, tuple[Input, ...]], at_s: int = 0) -> Iterator[tuple[Health, int]]:
    """Two healths of each session of the resampler (its name, what it lost, what it received), and their times."""
    for name, lost, inputs in sessions:
        for number in range(2):
            at_s += 1
            yield (
                made_messages.health("resampler", producer=name, sequence=number, inputs=inputs, lost=lost * number),
                at_s * SECOND_NS,
            )


def received(first: int, until: int) -> tuple[Input, ...]:
    line = Input(key=RAW_KEY, producer="a", received=until - first, missing=0, duplicated=0, next_sequence=until)
    return (line,)


def with_healths(path: Path, healths: Iterable[tuple[Health, int]], ledger: SequenceLedger | None = None) -> Path:
    """A recording with each health in a chunk of its own."""
    with RecordingWriter(path, METADATA, ledger=ledger) as writer:
        for health, t_ns in healths:
            writer.add_message(health_key("plant", "resampler", "all"), health, t_ns)
            writer.flush()
    return path


SESSIONS = (("r-1", 2, received(0, 40)), ("r-2", 3, received(45, 90)))


def test_row_18_losses_of_all_sessions_of_a_stage_are_shown_and_what_was_lost_between_them(tmp_path):
    path = with_healths(tmp_path / "r.mcap", healths_of(*SESSIONS))
    assert shown(path)["lost"] == {"resampler": 2 + 3 + 5}
    assert shown(path)["files"][0]["stages"]["resampler"]["lost"] == 2 + 3 + 5
    assert "lost, over all sessions of each stage: resampler 10" in fantwin("info", path).stdout
    path.write_bytes(path.read_bytes()[:-50])
    assert shown(path)["lost"] == {"resampler": 2 + 3 + 5}, "a file without an index shows the same"


def test_row_13_the_last_health_of_a_session_is_found_after_the_host_clock_was_set_back(tmp_path):
    (first, t_ns), (last, _) = healths_of(SESSIONS[0], at_s=3600)
    path = with_healths(tmp_path / "r.mcap", ((first, t_ns), (last, t_ns - 3600 * SECOND_NS)))
    assert shown(path)["lost"] == {"resampler": 2}


def test_a_file_that_is_still_being_written_is_shown_up_to_what_is_on_disk(tmp_path):
    with RecordingWriter(tmp_path / "r.mcap", METADATA) as writer:
        writer.add_message(RAW_KEY, raw(0), 1)
        writer.flush()
        writer.add_message(RAW_KEY, raw(1), 2)
        (found,) = shown(tmp_path / "r.mcap.active")["files"]
        assert shown(tmp_path / "r.mcap")["files"] == [found], "it is found by the name that it will have"
        error = error_of("replay", "--offline", tmp_path / "r.mcap")
    assert error.endswith(f"; it is still being written: name {tmp_path}/r.mcap.active")
    assert found["damage"] == ["it is still being written"]
    assert found["topics"][RAW_KEY]["messages"] == 1


def three_parts(folder: Path, *firsts: int) -> list[Path]:
    """r.mcap, r-2.mcap and r-3.mcap of ten messages each."""
    place, ledger = parts_in(folder), SequenceLedger()
    for first in firsts:
        part(place, range(first, first + 10), ledger).finish()
        ledger = ledger.for_next_part()
    return [folder / name for name in ("r.mcap", "r-2.mcap", "r-3.mcap")]


def test_messages_that_were_removed_afterwards_are_missing_and_recover_corrects_the_ledger(tmp_path):
    path, altered = write(tmp_path / "r.mcap", 50), tmp_path / "altered.mcap"
    with path.open("rb") as source, altered.open("wb") as file:
        reader, writer = make_reader(source), Writer(file)
        writer.start()
        metadata = {each.name: each.metadata for each in reader.iter_metadata()}
        writer.add_metadata("fantwin", metadata.pop("fantwin"))
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema
            if channel.id not in channels:
                of_schema = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, of_schema)
            if not (channel.topic == RAW_KEY and 20 <= message.sequence < 30):
                number = channels[channel.id]
                writer.add_message(number, message.log_time, message.data, message.publish_time, message.sequence)
        writer.flush()
        writer.add_metadata("fantwin.ledger", metadata["fantwin.ledger"])
        writer.finish()
    for name in ("altered.mcap", "repaired.mcap"):
        of_raw = shown(tmp_path / name, exit_code=3)["topics"][RAW_KEY]
        assert (of_raw["messages"], of_raw["missing"]) == (40, 10)
        if name == "altered.mcap":
            assert "that its ledger counts and that are gone: 10" in fantwin("info", altered).stdout
            assert fantwin("info", "--repair", altered, "-o", tmp_path / "repaired.mcap").exit_code == 3


def test_parts_are_added_up_and_checked_for_continuity(tmp_path):
    first, second, third = three_parts(tmp_path, 0, 10, 23)
    found = shown(third, first, second, third, exit_code=3)
    assert found["topics"][RAW_KEY]["messages"] == 30, "a file that is named twice counts once"
    assert found["topics"][RAW_KEY]["missing"] == 3
    assert [Path(each["file"]).name for each in found["files"]] == ["r.mcap", "r-2.mcap", "r-3.mcap"]
    assert found["continuity"] == []
    found = shown(first, third, exit_code=3)
    assert found["continuity"] == ["r-3.mcap continues r-2.mcap, which is not among these files"]
    assert "which is not among these" in fantwin("info", first, third).stdout
    first.unlink()
    assert shown(second, third, exit_code=3)["continuity"] == [], "the oldest were deleted"
    assert "continues r.mcap" in fantwin("info", second, third).stdout


def test_a_pause_is_shown(tmp_path):
    about = {"paused_t_ns": "1", "resumed_t_ns": "2500000001", "paused_because": "no room", "lost_in_pause": "7"}
    parts_in(tmp_path).begin(0, SequenceLedger(), about).finish()
    output = fantwin("info", tmp_path / "r.mcap").stdout
    assert "before this part nothing was recorded for 2.5 s; messages lost: 7" in output
    assert "reason: no room" in output


def test_a_file_without_fantwin_channels_is_shown_as_such(tmp_path):
    path = tmp_path / "camera.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/camera", "json", 0)
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    (found,) = shown(path)["files"]
    assert (found["topics"], found["other_topics"]) == ({}, {"/camera": 1})
    output = fantwin("info", path).stdout
    assert "not a fantwin recording: it has no fantwin channels" in output
    assert "/camera" in output


def test_a_recording_without_messages_and_an_alarm_alone_are_shown_too(tmp_path):
    """Foreign metadata with keys of fantwin are ignored, and one message has no rate."""
    RecordingWriter(tmp_path / "r.mcap", {"paused_t_ns": "yesterday", "resumed_t_ns": "1"}).finish()
    (found,) = shown(tmp_path / "r.mcap")["files"]
    assert (found["messages"], found["first_ns"], found["duration_s"]) == (0, None, 0.0)
    text = fantwin("info", tmp_path / "r.mcap").stdout
    assert "0 messages" in text and "nothing was recorded" not in text
    with RecordingWriter(tmp_path / "alarm.mcap", METADATA) as writer:
        writer.add_message(ALARM_KEY, alarm(0), 5)
    assert shown(tmp_path / "alarm.mcap")["topics"][ALARM_KEY]["rate_hz"] is None

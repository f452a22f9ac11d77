"""Which files are one recording, and the recordings of the shards of a recorder, read as those of one run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from fantwin.pipeline.cli.recordings import info
from fantwin.pipeline.recordings.contents import contents_of
from fantwin.pipeline.recordings.reading import RecordingError, read_metadata, read_recording
from fantwin.pipeline.recordings.run_recordings import describe, recorded_files, recordings_of
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.replay.live.recording_playback import RecordingPlayback
from fantwin.pipeline.replay.offline.replay_input import open_replay_input
from fantwin.schemas.health import Counter
from fantwin.schemas.topics import health_key, tray_key
from tests.support.fantwin_command import fantwin
from tests.support.killed_site import CONFIGURATION, SITE, TRAY, Site
from tests.support.made_messages import health

TRAYS = (TRAY, "tray2")
_TRAY_TABLE = CONFIGURATION[CONFIGURATION.index("[[tray]]") : CONFIGURATION.index("[twin_integrator]")]
OF_BOTH = CONFIGURATION.replace(_TRAY_TABLE, _TRAY_TABLE + _TRAY_TABLE.replace(TRAY, TRAYS[1]))


@pytest.fixture(scope="module")
def sites(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The recordings of two sites of one tray, whose scorer was killed."""
    found: list[Path] = []
    for seed in (1, 2):
        site = Site(tmp_path_factory.mktemp("site"), seed, raw_samples=4)
        site.run(120)
        site.kill("scorer")
        site.run(60)
        found.append(site.finished())
    return found


def shard(sites: list[Path], folder: Path, number: int, overrides: str = "[]") -> Path:
    """The recording of one of two shards: a whole site of one tray, under the name of its tray."""
    tray, path = TRAYS[number - 1], sites[number - 1]
    head = read_metadata(path)
    metadata = {name.replace(TRAY, tray): value.replace(TRAY, tray) for name, value in head.metadata.items()}
    metadata |= {"recording": f"{number}-of-2.recording.mcap", "overrides": overrides}
    attachments = {"configuration.toml": OF_BOTH.encode(), f"{tray}.onnx": head.attachments[f"{TRAY}.onnx"]}
    with RecordingWriter(folder / f"{number}-of-2.recording.mcap", metadata, attachments) as writer:
        entries = list(read_recording(path))
        for entry in entries:
            header = replace(entry.message.header, tray=tray)
            message = replace(entry.message, header=header)
            writer.add_message(tray_key(SITE, tray, entry.topic), message, entry.received_t_ns)
        for sequence in range(number):  # the second one has heard the stage of both for longer
            late = (Counter(name="lost_late", value=sequence),)
            report = health("resampler", sequence=sequence, counters=late, lost=sequence)
            writer.add_message(health_key(SITE, "resampler", "all"), report, entries[-1].received_t_ns)
    return writer.path


@pytest.fixture(scope="module")
def folder(sites: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with the recordings of two shards, and a table that somebody has imported there."""
    found = tmp_path_factory.mktemp("runs")
    for number in (1, 2):
        shard(sites, found, number)
    with RecordingWriter(found / "imported.mcap", {"trays": "other", "source": "table.csv"}):
        pass
    return found


def test_a_folder_stands_for_what_recorders_have_recorded_there(folder, tmp_path):
    both = [folder / f"{number}-of-2.recording.mcap" for number in (1, 2)]
    assert recorded_files([folder, both[0]]) == both
    with pytest.raises(RecordingError, match="no recording that a recorder has finished in this folder"):
        recorded_files([tmp_path])


def test_a_replay_of_the_folder_decides_for_all_trays_as_it_was_decided(folder):
    done = fantwin("replay", "--offline", "--verify", "--json", folder)
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert found["verified"]["equal"]
    assert found["verified"]["samples_equal"] > 250
    assert found["restarts"] == 2
    assert [set(one["counts"]) for one in found["recordings"]] == [{tray} for tray in TRAYS]
    alone = json.loads(fantwin("replay", "--offline", "--json", folder / "2-of-2.recording.mcap").stdout)
    assert alone["counts"] == found["recordings"][1]["counts"]


def test_shards_of_hosts_that_run_at_different_places_are_one_run_and_those_that_decide_otherwise_are_not(
    sites, tmp_path
):
    here = shard(sites, tmp_path, 1, overrides='["run_folder=\\"/a\\"", "bus.endpoint=\\"x\\""]')
    there = shard(sites, tmp_path, 2, overrides='["run_folder=\\"/b\\"", "gateway.port=8081"]')
    with open_replay_input([here, there], None, (), None) as both:
        assert [tray.name for tray in both.trays] == list(TRAYS)
    other = tmp_path / "other"
    other.mkdir()
    strict = shard(sites, other, 2, overrides='["scorer.alarm_share=0.9"]')
    with (
        pytest.raises(RecordingError, match="they differ in keys set on the command line"),
        open_replay_input([here, strict], None, (), None),
    ):
        pass


def test_the_messages_of_all_shards_are_played_in_the_order_of_their_times(folder):
    played = list(RecordingPlayback([folder], ("raw",)))
    times = [entry.received_t_ns for entry in played]
    assert times == sorted(times)
    assert {entry.message.header.tray for entry in played[:20]} == set(TRAYS), "side by side, not one after the other"
    assert len(played) == sum(len(list(RecordingPlayback([path], ("raw",)))) for path in recorded_files([folder]))


def test_what_two_shards_have_both_recorded_counts_once_and_the_newest_health_counts(folder):
    found = json.loads(fantwin("info", folder, "--json").stdout)
    assert found["continuity"] == []
    assert {key.split("/")[2] for key in found["topics"]} == {*TRAYS, "health"}
    assert found["topics"][health_key(SITE, "resampler", "all")]["messages"] == 2
    parts = list(map(contents_of, recorded_files([folder])))
    for ordered in (parts, parts[::-1]):
        assert [health.lost for health in info._sessions(ordered)] == [1]


ANOTHER_PLACE = ["gateway.port=8081", 'launcher.without=["viewer"]', "viewer={}", "run_folder='x'", "bus.endpoint='y'"]


def file(path: Path, **metadata: str) -> Path:
    path.parent.mkdir(exist_ok=True)
    with RecordingWriter(path, {"site": "plant", **metadata}, {"configuration.toml": b"site = 'plant'"}):
        return path


def test_parts_are_found_by_session_or_by_name_in_one_folder_and_nothing_else_is_a_part(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    first = file(here / "day.mcap", recording="day.mcap", session="s1")
    restarted = file(here / "day-2.mcap", recording="day.mcap", session="s2")
    at_a_port = file(here / "day-4.mcap", recording="day.mcap", overrides=json.dumps(ANOTHER_PLACE))
    deciding = file(here / "day-5.mcap", recording="day.mcap", overrides='["scorer.alarm_share=1"]')
    moved = file(there / "day-3.mcap", recording="day.mcap", session="s2")
    of_another_tray = file(tmp_path / "elsewhere" / "day.mcap", recording="day.mcap", session="s9")
    of_another_site = file(here / "day-9.mcap", recording="day.mcap", session="s1", site="other")
    imported = [file(here / name, source="table.csv") for name in ("table.mcap", "table-2.mcap")]
    files = (moved, first, imported[0], of_another_tray, restarted, imported[1], of_another_site)
    files = (*files, at_a_port, deciding)
    assert recordings_of(map(describe, files)) == [
        (moved, first, restarted, at_a_port), (imported[0],), (of_another_tray,), (imported[1],), (of_another_site,),
        (deciding,),
    ]  # fmt: skip

"""Commands on a recording whose recorder left topics out: each works, or says in one line what is missing and which
command makes it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from mcap.opcode import Opcode

from fantwin.pipeline.recordings.records import RecordReader
from tests.support.fantwin_command import error_of, fantwin
from tests.support.made_once import MadeOnce
from tests.support.offline_replay import changed, recorded, recording_of, without_topics

MADE = ("grid", "prediction", "score")


@pytest.fixture(scope="module")
def whole(made_once: MadeOnce) -> Path:
    def make(folder: Path) -> None:
        path = recording_of(folder, 1, 300, raw_samples=4, calibrated=True).rename(folder / "whole.mcap")
        without_topics(path, folder / "lean.mcap", *MADE)
        without_topics(path, folder / "without-raw.mcap", "raw")

    return made_once("left-out", make) / "whole.mcap"


@pytest.fixture(scope="module")
def lean(whole: Path) -> Path:
    return whole.with_name("lean.mcap")


def advice(path: Path, *topics: str) -> str:
    return (
        f"its recorder left out {', '.join(topics)} (recorder.topics): `fantwin replay {path} --offline -o WHOLE.mcap` "
        "makes a recording with all topics"
    )


def test_info_names_the_topics_and_reports_no_loss(lean):
    done = fantwin("info", lean)
    assert done.exit_code == 0
    assert "left out on purpose (recorder.topics): grid, prediction, score" in done.stdout
    assert json.loads(fantwin("info", lean, "--json").stdout)["files"][0]["left_out"] == list(MADE)


def test_it_is_verified_by_its_alarms_and_snapshots(lean):
    done = fantwin("replay", "--offline", "--verify", lean)
    alarms, snapshots = len(recorded(lean, "alarm")), len(recorded(lean, "snapshot"))
    assert done.exit_code == 0, done.output
    assert f"equal: {snapshots} snapshots and {alarms} alarms; all decisions are identical" in done.stdout
    assert "scores were not recorded (recorder.topics)" in done.stdout


def test_a_difference_is_exit_code_1(lean, tmp_path):
    def doubled(entry):
        if entry.topic == "raw":
            entry.message.speed_rad_s.setflags(write=True)
            entry.message.speed_rad_s[:] *= 1.01
        return entry.message

    different = changed(lean, tmp_path / "r.mcap", doubled)
    done = fantwin("replay", "--offline", "--verify", different)
    assert done.exit_code == 1
    assert "DIFFERS" in done.stdout and "snapshots differ" in done.stdout and "fan 0: overview." in done.stdout
    verified = json.loads(fantwin("replay", "--offline", "--verify", "--json", different).stdout)["verified"]
    assert (verified["samples_equal"], verified["left_out"], verified["equal"]) == (0, list(MADE), False)


def test_a_plot_makes_the_scores_again_and_shows_the_same(lean, whole, tmp_path):
    pictures = [tmp_path / name for name in ("lean.svg", "whole.svg")]
    for path, picture in zip((lean, whole), pictures, strict=True):
        assert fantwin("view", path, "--fans", "0,1,2", "-o", picture).exit_code == 0
    paths = [re.findall(r'<path d="[^"]{200,}"', picture.read_text()) for picture in pictures]
    assert len(paths[0]) > 3 and paths[0] == paths[1], "the curves"


def test_what_a_view_and_a_plot_lack_is_told_as_by_a_replay(lean, tmp_path, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.recordings.writing.CHUNK_BYTES", 4096)
    damaged = without_topics(lean, tmp_path / "damaged.mcap", *MADE)
    content = bytearray(damaged.read_bytes())
    chunks = [record for record in RecordReader(damaged) if record.opcode == Opcode.CHUNK]
    content[chunks[len(chunks) // 2].end - 5] ^= 0xFF
    damaged.write_bytes(content)
    replayed = fantwin("replay", "--offline", "--json", damaged)
    found = json.loads(replayed.stdout)
    assert replayed.exit_code == 3 and found["lost"] and found["damage"]
    for command, output in (("view", tmp_path / "v.rrd"), ("view", tmp_path / "p.svg")):
        done = fantwin(command, damaged, "-o", output, "--json")
        damage = json.loads(done.stdout)["damage"]
        assert damage == [*found["damage"], f"{damaged}: {found['lost']} samples and messages lost"]
        assert (done.exit_code, [line for line in damage if line not in done.stderr]) == (3, [])
        assert output.exists() and not list(tmp_path.glob(".*")), "nothing temporary is left"


def test_an_export_has_raw_samples_and_names_what_is_missing(lean, tmp_path):
    done = fantwin("export", lean, "--to", "csv", "-o", tmp_path)
    assert done.exit_code == 0 and "lean.tray1.raw.csv: 300 rows" not in done.stdout, "a row for each fan"
    assert "lean.tray1.raw.csv: 900 rows" in done.stdout
    line = error_of("export", lean, "--to", "csv", "--topic", "grid", "-o", tmp_path)
    assert line == f"{lean}: no grid in this recording; {advice(lean, 'grid')}"
    done = fantwin("export", lean, "--to", "csv", "--topic", "alarm", "--topic", "score", "-o", tmp_path)
    assert f"no score in this recording: {advice(lean, 'score')}" in done.stderr


def test_topics_that_are_not_there_cannot_be_replayed(lean):
    for words in (("--from-topic", "grid"), ("--topics", "grid,alarm")):
        assert error_of("replay", lean, *words) == f"{lean}: {advice(lean, 'grid')}"


def test_without_raw_samples_there_is_nothing_to_make_the_rest_of(whole):
    without_raw = whole.with_name("without-raw.mcap")
    for words in (("replay", "--offline"), ("report",), ("evaluate", whole.with_name("twin.onnx"))):
        assert error_of(*words, without_raw) == (
            f"{without_raw}: no raw samples in this recording: its recorder left out raw (recorder.topics), and "
            "without raw nothing can be made again"
        )

"""`fantwin replay --offline` as a user sees it: what it prints, and its exit codes."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import onnx
import pytest
from typer.testing import Result

from fantwin.pipeline.recordings.reading import read_metadata, read_recording
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Alarm, Raw, Score
from fantwin.schemas.twin_card import CARD_PROPERTY
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.diagnosis.causes import short_name
from fantwin.twin.export.onnx_export import with_card_entries
from tests.support.fantwin_command import error_of, fantwin
from tests.support.killed_site import Site
from tests.support.offline_replay import changed

GOLDEN = Path(__file__).parents[2] / "support" / "data" / "golden.mcap"


def replay(*words: object) -> Result:
    return fantwin("replay", "--offline", *words)


def error(*words: object) -> str:
    return error_of("replay", "--offline", *words)


def unlimited(twin: bytes, folder: Path) -> Path:
    """The same twin with a limit that no evidence reaches."""
    model = onnx.load_model_from_string(twin)
    (entry,) = (each for each in model.metadata_props if each.key == CARD_PROPERTY)
    card = json.loads(entry.value)
    entry.value = json.dumps(card | {"calibration": card["calibration"] | {"limit_factor": 1e3}})
    onnx.save(model, folder / "unlimited.onnx")
    return folder / "unlimited.onnx"


@pytest.fixture(scope="module")
def golden() -> dict[str, Any]:
    """The decision on the golden recording, compared with the recorded one."""
    return json.loads(replay("--json", "--verify", GOLDEN).stdout)


@cache
def begun_ns() -> int:
    """When the first message of the golden recording was received."""
    return min(entry.received_t_ns for entry in read_recording(GOLDEN))


def beginning(entry: Envelope) -> bool:
    """Whether it is of the first six seconds of the golden recording, in which its alarm is raised."""
    return entry.received_t_ns < begun_ns() + 6 * NS_PER_S


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The recording made from the golden one, and what was printed."""
    out = tmp_path_factory.mktemp("output") / "out.mcap"
    result = replay(GOLDEN, "-o", out)
    assert result.exit_code == 0 and str(out) in result.stdout
    return out, result.stdout


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recording of a second."""
    site = Site(tmp_path_factory.mktemp("short"), seed=1, raw_samples=4)
    site.run(100)
    return site.finished()


def test_equal_is_exit_code_0():
    result = replay("--verify", GOLDEN)
    assert result.exit_code == 0, result.stderr
    assert "equal:" in result.stdout and "all decisions are identical" in result.stdout
    assert "2 restarts of stages" in result.stdout


def test_scores_that_are_missing_between_others_are_exit_code_3(tmp_path):
    def some(entry):
        is_one = entry.topic == "score" and 20 <= entry.message.header.sequence < 30
        return None if is_one or not beginning(entry) else entry.message

    result = replay("--verify", changed(GOLDEN, tmp_path / "some.mcap", some))
    assert result.exit_code == 3
    assert "scored samples between others" in result.stdout


def test_no_scores_cannot_be_compared_exit_code_2(tmp_path):
    raw = changed(GOLDEN, tmp_path / "raw.mcap", lambda entry: entry.message if entry.topic == "raw" else None)
    result = replay("--verify", "--json", raw)
    assert result.exit_code == 2
    assert json.loads(result.stdout)["verified"] is None
    assert "nothing to compare with" in result.stderr


def test_the_decision_as_json_names_counts_and_reasons_for_unscored_samples_apart(golden):
    (alarm,) = golden["alarms"]
    assert alarm["fan"] == 1 and alarm["raised_ns"] < alarm["cleared_ns"]
    assert alarm["severity"] == "warning" and alarm["residual"] < 0
    assert golden["samples"] > 400 and golden["lost"] == 0
    not_judged = sum(golden["not_judged"]["tray1"].values()) / 2
    assert golden["hours"] == pytest.approx((golden["samples"] - not_judged) * 0.02 / 3600, abs=1e-4)
    reasons = {why.name.lower() for why in InvalidReason}
    assert set(golden["not_judged"]["tray1"]) <= reasons
    counts = golden["counts"]["tray1"]
    assert reasons.isdisjoint(counts) and "not_predicted_out_of_range" in counts


def test_the_list_names_severity_and_probable_cause_and_is_not_wide(golden, output, tmp_path):
    (alarm,) = golden["alarms"]
    first, what = alarm["causes"][0], alarm["message"].partition(": ")[2][:12]
    lines = output[1].splitlines()
    (row,) = [line for line in lines if line.lstrip().startswith("tray1")]
    cause = f"{short_name(first['cause'])} {100 * first['probability']:.0f} %"
    assert "_" not in cause
    for expected in (alarm["severity"], cause, what):
        assert expected in row
    twin = unlimited(read_metadata(GOLDEN).attachments["tray1.onnx"], tmp_path)
    what_if = replay(GOLDEN, "--twin", twin, "--to", "12").stdout.splitlines()
    assert "against the recording: 1 alarms lost" in what_if
    (gone,) = [line for line in what_if if line.lstrip().startswith("tray1")]
    assert alarm["severity"] in gone and cause in gone
    files = (str(output[0]), str(GOLDEN))  # lines that name one are as long as its path
    assert max(len(line) for line in lines + what_if if not any(file in line for file in files)) <= 100


def test_a_twin_that_is_not_calibrated_or_does_not_follow_is_said_and_what_was_not_judged_too(golden, tmp_path):
    content, twin = read_metadata(GOLDEN).attachments["tray1.onnx"], tmp_path / "other.onnx"
    (card,) = (each for each in onnx.load_model_from_string(content).metadata_props if each.key == CARD_PROPERTY)
    sigma = [value / 5.0 for value in json.loads(card.value)["sigma_rad_s"]]
    entries = {"calibration": None, "sigma_rad_s": sigma, "reading_sigma_rad_s": [], "model_uncertainty": None}
    twin.write_bytes(with_card_entries(content, entries))
    found = json.loads(replay("--json", GOLDEN, "--twin", twin, "--to", "5").stdout)
    uncalibrated, misfit = found["warnings"]
    assert uncalibrated.startswith(f"{twin} is not calibrated: its alarms are by the priors of a population")
    assert re.match(r"tray1: the twin does not follow fans 0, 1.*: rmse up to [\d.]+ times its sigma: a fault", misfit)
    shown = replay(GOLDEN, "--twin", twin, "--to", "5").stdout
    assert f"warning: {misfit}" in shown and f"warning: {uncalibrated}" in shown
    reasons = found["not_judged"]["tray1"]
    share = sum(reasons.values()) / (found["judged"] + sum(reasons.values()))
    why = ", ".join(f"{reason.replace('_', ' ')} {count}" for reason, count in reasons.items())
    assert f"not judged: {share:.1%} of the samples of fans ({why})" in shown.splitlines()
    assert golden["warnings"] == []


def test_another_configuration_file_is_taken(golden, tmp_path):
    text = read_metadata(GOLDEN).attachments["configuration.toml"].decode()
    text = text.replace("alarm_share = 0.2", "alarm_share = 0.01")
    config = tmp_path / "other.toml"
    config.write_text(text.replace('twin = "twin.onnx"\n', ""))
    before, now = golden["alarms"], json.loads(replay("--json", GOLDEN, "-c", config, "--to", "8").stdout)["alarms"]
    assert [each["severity"] for each in (*before, *now)] == ["warning", "alarm"]


def test_the_output_is_a_whole_recording_with_the_requests_that_its_alarms_answer(golden, output):
    path, _ = output
    messages = [entry.message for entry in read_recording(path, ("score", "grid", "prediction"))]
    samples = [t_ns for each in messages if isinstance(each, Score) for t_ns in each.t_ns.tolist()]
    assert len(samples) == len(set(samples)) == golden["samples"]
    assert max(len(each.t_ns) for each in messages) == 100, "from second to second"  # type: ignore[union-attr]
    assert read_metadata(path).attachments.keys() == read_metadata(GOLDEN).attachments.keys()
    made, recorded = ([entry.message for entry in read_recording(of, ("request",))] for of in (path, GOLDEN))
    assert list(map(repr, made)) == list(map(repr, recorded)) and len(made) > 0
    alarms = [entry.message for entry in read_recording(path, ("alarm",))]
    answered = {alarm.request for alarm in alarms if isinstance(alarm, Alarm)} - {""}
    assert answered == {f"{asked.header.producer}/{asked.header.sequence}" for asked in made}


def test_an_imported_table_is_judged_at_the_rate_of_the_twin(tmp_path):
    site = Site(tmp_path, seed=1, raw_samples=4)
    site.run(600)
    path = site.finished()
    table = changed(path, tmp_path / "table.mcap", lambda entry: entry.message if entry.topic == "raw" else None)
    bare = tmp_path / "bare.mcap"
    with RecordingWriter(bare, {"source": "a table"}) as writer:
        for entry in read_recording(table):
            writer.add_message(entry.key, entry.message, entry.received_t_ns)
    assert "--twin" in error("--json", bare)
    twin, out, share = tmp_path / "twin.onnx", tmp_path / "out.mcap", "scorer.alarm_share=9"
    before, now = (
        json.loads(replay("--json", bare, "--twin", twin, *words).stdout)["alarms"]
        for words in (("-o", out), ("--set", share))
    )
    assert [each["severity"] for each in (*before, *now)] == ["alarm", "warning"], "keys are set on top of the defaults"
    assert json.loads(replay("--json", out).stdout)["samples"] > 550, "the output made from a table can be judged again"


def test_times_of_a_table_without_dates_are_seconds_since_its_first_sample(tmp_path):
    zero_ns, part = 5 * NS_PER_S, ("--from", "1", "--to", "6")
    recorded = [entry.message for entry in read_recording(GOLDEN, ("raw",))]
    table, twin = tmp_path / "table.mcap", tmp_path / "twin.onnx"
    twin.write_bytes(read_metadata(GOLDEN).attachments["tray1.onnx"])
    with RecordingWriter(table, {"source": "a table"}) as writer:
        for raw in recorded:
            assert isinstance(raw, Raw) and isinstance(recorded[0], Raw)
            t_ns = raw.host_receive_t_ns - recorded[0].host_receive_t_ns[0] + zero_ns
            writer.add_message("fantwin/imported/tray1/raw", replace(raw, host_receive_t_ns=t_ns), int(t_ns[-1]))
    document = json.loads(replay("--json", table, "--twin", twin, *part).stdout)
    (alarm,) = document["alarms"]
    assert document["start_ns"] == zero_ns
    lines = replay(table, "--twin", twin, *part).stdout.splitlines()
    assert lines[0] == "alarms, s since the first sample" and "1970" not in "".join(lines)
    (row,) = [line for line in lines if line.lstrip().startswith("tray1")]
    assert f" {(alarm['raised_ns'] - zero_ns) / NS_PER_S:.2f} " in row
    shown = fantwin("info", table).stdout
    assert f"from {zero_ns / NS_PER_S:.3f} s to" in shown and "1970" not in shown


def test_no_file_is_ever_written_over(tmp_path):
    active = tmp_path / "golden.mcap.active"
    active.write_bytes(b"what a recorder is writing")
    for output in (tmp_path / "golden.mcap", tmp_path):
        assert "exists already" in error(GOLDEN, "-o", output)
    assert active.read_bytes() == b"what a recorder is writing"


def test_a_time_range_is_judged_and_compared_with_the_recorded_alarms_of_that_range():
    document = json.loads(replay("--json", GOLDEN, "--to", "3", "--set", "scorer.alarm_share=0.2").stdout)
    assert document["what_if"] == {"gained": [], "lost": [], "kept": []}, "the alarm comes later"
    assert 120 < document["samples"] < 160


def test_files_of_two_runs_are_two_recordings(golden, short):
    both = json.loads(replay("--json", "--verify", GOLDEN, short).stdout)
    each = [golden, json.loads(replay("--json", "--verify", short).stdout)]
    assert [one["files"] for one in both["recordings"]] == [[str(GOLDEN)], [str(short)]]
    for name in ("samples", "lost", "restarts"):
        assert both[name] == sum(one[name] for one in each)
    assert both["verified"]["samples_equal"] == sum(one["verified"]["samples_equal"] for one in each)
    assert both["verified"]["equal"]
    shown = replay(GOLDEN, short, "--to", "6").stdout
    assert "1 alarm in" in shown and f"{GOLDEN}: alarms, s since the first sample" in shown


def test_an_attachment_is_written_nowhere_else(tmp_path):
    head = read_metadata(GOLDEN)
    evil = tmp_path / "evil.mcap"
    attachments = {**head.attachments, str(tmp_path / "planted.onnx"): b"x", "sub/dir.onnx": b"x"}
    with RecordingWriter(evil, head.metadata, attachments) as writer:
        for entry in filter(beginning, read_recording(GOLDEN)):
            writer.add_message(entry.key, entry.message, entry.received_t_ns)
    assert replay("--verify", evil).exit_code == 0
    assert not (tmp_path / "planted.onnx").exists()


def test_damaged_metadata_are_one_line(tmp_path):
    head = read_metadata(GOLDEN)
    path = tmp_path / "[odd].mcap"
    with RecordingWriter(path, {**head.metadata, "overrides": "{broken"}, head.attachments) as writer:
        for entry in read_recording(GOLDEN, ("raw",)):
            writer.add_message(entry.key, entry.message, entry.received_t_ns)
    assert "[odd].mcap: its metadata are damaged" in error(path)


def test_a_truncated_recording_is_judged_as_far_as_it_can_be_read_exit_code_3(tmp_path):
    truncated = tmp_path / "truncated.mcap"
    shutil.copy(GOLDEN, truncated)
    with truncated.open("r+b") as file:
        file.truncate(GOLDEN.stat().st_size // 2)
    result = replay("--json", truncated)
    assert result.exit_code == 3
    assert "is truncated" in json.loads(result.stdout)["damage"][0]

"""`fantwin calibrate` on simulated recordings: what it declares and refuses, and that it leaves the twin as it was."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import onnx
import pytest

from fantwin.pipeline.cli.main import expand_variadic
from fantwin.pipeline.cli.twins.healthy_evidence import Check
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.replay.offline.calibration_of_twin import calibration_in, number_text
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Raw
from fantwin.schemas.topics import tray_key
from fantwin.scoring.calibration.calibration import Calibration
from fantwin.twin.export.card_entries import with_card_entries
from tests.support.fantwin_command import error_of, fantwin
from tests.support.healthy_site import FANS, PER_DAY, recorded
from tests.support.twin_files import write_twin

RATE = ("--false-alarms-per-day", PER_DAY)


def done(*words: object, exit_code: int = 0) -> str:
    """Standard output of a command, whose variadic options are expanded as on the command line."""
    name, *rest = expand_variadic(list(map(str, words)))
    result = fantwin(name, *rest)
    assert result.exit_code == exit_code, result.output
    return result.stdout


def card(twin: Path) -> dict[str, Any]:
    return json.loads(load_tray_twin(twin).card_json)


def calibration_of(twin: Path) -> Calibration:
    calibration = calibration_in(twin, load_tray_twin(twin))
    assert calibration
    return calibration


def changed(path: Path, calibrated: Path, **changes: Any) -> Path:
    """The twin with another calibration."""
    entry = calibration_of(calibrated).model_dump(mode="json") | changes
    path.write_bytes(with_card_entries(calibrated.read_bytes(), {"calibration": entry}))
    return path


def test_the_calibration_is_in_the_card_and_in_one_document_and_the_rest_of_the_twin_is_unchanged(
    healthy: Path,
) -> None:
    before, after = healthy / "twin.onnx", healthy / "calibrated.onnx"
    assert {**card(after), "calibration": None} == {**card(before), "calibration": card(before).get("calibration")}
    assert load_tray_twin(before).card.calibration is None
    graphs = [onnx.load(twin).graph.SerializeToString(deterministic=True) for twin in (before, after)]
    assert graphs[0] == graphs[1]
    found = calibration_of(after)
    assert (found.false_alarms_per_day, found.is_target, found.limit_factor) == (PER_DAY, False, 1.0)
    assert found.fan_hours == pytest.approx(FANS * 120 / 3600, rel=0.1)
    assert found.interval_95[0] <= PER_DAY
    assert (set(found.data[0]), found.data[0]["name"]) == ({"name", "sha256"}, "healthy.mcap")
    assert len(found.data[0]["sha256"]) == 64
    document = json.loads((healthy / "calibrated.json").read_text())
    assert Calibration.model_validate(document["calibration"]) == found
    assert (document["twin"], document["speed_unit"], document["is_target"]) == (str(after), "rad/s", False)
    assert document["warnings"] == []
    for drop in document["drops_found"]:
        assert 0 < drop["within_60_s"] < drop["within_10_s"] < drop["within_1_s"] < drop["speed"]
    assert document["verify"]["kept"] is True
    assert document["verify"]["fan_hours"] == pytest.approx(FANS * 60 / 3600, rel=0.1)


def test_without_an_output_the_twin_itself_is_calibrated_and_people_read_what_was_done_and_what_is_found(
    healthy: Path, tmp_path: Path
) -> None:
    twin, page = tmp_path / "twin.onnx", tmp_path / "report.html"
    twin.write_bytes((healthy / "twin.onnx").read_bytes())
    printed = done("calibrate", twin, healthy / "healthy.mcap", *RATE)
    assert calibration_of(twin).priors == calibration_of(healthy / "calibrated.onnx").priors
    assert "twin.onnx: calibrated on 0.06" in printed and "learned: " in printed and "limit: by theory" in printed
    assert re.search(r"false alarms: \d found, 4.\d declared \(", printed)
    assert f"declared: {PER_DAY} false alarms per fan and day" in printed and "--verify" in printed
    found = [line for line in printed.splitlines() if line.startswith("found at")]
    assert re.search(r"found at \d+ rad/s: a drop of [\d.]+ rad/s within 1 s, [\d.]+ rad/s within 10 s", printed)
    reported = done("report", twin, healthy / "other.mcap", "--to", 10, "--fans", 0, "-o", page)
    assert found and all(line in reported and f"<li>{line}</li>" in page.read_text() for line in found)


def test_a_rate_that_is_not_kept_is_exit_code_3(healthy: Path, tmp_path: Path) -> None:
    calibrated, other, faulty = healthy / "calibrated.onnx", healthy / "other.mcap", healthy / "faulty.mcap"
    (kept,) = done("calibrate", calibrated, "--verify", other, "--set", "scorer.latching=true").splitlines()
    assert f"declared {PER_DAY}" in kept and kept.endswith(": kept")
    rare = changed(tmp_path / "rare.onnx", calibrated, false_alarms_per_day=0.1)
    broken = json.loads(done("calibrate", rare, "--verify", other, faulty, "--json", exit_code=3))["verify"]
    assert (broken["kept"], broken["alarms"]) == (False, 1)
    assert broken["fan_hours"] == pytest.approx(FANS * 120 / 3600, rel=0.1), "all that follows --verify"


def test_with_too_few_data_for_the_rate_it_is_a_target_and_what_is_needed_is_said(
    healthy: Path, tmp_path: Path
) -> None:
    output = tmp_path / "part.onnx"
    words = ("calibrate", healthy / "twin.onnx", healthy / "healthy.mcap", "--from", 20, "--to", 90, "-o", output)
    printed = done(*words, "--false-alarms-per-day", 1, "--extrapolate")
    assert "target: 1 false alarm per fan and day; 72 fan-hours are needed to show it" in printed
    found = calibration_of(output)
    assert found.is_target
    assert (found.data[0]["from_s"], found.data[0]["to_s"]) == (20.0, 90.0)
    assert found.fan_hours == pytest.approx(FANS * 70 / 3600, rel=0.1)
    refused = error_of(*words, "--false-alarms-per-day", 1)
    suggested = re.search(r"declare ([\d.e+]+) or more", refused)
    assert suggested, refused
    assert not json.loads(done(*words, "--false-alarms-per-day", suggested[1], "--json"))["is_target"]


def test_a_fault_in_healthy_recordings_blunts_no_limit_promises_no_rate_and_is_named(
    healthy: Path, tmp_path: Path
) -> None:
    output, both = tmp_path / "o.onnx", (healthy / "healthy.mcap", healthy / "faulty.mcap")
    words = ("calibrate", healthy / "twin.onnx", *both, "--false-alarms-per-day", 1, "--extrapolate", "-o", output)
    result = fantwin(*map(str, words))
    assert result.exit_code == 0, result.output
    assert "target: 1 false alarm per fan and day; these recordings have more" in result.stdout
    found = calibration_of(output)
    assert found.limit_factor < 1.5 and found.found >= 1
    assert f"{both[1]}: tray1 fan 1 is " in result.stderr and "calibrate without this recording" in result.stderr


def test_the_printed_interval_decides_and_a_rate_is_broken_only_by_more_alarms_than_chance_explains() -> None:
    for alarms in range(20):
        check = Check(alarms, 100.0, 1.0)
        low, _ = check.interval_95
        assert check.text.endswith(": not kept") == check.is_broken == (low > 1.0)
        assert f"(95 %: {number_text(low)} to " in check.text
    assert [Check(alarms, 100.0, 1.0).is_broken for alarms in (0, 7, 10)] == [False, False, True]  # 4.2 expected
    assert not Check(0, 1e5, 1.0).is_broken, "fewer alarms than declared break nothing"
    low, high = Check(3, 72.0, 1.0).interval_95
    assert (low, high) == (pytest.approx(0.206, abs=0.001), pytest.approx(2.922, abs=0.001))
    assert math.isfinite(Check(0, 1.0, 1.0).interval_95[1])


def test_recordings_that_a_twin_was_made_from_cannot_verify_it_under_any_name(healthy: Path, tmp_path: Path) -> None:
    copy, calibrated = tmp_path / "copy.mcap", healthy / "calibrated.onnx"
    copy.write_bytes((healthy / "healthy.mcap").read_bytes())
    error = error_of("calibrate", calibrated, "--verify", healthy / "other.mcap", "--verify", copy)
    assert f"{copy}: {calibrated} was calibrated on it, so it proves nothing" in error
    error = error_of("calibrate", calibrated, "--verify", healthy / "training.mcap")
    assert f"{calibrated} was trained on it" in error


def together(path: Path, **recordings: Path) -> Path:
    """One recording of several trays, by name."""
    with RecordingWriter(path, {"trays": ",".join(recordings), "speed_unit": "rad/s"}) as writer:
        for tray, recording in recordings.items():
            for sequence, envelope in enumerate(read_recording(recording, ("raw",))):
                assert isinstance(envelope.message, Raw)
                raw = replace(envelope.message, header=Header("simulate", sequence, tray))
                writer.add_message(tray_key("plant", tray, "raw"), raw, int(raw.host_receive_t_ns[-1]))
    return path


def test_of_several_trays_the_chosen_one_alone_is_calibrated_and_verified_and_without_a_choice_all_are(
    healthy: Path, tmp_path: Path
) -> None:
    both = together(tmp_path / "both.mcap", a=healthy / "healthy.mcap", b=healthy / "other.mcap")
    others = together(tmp_path / "others.mcap", a=healthy / "faulty.mcap", b=healthy / "healthy.mcap")
    words = ("calibrate", healthy / "twin.onnx", both, *RATE, "-o", tmp_path / "o.onnx", "--json")
    found = json.loads(done(*words, "--tray", "a", "--verify", others))
    assert found["verify"]["fan_hours"] == pytest.approx(FANS * 60 / 3600, rel=0.1)
    alone = json.loads((healthy / "calibrated.json").read_text())["calibration"]
    differ = {name for name, value in alone.items() if found["calibration"][name] != value}
    assert differ == {"data", "created"}
    assert found["calibration"]["data"][0]["tray"] == "a"
    all_of_them = json.loads(done(*words))["calibration"]
    assert all_of_them["fan_hours"] == pytest.approx(1.5 * alone["fan_hours"], rel=0.05)
    assert all_of_them["runs"] == 2


def test_the_twin_of_a_tray_is_trained_on_its_samples_only(healthy: Path, tmp_path: Path) -> None:
    both = together(tmp_path / "both.mcap", a=healthy / "training.mcap", b=healthy / "other.mcap")
    words = ("train", both, "--model", "physical", "-o", tmp_path / "twin.onnx", "--json", "--tray")
    chosen, other = (json.loads(done(*words, tray))["sigma"] for tray in "ab")
    assert chosen == pytest.approx(load_tray_twin(healthy / "twin.onnx").card.sigma_rad_s)
    assert other != chosen


def test_a_fan_alone_and_fans_beside_others_are_calibrated_together_if_the_twin_fits_them(
    healthy: Path, tmp_path: Path
) -> None:
    recording, alone = healthy / "healthy.mcap", recorded(tmp_path / "alone.mcap", 4, 20, fans=1)
    words = ("calibrate", write_twin(tmp_path / "of-one.onnx"), recording, alone, *RATE, "-o", tmp_path / "o.onnx")
    assert json.loads(done(*words, "--json"))["calibration"]["runs"] == 2
    both, twin = together(tmp_path / "both.mcap", a=recording, b=alone), healthy / "twin.onnx"
    expected = f"{both}: several trays, a of 2 fans, b of 1 fan, and a twin of 2 fans: choose one with --tray"
    assert error_of("calibrate", twin, both, *RATE) == expected
    assert error_of("calibrate", healthy / "calibrated.onnx", "--verify", both) == expected


def test_a_calibration_of_another_kind_is_one_clear_line(healthy: Path, tmp_path: Path) -> None:
    old = changed(tmp_path / "old.onnx", healthy / "calibrated.onnx", detectors={})
    error = error_of("calibrate", old, "--verify", healthy / "other.mcap")
    assert error.startswith(f"{old}: its card has calibration.detectors: ") and error.endswith("; calibrate it again")

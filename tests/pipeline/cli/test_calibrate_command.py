"""`fantwin calibrate` on simulated recordings: what it declares and refuses, and that the twin stays as it was."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import onnx
import pytest

from fantwin.pipeline.cli.in_parallel import RecordingsInParallel
from fantwin.pipeline.cli.main import expand_variadic
from fantwin.pipeline.learning.healthy_evidence import Check, check_declared_rate
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.replay.offline.alarm_episodes import alarms_in, marked_alarms
from fantwin.pipeline.replay.offline.calibration_of_twin import number_text
from fantwin.schemas.enums import Action
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Raw
from fantwin.schemas.topics import tray_key
from fantwin.scoring.calibration.calibration import Calibration
from fantwin.scoring.model.population import Priors
from tests.support.fantwin_command import error_of, fantwin
from tests.support.healthy_site import (
    FANS,
    FAULT_S,
    HEALTHY_S,
    OTHER_S,
    PER_DAY,
    calibration_of,
    changed,
    recorded,
    with_alarm,
)
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
    assert found.fan_hours == pytest.approx(FANS * HEALTHY_S / 3600, rel=0.1)
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
    assert document["verify"]["fan_hours"] == pytest.approx(FANS * OTHER_S / 3600, rel=0.1)


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


@pytest.mark.usefixtures("undrawn")
def test_without_an_output_the_twin_itself_is_calibrated_and_people_read_what_was_done_and_what_is_missing(
    healthy: Path, tmp_path: Path
) -> None:
    twin, page = tmp_path / "twin.onnx", tmp_path / "report.html"
    twin.write_bytes((healthy / "twin.onnx").read_bytes())
    part = ("--from", 10, "--to", 40, "--false-alarms-per-day", 1, "--extrapolate")
    printed = done("calibrate", twin, healthy / "healthy.mcap", *part)
    found = calibration_of(twin)
    assert found.is_target
    assert (found.data[0]["from_s"], found.data[0]["to_s"]) == (10.0, 40.0)
    assert found.fan_hours == pytest.approx(FANS * 30 / 3600, rel=0.1)
    assert "twin.onnx: calibrated on 0.01" in printed and "learned: " in printed and "limit: by theory" in printed
    assert re.search(r"false alarms: \d found, 0.\d+ expected \(", printed)
    assert "target: 1 false alarm per fan and day; 72 fan-hours are needed to show it" in printed
    drops = [line for line in printed.splitlines() if line.startswith("found at")]
    assert re.search(r"found at \d+ rad/s: a drop of [\d.]+ rad/s within 1 s, [\d.]+ rad/s within 10 s", printed)
    reported = done("report", twin, healthy / "other.mcap", "--to", 10, "--fans", 0, "-o", page)
    assert drops and all(line in reported and f"<li>{line}</li>" in page.read_text() for line in drops)


def test_a_broken_rate_is_exit_code_3_and_recordings_that_made_the_twin_prove_nothing(
    healthy: Path, tmp_path: Path
) -> None:
    calibrated, other, copy = healthy / "calibrated.onnx", healthy / "other.mcap", tmp_path / "copy.mcap"
    rare = changed(tmp_path / "rare.onnx", calibrated, false_alarms_per_day=0.1)
    verified = ("calibrate", rare, "--verify", other, healthy / "faulty.mcap", "--set", "scorer.alarm_share=0.2")
    broken = json.loads(done(*verified, "--json", exit_code=3))["verify"]
    assert (broken["kept"], broken["alarms"]) == (False, 1)
    assert broken["fan_hours"] == pytest.approx(FANS * 2 * OTHER_S / 3600, rel=0.1), "all that follows --verify"
    copy.write_bytes((healthy / "healthy.mcap").read_bytes())
    error = error_of("calibrate", calibrated, "--verify", other, "--verify", copy)
    assert f"{copy}: {calibrated} was calibrated on it, so it proves nothing" in error
    error = error_of("calibrate", calibrated, "--verify", healthy / "training.mcap")
    assert f"{calibrated} was trained on it" in error
    words = ("calibrate", healthy / "twin.onnx", healthy / "training.mcap", *RATE, "--extrapolate", "--json")
    found = json.loads(done(*words, "-o", tmp_path / "own.onnx"))
    assert found["warnings"][0].startswith("training.mcap: the twin was trained on it, so its errors are too small")
    old = changed(tmp_path / "old.onnx", calibrated, detectors={})
    error = error_of("calibrate", old, "--verify", other)
    assert error.startswith(f"{old}: its card has calibration.detectors: ") and error.endswith("; calibrate it again")


def together(path: Path, **recordings: Path) -> Path:
    """One recording of several trays, by name."""
    with RecordingWriter(path, {"trays": ",".join(recordings), "speed_unit": "rad/s"}) as writer:
        for tray, recording in recordings.items():
            for sequence, envelope in enumerate(read_recording(recording, ("raw",))):
                assert isinstance(envelope.message, Raw)
                raw = replace(envelope.message, header=Header("simulate", sequence, tray))
                writer.add_message(tray_key("plant", tray, "raw"), raw, int(raw.host_receive_t_ns[-1]))
    return path


def test_of_several_trays_the_chosen_one_alone_makes_and_verifies_a_twin(healthy: Path, tmp_path: Path) -> None:
    training = together(tmp_path / "training.mcap", a=healthy / "training.mcap", b=healthy / "other.mcap")
    both = together(tmp_path / "both.mcap", a=healthy / "healthy.mcap", b=healthy / "other.mcap")
    others = together(tmp_path / "others.mcap", a=healthy / "faulty.mcap", b=healthy / "healthy.mcap")
    words = ("train", training, "--model", "physical", "-o", tmp_path / "twin.onnx", "--json", "--tray", "a")
    expected = load_tray_twin(healthy / "twin.onnx").card.sigma_rad_s
    assert json.loads(done(*words))["sigma"] == pytest.approx(expected)
    words = ("calibrate", healthy / "twin.onnx", both, *RATE, "-o", tmp_path / "o.onnx", "--json", "--tray", "a")
    found = json.loads(done(*words, "--verify", others))
    assert found["verify"]["fan_hours"] == pytest.approx(FANS * OTHER_S / 3600, rel=0.1)
    alone = json.loads((healthy / "calibrated.json").read_text())["calibration"]
    assert {name for name, value in alone.items() if found["calibration"][name] != value} == {"data", "created"}
    assert found["calibration"]["data"][0]["tray"] == "a"


def test_without_a_choice_all_trays_are_calibrated_on_if_the_twin_fits_them(healthy: Path, tmp_path: Path) -> None:
    alone = recorded(tmp_path / "alone.mcap", 4, 10, fans=1)
    both = together(tmp_path / "both.mcap", a=healthy / "other.mcap", b=alone)
    of_one = write_twin(tmp_path / "of-one.onnx")
    found = json.loads(done("calibrate", of_one, both, *RATE, "--extrapolate", "--json"))["calibration"]
    assert (found["runs"], found["fan_hours"]) == (2, pytest.approx((FANS * OTHER_S + 10) / 3600, rel=0.15))
    expected = f"{both}: several trays, a of 2 fans, b of 1 fan, and a twin of 2 fans: choose one with --tray"
    assert error_of("calibrate", healthy / "twin.onnx", both, *RATE) == expected
    assert error_of("calibrate", healthy / "calibrated.onnx", "--verify", both) == expected


def calibrated(folder: Path, action: Action, place: Path) -> tuple[dict[str, Any], list[str]]:
    """The output for machines, and the lines about alarms that are marked."""
    with_alarm(place / "alarms.mcap", action)
    words = [
        *("calibrate", folder / "twin.onnx", folder / "other.mcap", folder / "faulty.mcap", "-o", place / "o.onnx"),
        *("--feedback", place / "alarms.mcap", "--false-alarms-per-day", PER_DAY, "--extrapolate", "--json"),
    ]
    result = fantwin(*expand_variadic(list(map(str, words))))
    assert result.exit_code == 0, result.output
    document = json.loads(result.stdout)
    assert set(document["warnings"]) <= set(result.stderr.splitlines())
    return document, [line for line in result.stderr.splitlines() if "marked" in line]


def test_what_is_marked_as_false_is_learned_from_and_what_is_marked_as_true_is_not(
    healthy: Path, tmp_path: Path
) -> None:
    false, [line] = calibrated(healthy, Action.FALSE_ALARM, tmp_path)
    assert line.endswith("marked as a false alarm by ann (door): used as healthy running")
    (warning,) = (each for each in false["warnings"] if f"{healthy / 'faulty.mcap'}: tray1 fan 1 is " in each)
    assert warning.endswith("calibrate without this recording")
    true, [line] = calibrated(healthy, Action.TRUE_ALARM, tmp_path)
    assert not [each for each in true["warnings"] if "fan 1" in each]
    assert "alarms.mcap: tray1 fan 1: alarm of 20" in line
    assert "marked as a true alarm by ann (door): left out, from 10 min before it until 20" in line
    learned, known = (each["calibration"] for each in (false, true))
    assert learned["priors"]["twin_share"] > 3 * Priors().twin_share, "the fault is variation"
    assert "twin_share" not in known["priors"]
    hours = [each["fan_hours"] for each in (learned, known)]
    assert hours[0] - hours[1] == pytest.approx((FAULT_S[1] + 1) / 3600, rel=0.25), "that time of that fan"
    assert [(each["feedback"], each["is_left_out"]) for each in true["alarms"]] == [("true_alarm", True)]


def test_a_true_alarm_is_no_false_one_when_the_declared_rate_is_tested(healthy: Path, tmp_path: Path) -> None:
    (span,) = (each.left_out for each in marked_alarms([_marked(tmp_path, Action.TRUE_ALARM)]))
    assert span is not None
    rare = changed(tmp_path / "rare.onnx", healthy / "calibrated.onnx", false_alarms_per_day=100.0)
    with RecordingsInParallel() as pool:
        found = check_declared_rate(rare, [healthy / "faulty.mcap"], [], pool.map, left_out=[replace(span, path=None)])
    assert found.alarms == 0
    assert found.fan_hours == pytest.approx((FANS * OTHER_S - FAULT_S[1]) / 3600, rel=0.1)


def _marked(folder: Path, action: Action | None) -> tuple[Path, list[tuple[str, Alarm]]]:
    return folder, alarms_in(with_alarm(folder / "alarms.mcap", action))

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

from pipeline.cli.main import expand_variadic
from pipeline.cli.twins.calibration_check import Check
from pipeline.recordings.reading import read_recording
from pipeline.recordings.writing import RecordingWriter
from pipeline.runtime.tray_twin import load_tray_twin
from schemas.header import Header
from schemas.messages import Raw
from schemas.topics import tray_key
from schemas.units import NS_PER_S
from scoring.limits import Limits, default_timing
from tests.support.fantwin_command import error_of, fantwin
from tests.support.healthy_site import FANS, PER_DAY, recorded, start_ns
from tests.support.twin_files import write_twin
from twin.export.card_entries import with_card_entries

RATE = ("--false-alarms-per-day", PER_DAY)


def done(*words: object, exit_code: int = 0) -> str:
    """Standard output of a command, whose variadic options are expanded as on the command line."""
    name, *rest = expand_variadic(list(map(str, words)))
    result = fantwin(name, *rest)
    assert result.exit_code == exit_code, result.output
    return result.stdout


def card(twin: Path) -> dict[str, Any]:
    return json.loads(load_tray_twin(twin).card_json)


def limits_of(twin: Path) -> Limits:
    return Limits.model_validate(load_tray_twin(twin).card.calibration)


def with_limits(path: Path, calibrated: Path, factor: float) -> Path:
    """The twin with so many times its limits, and a declared rate that is far lower."""
    was = limits_of(calibrated)
    assert was.declared_rate
    rate = was.declared_rate.model_copy(update={"false_alarms_per_day": 0.1})
    limits = was.times(factor).model_copy(update={"declared_rate": rate})
    path.write_bytes(with_card_entries(calibrated.read_bytes(), {"calibration": json.loads(limits.model_dump_json())}))
    return path


def test_the_limits_are_in_the_card_and_in_one_document_and_the_rest_of_the_twin_is_unchanged(healthy: Path) -> None:
    before, after = healthy / "twin.onnx", healthy / "calibrated.onnx"
    assert {**card(after), "calibration": None} == {**card(before), "calibration": card(before).get("calibration")}
    assert load_tray_twin(before).card.calibration is None
    graphs = [onnx.load(twin).graph.SerializeToString(deterministic=True) for twin in (before, after)]
    assert graphs[0] == graphs[1]
    limits = limits_of(after)
    assert {"speed_smoothed", "balance_smoothed", "sensor"} <= limits.detectors.keys()
    rate = limits.declared_rate
    assert rate and rate.false_alarms_per_day == PER_DAY
    assert rate.interval_95[0] < PER_DAY < rate.interval_95[1]
    assert (set(rate.data[0]), rate.data[0]["name"]) == ({"name", "sha256"}, "healthy.mcap")
    assert len(rate.data[0]["sha256"]) == 64
    document = json.loads((healthy / "calibrated.json").read_text())
    assert Limits.model_validate(document["calibration"]) == limits
    assert (document["twin"], document["speed_unit"]) == (str(after), "rad/s")
    assert document["drops_found"] and document["warnings"] == []
    for drop in document["drops_found"]:
        assert 0 < drop["within_a_minute"] <= drop["at_once"] <= drop["speed"]
    assert document["verify"]["kept"] is True
    assert document["verify"]["fan_hours"] == pytest.approx(FANS * 60 / 3600, rel=0.1)


def test_without_an_output_the_twin_itself_is_calibrated_and_people_read_what_raises_an_alarm(
    healthy: Path, tmp_path: Path
) -> None:
    twin, page = tmp_path / "twin.onnx", tmp_path / "report.html"
    twin.write_bytes((healthy / "twin.onnx").read_bytes())
    printed = done("calibrate", twin, healthy / "healthy.mcap", *RATE)
    assert limits_of(twin).detectors == limits_of(healthy / "calibrated.onnx").detectors
    assert "twin.onnx: alarms calibrated on 0.06" in printed
    assert f"declared: {PER_DAY} false alarms per fan and day" in printed and "--verify" in printed
    found = [line for line in printed.splitlines() if line.startswith("found at")]
    assert re.search(r"found at \d+ rad/s: a drop of [\d.]+ rad/s at once", printed)
    reported = done("report", twin, healthy / "other.mcap", "--to", 10, "--fans", 0, "-o", page)
    assert found and all(line in reported and f"<li>{line}</li>" in page.read_text() for line in found)


def test_the_limits_decide_what_is_found_and_a_rate_that_is_not_kept_is_exit_code_3(
    healthy: Path, tmp_path: Path
) -> None:
    calibrated, other = healthy / "calibrated.onnx", healthy / "other.mcap"
    strict = with_limits(tmp_path / "strict.onnx", calibrated, 0.3)
    alarmed_s, end_ns = [], start_ns(3) + 60 * NS_PER_S
    for twin in (strict, calibrated):
        alarms = json.loads(done("replay", other, "--offline", "--twin", twin, "--json"))["alarms"]
        alarmed_s.append(sum((alarm["cleared_ns"] or end_ns) - alarm["raised_ns"] for alarm in alarms))
    assert alarmed_s[0] > alarmed_s[1]
    (kept,) = done("calibrate", calibrated, "--verify", other, "--set", "scorer.off_delay_s=2.0").splitlines()
    assert f"declared {PER_DAY}" in kept and kept.endswith(": kept")
    both = ("--verify", other, healthy / "faulty.mcap")
    broken = json.loads(done("calibrate", strict, *both, "--json", exit_code=3))["verify"]
    assert broken["kept"] is False
    assert broken["fan_hours"] == pytest.approx(FANS * 120 / 3600, rel=0.1), "all that follows --verify"


def test_of_the_wanted_part_limits_for_the_times_of_the_scorer_are_extrapolated_to_a_target(
    healthy: Path, tmp_path: Path
) -> None:
    output = tmp_path / "part.onnx"
    few = ("--from", 20, "--to", 90, "--false-alarms-per-day", 1, "--extrapolate", "--set", "scorer.smoothing_s=1.0")
    printed = done("calibrate", healthy / "twin.onnx", healthy / "healthy.mcap", *few, "-o", output)
    assert "the data are too few to show whether these limits keep it" in printed
    part, whole = limits_of(output), limits_of(healthy / "calibrated.onnx")
    assert part.declared_rate and part.declared_rate.extrapolated and whole.declared_rate
    assert (part.declared_rate.data[0]["from_s"], part.declared_rate.data[0]["to_s"]) == (20.0, 90.0)
    less = whole.declared_rate.fan_hours - part.declared_rate.fan_hours
    assert less == pytest.approx(FANS * (120 - 70) / 3600, rel=0.05), "commissioning is repeated in each"
    of_tray = default_timing(2)
    assert (whole.timing, part.timing) == (of_tray, of_tray.model_copy(update={"smoothing_s": 1.0}))
    assert part.detectors["speed_smoothed"] != whole.detectors["speed_smoothed"]


def test_the_printed_interval_decides_and_a_rate_is_broken_only_by_more_alarms_than_chance_explains() -> None:
    for alarms in range(20):
        check = Check(alarms, 100.0, 1.0)
        low, _ = check.interval_95
        assert check.text.endswith(": not kept") == check.is_broken == (low > 1.0)
        assert f"(95 %: {low:.2g} to " in check.text
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


@pytest.mark.parametrize(
    ("setting", "difference"),
    [
        ("scorer.on_delay_s=1.0", "differ in scorer.on_delay_s, which limits depend on: choose one"),
        ("resampler.rate_hz=10", "have grids of different rates, 20 Hz and 10 Hz"),
    ],
)
def test_recordings_of_sites_with_other_settings_are_refused_by_name(
    healthy: Path, tmp_path: Path, setting: str, difference: str
) -> None:
    twin, other = healthy / "twin.onnx", tmp_path / "other.mcap"
    done("replay", healthy / "other.mcap", "--offline", "--twin", twin, "--end", 9, "--set", setting, "-o", other)
    assert f"healthy.mcap and {other} {difference}" in error_of(
        "calibrate", twin, healthy / "healthy.mcap", other, *RATE
    )


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
    chosen, alone = found["calibration"], json.loads((healthy / "calibrated.json").read_text())["calibration"]
    rates = [each.pop("declared_rate") for each in (alone, chosen)]
    assert chosen == alone
    assert rates[0]["fan_hours"] == rates[1]["fan_hours"]
    assert [entry.get("tray") for rate in rates for entry in rate["data"]] == [None, "a"]
    all_of_them = json.loads(done(*words))["calibration"]["declared_rate"]
    assert all_of_them["fan_hours"] == pytest.approx(1.5 * rates[1]["fan_hours"], rel=0.05)
    assert all_of_them["runs"] == 2


def test_the_twin_of_a_tray_is_trained_on_its_samples_only(healthy: Path, tmp_path: Path) -> None:
    both = together(tmp_path / "both.mcap", a=healthy / "training.mcap", b=healthy / "other.mcap")
    words = ("train", both, "--model", "physical", "-o", tmp_path / "twin.onnx", "--json", "--tray")
    chosen, other = (json.loads(done(*words, tray))["sigma"] for tray in "ab")
    assert chosen == pytest.approx(load_tray_twin(healthy / "twin.onnx").card.sigma_rad_s)
    assert other != chosen


def test_a_fan_alone_and_fans_beside_others_are_not_calibrated_together(healthy: Path, tmp_path: Path) -> None:
    """What several share is followed apart, with slower baselines: limits hold for one of both."""
    recording, alone = healthy / "healthy.mcap", recorded(tmp_path / "alone.mcap", 4, 20, fans=1)
    for recordings in ((recording, alone), (alone, recording)):
        error = error_of("calibrate", write_twin(tmp_path / "of-one.onnx"), *recordings, *RATE)
        assert f"{alone} has a tray of one fan and {recording} one of 2" in error
        assert "calibrate twice, and write one of the twins to another file with -o" in error
    both, twin = together(tmp_path / "both.mcap", a=recording, b=alone), healthy / "twin.onnx"
    expected = f"{both}: several trays, a of 2 fans, b of 1 fan, and a twin of 2 fans: choose one with --tray"
    assert error_of("calibrate", twin, both, *RATE) == expected
    assert error_of("calibrate", healthy / "calibrated.onnx", "--verify", both) == expected

"""`fantwin calibrate` on simulated recordings: what it declares and refuses, and that it leaves the twin as it was."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import onnx
import pytest

from pipeline.cli.main import expand_variadic
from pipeline.cli.twins.calibration_check import Check
from pipeline.runtime.tray_twin import load_tray_twin
from scoring.limits import Limits, default_timing
from tests.support.fantwin_command import error_of, fantwin

FANS = 2
PER_DAY = 1500


def simulated(path: Path, seed: int, seconds: float, *more: object) -> Path:
    result = fantwin(
        "simulate", "--fans", FANS, "--profile", "multisine", "--seed", seed, "--duration", seconds,
        "--epoch-ns", 0, "--recording", path, *more,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("calibrate")
    simulated(path / "training.mcap", 1, 60)
    simulated(path / "healthy.mcap", 2, 120)
    simulated(path / "other.mcap", 3, 60)
    result = fantwin("train", path / "training.mcap", "--model", "physical", "-o", path / "twin.onnx")
    assert result.exit_code == 0, result.output
    return path


@pytest.fixture(scope="module")
def output_of_calibration(folder: Path) -> str:
    result = calibrate(folder, "-o", folder / "calibrated.onnx")
    assert result.exit_code == 0, result.output
    return result.stdout


@pytest.fixture(scope="module")
def calibrated(folder: Path, output_of_calibration: str) -> Path:
    return folder / "calibrated.onnx"


def calibrate(folder: Path, *more: object):
    return fantwin("calibrate", folder / "twin.onnx", folder / "healthy.mcap", "--false-alarms-per-day", PER_DAY, *more)


def card(twin: Path) -> dict[str, Any]:
    return json.loads(load_tray_twin(twin).card_json)


def test_the_limits_are_in_the_card_and_the_rest_of_the_twin_is_unchanged(folder: Path, calibrated: Path) -> None:
    before, after = folder / "twin.onnx", calibrated
    assert load_tray_twin(before).card.calibration is None
    assert {**card(after), "calibration": None} == {**card(before), "calibration": card(before).get("calibration")}
    graphs = [onnx.load(twin).graph.SerializeToString(deterministic=True) for twin in (before, after)]
    assert graphs[0] == graphs[1]
    limits = Limits.model_validate(load_tray_twin(after).card.calibration)
    assert {"speed_smoothed", "balance_smoothed", "sensor"} <= limits.detectors.keys()
    assert limits.declared_rate
    assert limits.declared_rate.false_alarms_per_day == PER_DAY
    assert limits.declared_rate.interval_95[0] < PER_DAY < limits.declared_rate.interval_95[1]
    assert limits.declared_rate.data[0]["name"] == "healthy.mcap"
    assert len(limits.declared_rate.data[0]["sha256"]) == 64


def test_the_limits_decide_what_a_replay_finds(folder: Path, calibrated: Path) -> None:
    """Of a healthy run, at limits for an alarm of each fan a minute, at three tenths of them, and at three times."""
    twins = (calibrated, strict(folder, calibrated), with_limits(folder / "wide.onnx", calibrated, 3.0))
    calibrated_s, strict_s, wide_s = (
        alarmed_s(fantwin("replay", folder / "other.mcap", "--offline", "--twin", twin, "--json").stdout)
        for twin in twins
    )
    assert strict_s > calibrated_s > wide_s


def alarmed_s(replayed: str) -> float:
    """How long fans were in alarm, all together."""
    alarms = json.loads(replayed)["alarms"]
    return sum((alarm["cleared_ns"] or 60_000_000_000) - alarm["raised_ns"] for alarm in alarms) / 1e9


def strict(folder: Path, calibrated: Path) -> Path:
    """The twin with limits that healthy fans exceed all the time, and a declared rate that is far lower."""
    return with_limits(folder / "strict.onnx", calibrated, 0.3)


def with_limits(path: Path, calibrated: Path, factor: float) -> Path:
    """The twin with so many times its limits, and a declared rate that is far lower."""
    from twin.export.card_entries import with_card_entries  # noqa: PLC0415

    was = Limits.model_validate(load_tray_twin(calibrated).card.calibration)
    assert was.declared_rate
    rate = was.declared_rate.model_copy(update={"false_alarms_per_day": 0.1})
    limits = was.times(factor).model_copy(update={"declared_rate": rate})
    path.write_bytes(with_card_entries(calibrated.read_bytes(), {"calibration": json.loads(limits.model_dump_json())}))
    return path


def test_the_output_is_readable(output_of_calibration: str) -> None:
    assert "calibrated.onnx: alarms calibrated on 0.06" in output_of_calibration
    assert f"declared: {PER_DAY} false alarms per fan and day" in output_of_calibration
    assert "--verify" in output_of_calibration
    assert re.search(r"found at \d+ rad/s: a drop of [\d.]+ rad/s at once", output_of_calibration)


def test_the_page_of_a_report_says_what_raises_an_alarm_as_the_terminal_does(
    folder: Path, calibrated: Path, output_of_calibration: str
) -> None:
    page = folder / "report.html"
    lines = [line for line in output_of_calibration.splitlines() if line.startswith("found at")]
    result = fantwin("report", calibrated, folder / "other.mcap", "-o", page)
    assert result.exit_code == 0, result.output
    assert lines and all(line in result.stdout and f"<li>{line}</li>" in page.read_text() for line in lines)


def test_json_is_one_document_of_the_limits_and_the_test_of_them(folder: Path) -> None:
    result = calibrate(folder, "-o", folder / "json.onnx", "--json", "--verify", folder / "other.mcap")
    document = json.loads(result.stdout)
    assert document["twin"].endswith("json.onnx")
    assert document["speed_unit"] == "rad/s"
    for drop in document["drops_found"]:
        assert 0 < drop["within_a_minute"] <= drop["at_once"] <= drop["speed"]
    Limits.model_validate(document["calibration"])
    assert document["verify"]["kept"] is True
    assert document["verify"]["fan_hours"] == pytest.approx(FANS * 60 / 3600, rel=0.1)


def test_without_an_output_the_twin_itself_is_calibrated(folder: Path) -> None:
    twin = folder / "in-place.onnx"
    twin.write_bytes((folder / "twin.onnx").read_bytes())
    result = fantwin("calibrate", twin, folder / "healthy.mcap", "--false-alarms-per-day", PER_DAY)
    assert result.exit_code == 0, result.output
    assert load_tray_twin(twin).card.calibration is not None


def test_extrapolated_limits_declare_a_target_only(folder: Path) -> None:
    output = folder / "extrapolated.onnx"
    result = fantwin(
        "calibrate", folder / "twin.onnx", folder / "healthy.mcap", "--false-alarms-per-day", 1, "--extrapolate",
        "-o", output,
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    assert "the data are too few to show whether these limits keep it" in result.stdout
    rate = Limits.model_validate(load_tray_twin(output).card.calibration).declared_rate
    assert rate
    assert rate.extrapolated


def test_only_the_wanted_part_of_each_recording_is_used(folder: Path) -> None:
    def learned(*part: object) -> dict[str, Any]:
        result = calibrate(folder, *part, "--extrapolate", "-o", folder / "part.onnx", "--json")
        assert result.exit_code == 0, result.output
        return json.loads(result.stdout)["calibration"]["declared_rate"]

    whole, part = learned(), learned("--from", 20, "--to", 90)
    assert set(whole["data"][0]) == {"name", "sha256"}
    assert (part["data"][0]["from_s"], part["data"][0]["to_s"]) == (20.0, 90.0)
    assert whole["fan_hours"] - part["fan_hours"] == pytest.approx(FANS * (120 - 70) / 3600, rel=0.05), (
        "commissioning is repeated in each"
    )
    error = error_of(
        "calibrate", folder / "twin.onnx", folder / "healthy.mcap", "--false-alarms-per-day", 1, "--from", 500
    )
    assert error.endswith("healthy.mcap: no samples from 500 s to inf s; see --from and --to")
    negative = calibrate(folder, "--from", -5, "-o", folder / "part.onnx")
    assert negative.exit_code == 2
    assert "--from" in negative.stderr
    verified = "--verify", folder / "other.mcap"
    assert error_of("calibrate", folder / "twin.onnx", "--to", 9, *verified).startswith("--to needs recordings")


def test_the_declared_rate_is_kept_on_other_healthy_recordings(folder: Path, calibrated: Path) -> None:
    result = fantwin("calibrate", calibrated, "--verify", folder / "other.mcap")
    assert result.exit_code == 0, result.output
    assert "kept" in result.stdout
    assert f"declared {PER_DAY}" in result.stdout
    assert len(result.stdout.strip().splitlines()) == 1


def test_a_declared_rate_that_is_not_kept_is_exit_code_3(folder: Path, calibrated: Path) -> None:
    result = fantwin("calibrate", strict(folder, calibrated), "--verify", folder / "other.mcap")
    assert result.exit_code == 3, result.output
    assert "declared 0.1: not kept" in result.stdout


@pytest.mark.parametrize("alarms", range(20))
def test_the_printed_interval_decides(alarms: int) -> None:
    check = Check(alarms, 100.0, 1.0)
    low, _ = check.interval_95
    assert check.text.endswith(": not kept") == check.is_broken == (low > 1.0)
    assert f"(95 %: {low:.2g} to " in check.text


def test_all_that_follows_verify_is_verified(folder: Path, calibrated: Path) -> None:
    more, other = folder / "more.mcap", folder / "other.mcap"
    simulated(more, 4, 30)
    words = expand_variadic(list(map(str, ("calibrate", calibrated, "--verify", other, more, "--json"))))
    result = fantwin(*words)
    assert json.loads(result.stdout)["verify"]["fan_hours"] == pytest.approx(FANS * 90 / 3600, rel=0.1)


def test_a_recording_in_which_something_was_wrong_is_named(folder: Path) -> None:
    bad = folder / "bad.mcap"
    simulated(bad, 5, 60, "--fault", "inlet:fan=1,start=20,stop=50,size=1.6")
    expected = (f"{bad}: tray1 fan 1 goes to", "times the limits that were found", "calibrate without this recording")
    result = calibrate(folder, bad, "-o", folder / "doubtful.onnx", "--json")
    (warning,) = json.loads(result.stdout)["warnings"]
    assert all(part in warning for part in expected)
    assert warning in result.stderr.splitlines()
    result = calibrate(folder, folder / "other.mcap", "-o", folder / "sure.onnx", "--json")
    assert json.loads(result.stdout)["warnings"] == []


def test_recordings_that_a_twin_was_made_from_cannot_verify_it_under_any_name(folder: Path, calibrated: Path) -> None:
    copy = folder / "copy.mcap"
    copy.write_bytes((folder / "healthy.mcap").read_bytes())
    error = error_of("calibrate", calibrated, "--verify", folder / "other.mcap", "--verify", copy)
    assert f"{copy}: {calibrated} was calibrated on it, so it proves nothing" in error
    error = error_of("calibrate", calibrated, "--verify", folder / "training.mcap")
    assert f"{calibrated} was trained on it" in error


def test_limits_are_found_for_the_times_that_the_scorer_is_set_to(folder: Path, calibrated: Path) -> None:
    output = folder / "slow.onnx"
    result = calibrate(folder, "-o", output, "--set", "scorer.smoothing_s=1.0")
    assert result.exit_code == 0, result.output
    slow, default = (Limits.model_validate(load_tray_twin(twin).card.calibration) for twin in (output, calibrated))
    of_tray = default_timing(2)
    assert (default.timing, slow.timing) == (of_tray, of_tray.model_copy(update={"smoothing_s": 1.0}))
    assert slow.detectors["speed_smoothed"] != default.detectors["speed_smoothed"]


def test_recordings_of_scorers_with_other_times_are_refused(folder: Path) -> None:
    slow, twin = folder / "slow.mcap", folder / "twin.onnx"
    result = fantwin(
        "replay", folder / "other.mcap", "--offline", "--twin", twin, "--set", "scorer.on_delay_s=1.0", "-o", slow
    )
    assert result.exit_code == 0, result.output
    error = error_of("calibrate", twin, folder / "healthy.mcap", slow, "--false-alarms-per-day", PER_DAY)
    assert f"healthy.mcap and {slow} differ in scorer.on_delay_s, which limits depend on: choose one" in error


def test_settings_that_do_not_affect_calibration_are_refused(folder: Path, calibrated: Path) -> None:
    error = error_of(
        "calibrate", folder / "twin.onnx", folder / "healthy.mcap", "--false-alarms-per-day", PER_DAY,
        "--set", "scorer.limit_factor=2",
    )  # fmt: skip
    assert "--set scorer.limit_factor: does not affect calibration" in error
    result = fantwin("calibrate", calibrated, "--verify", folder / "other.mcap", "--set", "scorer.off_delay_s=2.0")
    assert result.exit_code == 0, result.output


def test_a_rate_is_broken_only_by_more_alarms_than_chance_explains() -> None:
    assert not Check(0, 100.0, 1.0).is_broken
    assert not Check(7, 100.0, 1.0).is_broken  # 4.2 expected
    assert Check(10, 100.0, 1.0).is_broken
    assert not Check(0, 1e5, 1.0).is_broken, "fewer alarms than declared break nothing"
    low, high = Check(3, 72.0, 1.0).interval_95
    assert (low, high) == (pytest.approx(0.206, abs=0.001), pytest.approx(2.922, abs=0.001))
    assert math.isfinite(Check(0, 1.0, 1.0).interval_95[1])


def test_recordings_with_grids_of_different_rates_are_refused_by_name(folder: Path) -> None:
    slow, twin = folder / "half-rate.mcap", folder / "twin.onnx"
    result = fantwin(
        "replay", folder / "other.mcap", "--offline", "--twin", twin, "--set", "resampler.rate_hz=50", "-o", slow
    )
    assert result.exit_code == 0, result.output
    error = error_of("calibrate", twin, folder / "healthy.mcap", slow, "--false-alarms-per-day", PER_DAY)
    assert f"healthy.mcap and {slow} have grids of different rates, 100 Hz and 50 Hz" in error
    assert "\n" not in error


def test_a_fan_alone_and_fans_beside_others_are_not_calibrated_together(folder: Path) -> None:
    """What several share is followed apart, with slower baselines: limits hold for one of both."""
    alone, healthy, twin = folder / "alone.mcap", folder / "healthy.mcap", folder / "twin-of-one.onnx"
    simulated(alone, 4, 20, "--fans", 1)
    result = fantwin("train", alone, "--model", "physical", "-o", twin)
    assert result.exit_code == 0, result.output
    for recordings in ((healthy, alone), (alone, healthy)):
        error = error_of("calibrate", twin, *recordings, "--false-alarms-per-day", PER_DAY)
        assert f"{alone} has a tray of one fan and {healthy} one of 2" in error
        assert "calibrate twice, and write one of the twins to another file with -o" in error
        assert "\n" not in error

"""Samples 15 s apart, from a table to an alarm: what a static twin is and finds is said, and it finds it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.support.fantwin_command import fantwin
from tests.support.made_once import MadeOnce
from tests.support.slow_lines import slow_line

HOUR_S, PERIOD_S = 3600.0, 15.0


def recorded(folder: Path, name: str, seconds: float, seed: int, drag_from_s: float = np.inf) -> Path:
    table, recording = folder / f"{name}.csv", folder / f"{name}.mcap"
    columns = slow_line(seconds, PERIOD_S, 1.0, seed, drag_from_s=drag_from_s)
    np.savetxt(table, np.column_stack(columns), delimiter=",", header="t,pwm,rpm", comments="", fmt="%g")
    result = fantwin("import", table, "--time", "t:s", "--command", "pwm", "--speed", "rpm:rpm", "-o", recording)
    assert result.exit_code == 0 and "15 s apart" in result.stdout, result.output
    return recording


@pytest.fixture(scope="module")
def folder(made_once: MadeOnce) -> Path:
    """A twin of four hours, and other recordings."""

    def make(path: Path) -> None:
        recorded(path, "healthy", 4 * HOUR_S, 1)
        recorded(path, "other", 6 * HOUR_S, 2)
        recorded(path, "faulty", 2 * HOUR_S, 3, drag_from_s=HOUR_S)
        trained = fantwin("train", path / "healthy.mcap", "--command-unit", "pwm", "-o", path / "twin.onnx")
        assert trained.exit_code == 0, trained.output
        (path / "said.txt").write_text(trained.stdout)

    return made_once("slow-samples", make)


def alarms_of(folder: Path, name: str) -> list[dict]:
    result = fantwin("replay", folder / f"{name}.mcap", "--offline", "--twin", folder / "twin.onnx", "--json")
    assert result.exit_code == 0, result.output
    return json.loads(result.stdout)["alarms"]


def test_train_and_evaluate_say_what_a_static_twin_is_and_what_it_finds(folder: Path) -> None:
    said = (folder / "said.txt").read_text()
    assert "samples every 15 s hardly show the motion: a static twin, speed over command within " in said
    assert " rpm that lasts 1 min" in said and "not found: what is over within 30 s" in said
    judged = fantwin("evaluate", folder / "twin.onnx", folder / "other.mcap", "--json")
    result = json.loads(judged.stdout)
    assert result["static"] in said
    assert result["assessment"] == "as declared", result["headline"]


def test_its_report_has_its_curve_and_parameters(folder: Path) -> None:
    page = folder / "report.html"
    result = fantwin("report", folder / "twin.onnx", folder / "other.mcap", "-o", page)
    assert result.exit_code == 0, result.output
    text = page.read_text()
    assert "The speed over the command; samples every 15 s hardly show the motion." in text
    assert "time constant, s, at least the shortest that the samples show" in text


def test_ten_per_cent_more_drag_is_found_within_minutes_and_healthy_fans_have_no_alarm(folder: Path) -> None:
    assert alarms_of(folder, "other") == []
    first = alarms_of(folder, "faulty")[0]
    assert 0.0 <= first["raised_ns"] / 1e9 - HOUR_S <= 300.0


def test_it_is_calibrated_as_any_other_and_its_drops_have_times_that_its_samples_can_show(folder: Path) -> None:
    output = folder / "calibrated.onnx"
    words = ("--false-alarms-per-day", 1, "--extrapolate", "-o", output, "--json")
    result = fantwin("calibrate", folder / "twin.onnx", folder / "other.mcap", *words)
    assert result.exit_code == 0, result.output
    drops = json.loads(result.stdout)["drops_found"]
    assert all(drop["within_1_s"] is None and drop["within_600_s"] <= 0.05 * drop["speed"] for drop in drops)

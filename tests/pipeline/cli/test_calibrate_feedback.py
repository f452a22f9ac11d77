"""`fantwin calibrate` on a recording with an alarm: what an operator said of it decides what is learned."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.cli.in_parallel import RecordingsInParallel
from fantwin.pipeline.cli.main import expand_variadic
from fantwin.pipeline.learning.healthy_evidence import check_declared_rate
from fantwin.pipeline.replay.offline.alarm_episodes import alarms_in, marked_alarms
from fantwin.schemas.enums import Action
from fantwin.schemas.messages import Alarm
from fantwin.scoring.model.priors import Priors
from tests.support.fantwin_command import fantwin
from tests.support.healthy_site import FANS, FAULT_S, OTHER_S, PER_DAY, changed, with_alarm


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

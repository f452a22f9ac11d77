"""Fans under speed controllers, by the commands of a user: the loop is named, and faults in it get their causes."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.learning.loops_found import closed_loops
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm
from fantwin.twin.runs import Run
from tests.support.controlled_fans import Fault, plain_fans, run_with, runs_of
from tests.support.fantwin_command import error_of, fantwin
from tests.support.made_once import MadeOnce
from tests.support.written_recordings import write_run

FANS, RATE_HZ, FAULT_AFTER_S = 2, 10.0, 120.0


@pytest.fixture(scope="module")
def folder(made_once: MadeOnce) -> Path:
    """Three recordings of healthy fans in a loop, and twin.onnx of these."""

    def make(folder: Path) -> None:
        for number, name in enumerate(("training", "validation", "healthy")):
            run = runs_of(["PI fast"], plain_fans(FANS, 7), 300.0, RATE_HZ, seed=number)["PI fast"]
            write_run(folder / f"{name}.mcap", run)

    return made_once("closed-loop", make)


@pytest.fixture(scope="module")
def trained(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str, str]:
    twin = tmp_path_factory.mktemp("trained") / "twin.onnx"
    train = fantwin(
        "train", folder / "training.mcap", "--validate", folder / "validation.mcap", "--model", "physical", "-o", twin
    )
    healthy = (folder / "validation.mcap", folder / "healthy.mcap")
    calibrate = fantwin("calibrate", twin, *healthy, "--false-alarms-per-day", 1, "--extrapolate")
    return twin, train.output, calibrate.output


def judged(twin: Path, run: Run, folder: Path) -> tuple[Path, list[Alarm]]:
    recording, output = write_run(folder / "run.mcap", run), folder / "judged.mcap"
    done = fantwin("replay", recording, "--offline", "--twin", twin, "-o", output)
    assert done.exit_code == 0, done.output
    return output, [one.message for one in read_recording(output, ("alarm",)) if isinstance(one.message, Alarm)]


def test_training_calibration_card_and_recordings_say_that_the_fans_are_in_a_loop(
    trained: tuple[Path, str, str], tmp_path: Path
) -> None:
    twin, of_train, of_calibrate = trained
    line = "closed loop: the command of fans 0, 1 answers the measured speed"
    assert of_train.count(line) == of_calibrate.count(line) == 1
    run = runs_of(["PI fast"], plain_fans(FANS, 7), 60.0, RATE_HZ, seed=8)["PI fast"]
    recording, alarms = judged(twin, run, tmp_path)
    assert not alarms
    assert "closed loop: yes" in fantwin("info", recording).stdout
    (found,) = json.loads(fantwin("info", recording, "--json").stdout)["files"]
    assert found["twins"]["tray1"]["closed_loop"] is True


def test_a_loop_that_training_did_not_see_is_found_in_the_recordings_of_a_calibration(
    trained: tuple[Path, str, str], folder: Path, tmp_path: Path
) -> None:
    of_a_sweep = replace(load_tray_twin(trained[0]).card, closed_loop=())
    run = runs_of(["open"], plain_fans(FANS, 7), 120.0, RATE_HZ, seed=8)["open"]
    swept = write_run(tmp_path / "swept.mcap", run)
    assert closed_loops(of_a_sweep, [swept], None) == (False, False)
    assert closed_loops(of_a_sweep, [swept, folder / "healthy.mcap"], "tray1") == (True, True)


def test_a_set_point_that_rests_gives_no_numbers_and_says_what_to_record(tmp_path: Path) -> None:
    run = runs_of(["PI slow, rests"], plain_fans(FANS, 7), 120.0, RATE_HZ, seed=1)["PI slow, rests"]
    recording = write_run(tmp_path / "rests.mcap", run)
    for command, *options in (("train", "-o", str(tmp_path / "twin.onnx")), ("report",)):
        assert error_of(command, recording, *options).startswith(
            "fan 0: closed loop at one set-point: the command answers the noise"
        )
    assert not (tmp_path / "twin.onnx").exists()


@pytest.mark.parametrize(
    ("fault", "cause"),
    [({"drag": 1.2}, "drag_up"), ({"drag": 0.8}, "drag_down"), ({"supply": 0.9}, "gain_down")],
    ids=lambda of: of if isinstance(of, str) else "",
)
def test_a_fault_that_a_controller_hides_is_found_in_the_command_and_named(
    fault: dict[str, Any], cause: str, trained: tuple[Path, str, str], tmp_path: Path
) -> None:
    what = Fault(np.arange(FANS) == 1, FAULT_AFTER_S, **fault)
    run = run_with("PI fast", plain_fans(FANS, 7), 400.0, RATE_HZ, 9, what)
    _, alarms = judged(trained[0], run, tmp_path)
    raised = [each for each in alarms if each.transition == Transition.RAISED]
    assert [each.fan for each in raised] == [1]
    assert 0.0 < raised[0].t_ns / 1e9 - FAULT_AFTER_S < 60.0
    named = [each.causes[0].cause for each in alarms if each.active and each.causes]
    assert named[-1] == cause, named

"""`fantwin report`, `train` and `evaluate` on recordings, from the command line to the ONNX file."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.learning.training_data import TrainingData
from fantwin.schemas.tacho import INSTANTANEOUS, Tacho
from fantwin.twin.export.onnx_twin import OnnxTwin
from fantwin.twin.runs import Run
from tests.support import fan_data
from tests.support.fan_data import NOISE_RAD_S, PUBLISHED_PARAMETERS, counted_run, published_run
from tests.support.fantwin_command import error_of, fantwin
from tests.support.made_once import MadeOnce
from tests.support.written_recordings import write_run

RPM = 60 / (2 * np.pi)


@pytest.fixture(scope="module")
def folder(made_once: MadeOnce) -> Path:
    """Recordings of the published fan: one in rad/s, the same in rpm, one held out, one of two fans; its twin."""

    def make(path: Path) -> None:
        write_run(path / "healthy.mcap", published_run(1))
        write_run(path / "healthy-rpm.mcap", published_run(1), unit="rpm")
        write_run(path / "held-out.mcap", published_run(2))
        write_run(path / "two.mcap", published_run(3, fans=2))
        result = fantwin("train", path / "healthy.mcap", "--model", "physical", "-o", path / "physical.onnx")
        assert result.exit_code == 0, result.output

    return made_once("published", make)


@pytest.fixture(scope="module")
def twin(folder: Path) -> Path:
    return folder / "physical.onnx"


def test_identify_finds_the_published_fan(folder):
    result = json.loads(fantwin("report", folder / "healthy.mcap", "--json").stdout)
    (fan,) = result["fans"]
    for name, published in zip(("J", "alpha", "C_D"), PUBLISHED_PARAMETERS, strict=True):
        low, high = fan[f"{name}_95"]
        assert low < fan[name] < high
        assert fan[name] == pytest.approx(published, rel=0.15)
    assert result["speed_unit"] == "rad/s"
    shown = fantwin("report", folder / "two.mcap").stdout
    assert "rmse" in shown
    assert [row[0] for line in shown.splitlines() if (row := line.split()) and row[0].isdigit()] == ["0", "1"]


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_parameter_that_the_fit_drove_to_its_bound_has_no_interval(tmp_path: Path) -> None:
    """A step test of a thrust stand: at rest, one step, at rest again, four samples a second."""
    speeds = [20, 6000, 8700, *[8650, 8700] * 8, 8650, 7780, 4351, 2813, 2013, 1494, 1121, 838, 661, 518]
    rows = [(1000, 0)] * 36 + [(1650 if k < 20 else 1000, rpm) for k, rpm in enumerate(speeds)] + [(1000, 0)] * 11
    lines = (f"{0.25 * k:.2f},{us},{rpm}" for k, (us, rpm) in enumerate(rows))
    table, recording = tmp_path / "rig.csv", tmp_path / "rig.mcap"
    table.write_text("\n".join(["Time (s),us,rpm", *lines]))
    fantwin("import", table, "--command", "us", "--speed", "rpm:rpm", "-o", recording)
    result = fantwin("report", recording)
    assert result.exit_code == 0, result.output
    assert "alpha is not distinguishable from zero (the fit drove it there)" in result.stderr
    cells = [line.split() for line in result.stdout.splitlines()]
    (row,) = (k for k, line in enumerate(cells) if line and line[0] == "0")
    assert re.fullmatch(r"± \S+ - ± \S+", " ".join(cells[row + 1]))
    assert "-: the fit drove the value to its bound, which has no interval" in result.stdout
    trained = fantwin("train", recording, "--model", "physical", "-o", tmp_path / "rig.onnx")
    assert trained.exit_code == 0, trained.output


def test_a_supply_voltage_that_is_ignored_is_as_if_it_were_not_there(folder, tmp_path):
    run = published_run(1)
    volts = np.full_like(run.command, 12.0)
    volts[len(volts) // 2 :] = 6.0
    bad = write_run(tmp_path / "bad.mcap", replace(run, auxiliary={"supply_voltage_v": volts}))
    found = json.loads(fantwin("report", bad, "--json").stdout)
    assert any(line.startswith("supply voltage: not used") for line in found["warnings"])
    plain = json.loads(fantwin("report", folder / "healthy.mcap", "--json").stdout)
    ignored = json.loads(fantwin("report", bad, "--ignore", "supply_voltage_v", "--json").stdout)
    assert ignored == plain
    good = write_run(tmp_path / "good.mcap", replace(run, auxiliary={"supply_voltage_v": np.full_like(volts, 12.0)}))
    assert "allows for supply voltage (reference 12 V)" in fantwin("report", good).stdout
    twin = tmp_path / "t.onnx"
    for options, needed in (((), ("supply_voltage_v",)), (("--ignore", "supply_voltage_v"), ())):
        done = fantwin("train", good, "--model", "physical", *options, "-o", twin)
        assert done.exit_code == 0, done.output
        says = "allows for supply voltage (reference 12 V), and needs the column supply_voltage_v\n"
        assert (says in done.stdout) == bool(needed)
        conditions = OnnxTwin(twin).card.conditions
        assert (conditions.needed if conditions else ()) == needed


def test_the_tacho_of_a_recording_counts_and_readings_that_speak_for_another_are_pointed_out(tmp_path):
    tacho = Tacho(kind="count", window_s=0.53)
    run = counted_run(1, tacho, 60.0)
    declared = write_run(tmp_path / "declared.mcap", run)
    undeclared = write_run(tmp_path / "undeclared.mcap", replace(run, tacho=INSTANTANEOUS))
    inertia, hints = {}, {}
    for path in (declared, undeclared):
        result = json.loads(fantwin("report", path, "--json").stdout)
        inertia[path], hints[path] = result["fans"][0]["J"], result["hints"]
    assert inertia[declared] == pytest.approx(PUBLISHED_PARAMETERS[0], rel=0.3)
    assert inertia[undeclared] > 2.0 * PUBLISHED_PARAMETERS[0]
    assert hints[declared] == []
    given = json.loads(fantwin("report", undeclared, "--window", "0.53", "--json").stdout)
    assert (given["fans"][0]["J"], given["hints"]) == (inertia[declared], [])
    assert hints[undeclared][0].startswith("fan 0: readings are multiples of 56.6 rpm and change every 0.53 s: a count")
    mixed = error_of("train", declared, undeclared, "--model", "physical", "-o", tmp_path / "twin.onnx")
    assert "give runs that are measured alike" in mixed
    trained = fantwin("train", declared, "--model", "physical", "-o", tmp_path / "twin.onnx")
    assert "by the tacho alone" in trained.stdout
    assert OnnxTwin(tmp_path / "twin.onnx").card.tacho == (tacho,)


def test_recordings_of_other_fans_are_named_before_anything_is_made_of_them(folder, twin, tmp_path):
    one, two = folder / "healthy.mcap", folder / "two.mcap"
    expected = f"recordings of different numbers of fans, 1 ({one}) and 2 ({two}): give those of one tray"
    page = tmp_path / "page.html"
    for words in (
        ("evaluate", twin, one, two),
        ("report", twin, one, two, "-o", page),
        ("train", one, two, "-o", tmp_path / "t.onnx"),
        ("train", one, "--validate", two, "-o", tmp_path / "t.onnx"),
    ):
        assert error_of(*words).startswith(expected)
        assert not list(tmp_path.iterdir())


def test_ctrl_c_during_training_leaves_no_twin(folder, tmp_path, monkeypatch):
    def interrupted(*_arguments, **_options):
        raise KeyboardInterrupt

    monkeypatch.setattr("fantwin.twin.fitting.reference_choice.identify", interrupted)
    result = fantwin("train", folder / "healthy.mcap", "--model", "physical", "-o", tmp_path / "twin.onnx")
    assert (result.exit_code, list(tmp_path.iterdir())) == (130, [])
    assert result.stderr.splitlines()[-1].startswith("interrupted: no twin was written")


def evaluated(*words: object) -> dict[str, Any]:
    return json.loads(fantwin("evaluate", *words, "--json").stdout)


def test_the_error_of_a_good_twin_is_the_noise_in_the_recordings_own_unit(folder, twin, tmp_path):
    result = evaluated(twin, folder / "held-out.mcap")
    assert result["rmse"] == pytest.approx(np.sqrt(10), rel=0.05)
    assert result["r2"] > 0.98
    assert result["coverage_2_sigma"] == pytest.approx(0.954, abs=0.02)
    truncated = tmp_path / "truncated.mcap"
    truncated.write_bytes((folder / "healthy.mcap").read_bytes()[:-100])
    damaged = fantwin("evaluate", twin, truncated, "--json")
    assert "truncated.mcap: it is truncated" in damaged.stderr
    radians, rpm = json.loads(damaged.stdout), evaluated(twin, folder / "healthy-rpm.mcap")
    assert (radians["speed_unit"], rpm["speed_unit"]) == ("rad/s", "rpm")
    for figure in ("rmse", "max_error", "one_step_rmse"):
        assert rpm[figure] == pytest.approx(radians[figure] * RPM)
    for figure in ("r2", "coverage_2_sigma", "samples"):
        assert rpm[figure] == radians[figure]
    assert " rpm, max error " in fantwin("evaluate", twin, folder / "healthy-rpm.mcap").stdout


def test_warnings_name_the_recordings_fans_together_and_speeds_in_their_unit():
    data = TrainingData([], [], "rpm", [3, 5], ("b.mcap: fan 3: outliers",))
    slow = "the speed keeps between 44 and 1.2e+02 rad/s"
    warnings = ["fans 0, 1: they miss the speed by 5.9 rad/s", f"fan 0: {slow}", "too short", f"fan 1: {slow}"]
    assert data.with_fan_numbers(warnings) == [
        "b.mcap: fan 3: outliers",
        "fans 3, 5: they miss the speed by 56.3 rpm",
        "fans 3, 5: the speed keeps between 420 and 1150 rpm",
        "too short",
    ]
    assert replace(data, speed_unit="rad/s").with_fan_numbers(warnings[:1]) == [
        data.outliers[0],
        "fans 3, 5: they miss the speed by 5.9 rad/s",
    ]


def test_a_part_of_a_recording_and_some_of_its_fans_can_be_used(folder, twin, tmp_path):
    part = evaluated(twin, folder / "two.mcap", "--from", 10, "--to", 25)
    assert (part["samples"], len(part["fans"])) == (2 * 1500, 2)
    assert evaluated(twin, folder / "two.mcap", "--from", 10, "--to", 25, "--fans", 1)["fans"] == [part["fans"][1]]
    healthy = folder / "healthy.mcap"
    words = ("--to", 20, "--validate", healthy, "--model", "physical", "--json")
    result = json.loads(fantwin("train", healthy, *words, "-o", tmp_path / "part.onnx").stdout)
    assert (result["evaluated_on"], result["samples"]) == ("held-out", 2000)


@pytest.mark.usefixtures("undrawn")
def test_a_twin_is_not_judged_by_samples_that_made_it_and_others_of_the_same_recording_judge_it(folder, tmp_path):
    twin, validated = tmp_path / "part.onnx", tmp_path / "validated.onnx"
    words = ("train", folder / "healthy.mcap", "--to", 20, "--model", "physical", "-o")
    assert fantwin(*words, twin).exit_code == 0
    assert fantwin(*words, validated, "--validate", folder / "healthy.mcap").exit_code == 0
    page, training = tmp_path / "page.html", "healthy.mcap: used in training"
    choosing = "healthy.mcap: used to choose the model and its band"
    for of, part, used in (
        (twin, (), [training]),
        (twin, ("--from", 20), []),
        (validated, (), [training, choosing]),
        (validated, ("--to", 20), [training]),
        (validated, ("--from", 20), [choosing]),
    ):
        for name, more in (("evaluate", ()), ("report", ("-o", page))):
            found = json.loads(fantwin(name, of, folder / "healthy.mcap", *part, *more, "--json").stdout)
            said = [line.partition(",")[0] for line in found["warnings"] if "used " in line]
            assert (found["assessment"], said) == ("not tested" if used else "as declared", used)
            assert found["headline"].startswith("Not tested: healthy.mcap made this twin") == bool(used)
        assert found["fans"][0]["assessment"] == found["assessment"]
        assert found["headline"] in page.read_text()
    assert evaluated(validated, folder / "held-out.mcap")["assessment"] == "as declared"


def test_outliers_are_left_out_in_every_evaluation_of_a_twin(tmp_path):
    run = published_run(7)
    speed = run.speed_rad_s.copy()
    speed[50::97] = 0.0
    for name, part in (("learn", run.between(0.0, 25.0)), ("judge", run.between(25.0, 40.0))):
        glitched = speed[:2500] if name == "learn" else speed[2500:]
        write_run(tmp_path / f"{name}.mcap", Run(name, part.t_s, part.command, glitched))
    twin, judge = tmp_path / "twin.onnx", tmp_path / "judge.mcap"
    trained = fantwin(
        "train", tmp_path / "learn.mcap", "--validate", judge, "--model", "physical", "-o", twin, "--json"
    )
    result = json.loads(trained.stdout)
    evaluated = json.loads(fantwin("evaluate", twin, judge, "--json").stdout)
    assert result["rmse"] == pytest.approx(evaluated["rmse"], rel=1e-6)
    assert result["rmse"] < 1.05 * NOISE_RAD_S
    assert any("of the speeds are outliers" in line for line in result["warnings"])
    assert any("of the speeds are outliers" in line for line in evaluated["warnings"])


@pytest.fixture(scope="module")
def recorded(made_once: MadeOnce) -> tuple[Path, Path]:
    """A twin and a recording of two fans."""

    def make(folder: Path) -> None:
        recording = write_run(folder / "two.mcap", fan_data.published_run(4, 15.0, fans=2), unit="rpm")
        trained = fantwin("train", recording, "--model", "narx", "--iterations", 1, "-o", folder / "twin.onnx")
        assert trained.exit_code == 0, trained.output

    folder = made_once("evaluated", make)
    return folder / "twin.onnx", folder / "two.mcap"


def test_the_json_of_evaluate_has_other_grids_and_the_residual_analysis(recorded: tuple[Path, Path]) -> None:
    arguments = ("--rate", "50", "--rate", "irregular", "--json")
    result = json.loads(fantwin("evaluate", *recorded, *arguments).stdout)
    assert [(grid["rate"], grid["samples"], len(grid["fans"])) for grid in result["grids"][:1]] == [(50.0, 1500, 2)]
    assert result["grids"][1]["rate"] == "irregular"
    assert result["grids"][0]["rmse"] != result["rmse"]
    assert result["expected_coverage_2_sigma"] == pytest.approx(0.9545, abs=1e-4)
    for fan in result["fans"]:
        left = fan["residual"]
        assert left["samples"] == 1500 - 300
        assert len(left["cross_lags_s"]) == 2 * len(left["lags_s"]) + 1 > 200
        assert left["white"] == (left["ljung_box_p"] >= 0.05)


@pytest.mark.usefixtures("undrawn")
def test_evaluate_shows_a_row_for_each_fan_and_each_grid_and_warns_as_the_report_does(
    recorded: tuple[Path, Path], tmp_path: Path
) -> None:
    evaluated = fantwin("evaluate", *recorded, "--rate", "12.5", "--rate", "irregular")
    rows = re.findall(r"^ ([\d.]+ Hz|\d+|all|recorded|irregular) ", evaluated.stdout, re.MULTILINE)
    assert rows == ["0", "1", "all", "recorded", "12.5 Hz", "irregular"]
    assert "free run: rmse" in evaluated.stdout.splitlines()[1]
    alone = json.loads(fantwin("evaluate", *recorded, "--json").stdout)
    one_fan = (*recorded, "--fans", "1", "--json")
    of_one = json.loads(fantwin("evaluate", *one_fan).stdout)
    reported = json.loads(fantwin("report", *one_fan, "-o", tmp_path / "page.html").stdout)
    for key in ("warnings", "assessment", "headline"):
        assert of_one[key] == reported[key]
    assert "two.mcap: used in training" in alone["warnings"][0]
    assert evaluated.stderr.splitlines() == alone["warnings"]


@pytest.fixture(scope="module")
def tray(made_once: MadeOnce) -> Path:
    """A folder with a recording of three fans that differ, and a twin of the first and the last."""

    def make(folder: Path) -> None:
        recording = write_run(folder / "three.mcap", fan_data.rough_run(5, 15.0, fans=3))
        write_run(folder / "two.mcap", fan_data.rough_run(5, 15.0, fans=2))
        made = fantwin("train", recording, "--fans", "0,2", "--model", "physical", "-o", folder / "twin.onnx")
        assert made.exit_code == 0, made.output

    return made_once("three-fans", make)


@pytest.mark.usefixtures("undrawn")
def test_a_card_names_the_fans_it_is_of_and_a_fan_is_judged_by_its_own_parameters(tray: Path, tmp_path: Path) -> None:
    twin, recording = tray / "twin.onnx", tray / "three.mcap"
    assert OnnxTwin(twin).card.training.fans == (0, 2)
    both = json.loads(fantwin("evaluate", twin, recording, "--fans", "0,2", "--rate", "50", "--json").stdout)
    last = json.loads(fantwin("evaluate", twin, recording, "--fans", "2", "--rate", "50", "--json").stdout)
    assert last["fans"] == [both["fans"][1]]
    assert last["grids"][0]["fans"] == [both["grids"][0]["fans"][1]]
    page = tmp_path / "page.html"
    reported = json.loads(fantwin("report", twin, recording, "--fans", "2", "-o", page, "--json").stdout)
    assert [fan["fan"] for fan in reported["fans"]] == [2]
    assert reported["fans"][0]["rmse"] == last["rmse"]
    parameters = OnnxTwin(twin).parameters
    assert f'<data value="{parameters[1, 0]}">' in page.read_text()
    assert f'<data value="{parameters[0, 0]}">' not in page.read_text()

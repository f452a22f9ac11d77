"""`fantwin evaluate`: what it prints for people and for machines."""

import json
import re
from pathlib import Path

import pytest

from fantwin.twin.export.onnx_twin import OnnxTwin
from tests.support import fan_data
from tests.support.fantwin_command import fantwin
from tests.support.made_once import MadeOnce
from tests.support.written_recordings import write_run


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

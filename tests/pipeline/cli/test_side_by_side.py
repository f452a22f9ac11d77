"""`fantwin train` of several models: each is trained, judged by data it has not seen, and kept as it was judged."""

import json
from pathlib import Path

import pytest

from fantwin.twin.build import train_twin
from fantwin.twin.comparison import Contender, best
from fantwin.twin.errors import TwinError
from fantwin.twin.kinds import KINDS
from tests.support.fan_data import rough_run
from tests.support.fantwin_command import fantwin
from tests.support.made_once import MadeOnce
from tests.support.written_recordings import write_run

FIGURES = ("rmse", "max_error", "r2", "one_step_rmse", "coverage_2_sigma")


@pytest.fixture(scope="module")
def folder(made_once: MadeOnce) -> Path:
    """Three recordings, and the twins of all models on them after few iterations."""

    def make(path: Path) -> None:
        for seed, name in ((1, "healthy"), (2, "held-out"), (3, "untouched")):
            write_run(path / f"{name}.mcap", rough_run(seed, 12.0), unit="rpm")
        parts = ("--validate", path / "held-out.mcap", "--test", path / "untouched.mcap")
        result = fantwin(
            "train", path / "healthy.mcap", *parts, "--model", "all", "--iterations", 3, "-o", path / "twins", "--json"
        )
        assert result.exit_code == 0, result.output
        (path / "compared.json").write_text(result.stdout)

    return made_once("compared", make)


@pytest.fixture(scope="module")
def compared(folder: Path) -> dict:
    return json.loads((folder / "compared.json").read_text())


def test_all_models_are_there_and_the_best_has_the_smallest_error_over_the_untouched_recordings(compared):
    counts = {its["model"]: its["network_parameters"] for its in compared["models"]}
    assert counts == {"physical": 0, "narx": 1151, "neural-ode": 81, "hybrid": 41, "hybrid-w": 31}
    assert compared["evaluated_on"] == "test"
    errors = {its["model"]: its["figures"]["test"]["rmse"] for its in compared["models"]}
    assert compared["best"] == min(errors, key=errors.__getitem__)


def test_a_saved_twin_gives_on_each_recording_the_figures_that_were_printed(folder, compared):
    assert json.loads((folder / "twins" / "comparison.json").read_text()) == compared
    for its in (models := compared["models"]):
        evaluated = json.loads(fantwin("evaluate", its["twin"], folder / "untouched.mcap", "--json").stdout)
        for figure in FIGURES:
            assert evaluated[figure] == pytest.approx(its["figures"]["test"][figure], rel=1e-4), (its, figure)
    held_out, trained_on = (
        json.loads(fantwin("evaluate", models[-1]["twin"], folder / f"{recording}.mcap", "--json").stdout)
        for recording in ("held-out", "healthy")
    )
    assert held_out["rmse"] == pytest.approx(models[-1]["figures"]["held-out"]["rmse"], rel=1e-4)
    assert trained_on["rmse"] == pytest.approx(models[-1]["training_rmse"], rel=1e-4)


def test_the_untouched_recordings_take_no_part_in_training(folder, compared, tmp_path):
    arguments = ("--validate", folder / "held-out.mcap", "--iterations", 3, "--model", "physical,hybrid", "--json")
    without = json.loads(fantwin("train", folder / "healthy.mcap", *arguments, "-o", tmp_path).stdout)
    assert without["evaluated_on"] == "held-out"
    (alone,), (among,) = ([its for its in of["models"] if its["model"] == "hybrid"] for of in (without, compared))
    assert alone["figures"] == {"held-out": among["figures"]["held-out"]}


def test_without_other_recordings_it_says_that_the_figures_are_too_optimistic(folder, tmp_path):
    arguments = (folder / "healthy.mcap", "--model", "physical,hybrid-w", "--iterations", 1, "-o", tmp_path)
    said = fantwin("train", *arguments).stdout
    assert "the training recordings, which is too optimistic" in said
    result = json.loads((tmp_path / "comparison.json").read_text())
    its, _ = result["models"]
    assert (result["evaluated_on"], list(its["figures"])) == ("training", ["training"])
    assert its["training_rmse"] == pytest.approx(its["figures"]["training"]["rmse"])


def test_the_table_fits_a_terminal_marks_the_best_and_has_a_row_for_a_model_that_cannot_be_trained(
    folder, tmp_path, monkeypatch
):
    def train_or_diverge(runs, validation_runs, kind, **options):
        if kind == "narx":
            raise TwinError("the narx model diverges")
        return train_twin(runs, validation_runs, kind, **options)

    monkeypatch.setattr("fantwin.twin.build.train_twin", train_or_diverge)
    validate = ("--validate", folder / "held-out.mcap", "--test", folder / "untouched.mcap")
    chosen = ("--model", "hybrid-w,physical,narx", "--iterations", 1, "-o", tmp_path)
    shown = fantwin("train", folder / "healthy.mcap", *validate, *chosen)
    assert shown.exit_code == 0
    assert "NARX: not trained: the narx model diverges" in shown.stderr
    lines = shown.stdout.splitlines()
    rows = [line.strip() for line in lines if line.strip().startswith(("hybrid", "physical", "NARX"))]
    assert [row.split("  ")[0].strip(" *") for row in rows][1:] == ["physical", "NARX"]
    assert rows[0].startswith("hybrid [w]")
    assert sum("*" in row for row in rows) == 1
    assert not any("…" in line for line in lines)
    assert "* best: smallest free-run rmse over the test recordings" in " ".join(lines)
    failed = json.loads((tmp_path / "comparison.json").read_text())["models"][2]
    assert failed == {"model": "narx", "title": "NARX", "invalid_reason": "the narx model diverges"}


def test_if_no_model_could_be_trained_the_error_has_the_reason():
    with pytest.raises(TwinError, match="nothing moved"):
        best([Contender(kind, invalid_reason="nothing moved") for kind in KINDS])

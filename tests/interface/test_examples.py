"""The examples of the Python interface run: those of its docstrings, of the guide, and the notebook."""

from __future__ import annotations

import doctest
import json
import re
import warnings
from importlib import import_module
from pathlib import Path
from typing import Any

import matplotlib as mpl
import pytest

import fantwin
from tests.interface.test_making import table_of

ROOT = Path(__file__).parents[2]
GUIDE = ROOT / "docs" / "how-to" / "python.md"
NOTEBOOK = ROOT / "examples" / "notebook" / "fan.ipynb"
LARGEST_NOTEBOOK_BYTES = 300_000


def cells() -> list[dict[str, Any]]:
    return [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]


def run(blocks: list[str]) -> dict[str, Any]:
    """The names that blocks of code define, one after the other."""
    names: dict[str, Any] = {}
    for number, block in enumerate(blocks):
        exec(compile(block, f"block {number}", "exec"), names)
    return names


@pytest.mark.parametrize("module", ["columns", "twin"])
def test_the_examples_in_docstrings_show_what_comes_out(module):
    found = doctest.testmod(import_module(f"fantwin.interface.{module}"))
    assert found.attempted > 0 and found.failed == 0


@pytest.mark.slow
def test_the_notebook_runs_and_finds_its_fault(monkeypatch):
    monkeypatch.setattr(mpl, "use", mpl.use("Agg"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fantwin.FantwinWarning)
        names = run(["".join(cell["source"]) for cell in cells()])
    assert list(names["alarms"]["cause"]) == ["drag_up"] and 30.0 < names["alarms"]["raised"][0] < 33.0
    assert names["figures"].rmse * 30 / 3.14159 < 1.1 * 20.0, "about the noise"
    assert abs(names["speeds"].detach()[-1] - 5500.0) < 200.0, "the commands found bring the fan there"


def test_the_notebook_is_kept_with_its_pictures_and_small():
    pictures = [output for cell in cells() for output in cell["outputs"] if "image/png" in output.get("data", {})]
    assert len(pictures) == 3 and NOTEBOOK.stat().st_size < LARGEST_NOTEBOOK_BYTES
    assert not [output for cell in cells() for output in cell["outputs"] if output["output_type"] == "error"]


@pytest.mark.slow
def test_the_code_of_the_guide_runs_as_it_is_written_but_for_a_shorter_training(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, seed, seconds in (("healthy", 1, 30.0), ("other", 2, 10.0), ("run", 3, 10.0)):
        table_of(seed, seconds).to_csv(f"{name}.csv", index=False)
    blocks = re.findall(r"```python\n(.*?)```", GUIDE.read_text(encoding="utf-8"), re.DOTALL)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fantwin.FantwinWarning)
        names = run([block.replace('name="fan")', 'name="fan", iterations=5, networks=1)') for block in blocks])
    assert isinstance(names["twin"], fantwin.Twin) and names["scored"]["score"].max() < 1.0
    assert {"predicted_rpm", "lower_rpm", "score", "state", "cause", "probability"} <= set(names["scored"])

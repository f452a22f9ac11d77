"""Commands on a recording of fans with names: each fan is shown by its name first, and chosen by it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from fantwin.schemas.header import Header
from tests.support.fan_data import published_run
from tests.support.fantwin_command import error_of, fantwin
from tests.support.score_data import START_NS, made_up_tray
from tests.support.small_recordings import write
from tests.support.wear_data import worn_snapshot
from tests.support.written_recordings import write_run

NAMES = ["CPU", "rear top", "GPU"]
METADATA = {"fan_names.tray1": json.dumps(NAMES)}


@pytest.fixture(scope="module")
def scored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scores, the alarm of fan 2, and the wear of all."""
    scores, alarms = made_up_tray()
    named = [replace(each, fan_name="GPU", message=f"GPU (fan 2): {each.about}") for each in alarms]
    alarms = [replace(each, header=Header("scorer-1", number, "tray1")) for number, each in enumerate(named)]
    wear = replace(worn_snapshot("tray1", 3, 1, START_NS, 30), header=Header("scorer-1", 0, "tray1"))
    about = {"site": "plant", "trays": "tray1", "fans.tray1": "3", "speed_unit.tray1": "rpm", **METADATA}
    return write(tmp_path_factory.mktemp("named") / "r.mcap", [*scores, *alarms, wear], about)


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_run(tmp_path_factory.mktemp("raw") / "raw.mcap", published_run(1, 20.0, fans=3), **METADATA)


def shown(name: str, *words: object) -> str:
    done = fantwin(name, *words)
    assert done.exit_code in (0, 1), done.stderr
    return " ".join(done.stdout.split())


def document(name: str, *words: object) -> dict[str, Any]:
    return json.loads(fantwin(name, *words, "--json").stdout)


def test_a_recording_is_listed_exported_and_drawn_with_the_names_of_its_fans(scored: Path, tmp_path: Path) -> None:
    assert "tray tray1, 3 fans (CPU (fan 0), rear top (fan 1), GPU (fan 2)), speeds in rpm" in shown("info", scored)
    shown("export", scored, "--to", "csv", "-o", tmp_path / "r.csv", "--topic", "score")
    table = pd.read_csv(tmp_path / "r.csv")
    assert dict(zip(table["fan"], table["fan_name"], strict=True)) == dict(enumerate(NAMES))
    assert f"{tmp_path}/r.svg: GPU (fan 2)" in shown("view", scored, "--fans", "gpu", "-o", tmp_path / "r.svg")
    assert "no fan called 'case'; there are CPU (fan 0), rear top (fan 1), GPU (fan 2)" in error_of(
        "view", scored, "--fans", "case", "-o", tmp_path / "r.svg"
    )


def test_alarms_and_wear_of_a_recording_name_the_fans(scored: Path) -> None:
    history = ("alarms", "--history", "--recordings", scored)
    assert "tray1 GPU (fan 2)" in shown(*history)
    assert {each["name"] for each in document(*history)["alarms"]} == {"GPU"}
    assert "rear top (fan 1)" in shown("info", "--wear", scored)
    assert {row["fan"]: row["name"] for row in document("info", "--wear", scored)["wear"]} == dict(enumerate(NAMES))


def test_fans_are_identified_by_name(raw: Path) -> None:
    (found,) = document("report", raw, "--fans", "rear top")["fans"]
    assert (found["fan"], found["name"]) == (1, "rear top")


def test_a_twin_is_refused_for_its_own_fans_in_another_order(raw: Path, tmp_path: Path) -> None:
    """Fans are matched by number: each would be judged by the twin of another."""
    twin, other = tmp_path / "twin.onnx", tmp_path / "other.mcap"
    write_run(other, published_run(2, 20.0, fans=3), **{"fan_names.tray1": json.dumps(NAMES[::-1])})
    fantwin("train", raw, "--model", "physical", "-o", twin)
    said = "the fans GPU, CPU are in the places of CPU, GPU in the twin: use a twin of these fans in this order"
    of_command: dict[str, tuple[object, ...]] = {
        "evaluate": (twin, other),
        "calibrate": (twin, other, "--false-alarms-per-day", 1),
        "replay": ("--offline", other, "--twin", twin),
    }
    for name, words in of_command.items():
        assert said in error_of(name, *words), name
    assert fantwin("evaluate", twin, raw).exit_code == 0

"""A twin allows for the supply voltage that the board measures: the firmware in its simulator."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from fantwin.simulation.excitation import Multisine, Prbs, Staircase
from tests.support.board_recordings import import_board, run_board, succeed
from tests.support.fan_board import FANS

pytestmark = pytest.mark.slow

LOW, HIGH = 0.2, 1.0
SUPPLY_V = (10.5, 13.2)


def test_a_twin_learns_the_supply_from_the_column_of_the_board(tmp_path: Path) -> None:
    trained, held_out = tmp_path / "trained.csv", tmp_path / "held-out.csv"
    run_board(trained, [Staircase(FANS, 1, LOW, HIGH), Prbs(FANS, 3, 0.3, 0.9)], 24, SUPPLY_V)
    run_board(held_out, [Multisine(FANS, 12, LOW, HIGH)], 24, SUPPLY_V)
    rmse_rpm: dict[str, float] = {}
    for with_supply in (True, False):
        name = "with" if with_supply else "without"
        recordings = [
            import_board(table, tmp_path / f"{table.stem}-{name}.mcap", with_supply=with_supply)
            for table in (trained, held_out)
        ]
        twin = tmp_path / f"{name}.onnx"
        words = ("--model", "physical", "--validate", recordings[1], "-o", twin, "--json")
        said = json.loads(succeed("train", recordings[0], *words))
        assert said["speed_unit"] == "rpm"
        assert said["allows_for"].startswith("supply voltage (reference ") == with_supply
        rmse_rpm[name] = said["rmse"]
    assert rmse_rpm["with"] < 0.2 * rmse_rpm["without"], rmse_rpm

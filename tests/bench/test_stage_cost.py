"""bench.fleet.stage_cost: every sample passes through every stage."""

from __future__ import annotations

from pathlib import Path

import pytest

from bench.fleet.stage_cost import STAGES, cost_of, raws
from simulation.published_fan import rough_run
from tests.support.running_chain import DEMO


@pytest.mark.parametrize("block_s", [0.05, 1.0])
def test_each_stage_and_each_message_has_its_cost(block_s: float, tmp_path: Path) -> None:
    run = rough_run(1, 2.0, 8).run
    assert sum(len(raw.host_receive_t_ns) for raw in raws(run, block_s)) == run.samples
    cost = cost_of(run, block_s, DEMO / "twin.onnx", tmp_path)
    assert set(cost.seconds) == {*STAGES, "codec"}
    assert min(cost.seconds.values()) > 0.0
    of_raw = cost.bytes["raw"]
    assert 16 * run.samples * run.fans < of_raw < 24 * run.samples * run.fans
    assert cost.bytes["score"] > of_raw

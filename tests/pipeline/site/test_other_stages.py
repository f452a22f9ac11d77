"""Which processes the outputs of a shard miss when they do not come: those of its own trays alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from bench.stage_context import stage_context
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.site.other_stages import expected_stages

CONFIGURATION = """
[launcher]
stages = ["acquisition", "scorer", "gateway"]
shards = { scorer = 2, gateway = 2 }
[[tray]]
name = "a"
fans = 2
twin = "twin.onnx"
[[tray]]
name = "b"
fans = 2
twin = "twin.onnx"
"""


def test_a_shard_of_an_output_expects_the_processes_of_its_own_trays():
    config = parse_config(CONFIGURATION, Path("fantwin.toml"))
    whole = replace(stage_context(config, "gateway"), configuration_path=config.path)
    own = [each.label for each in expected_stages(replace(whole, trays=config.trays[:1]))]
    assert own == ["acquisition/a", "scorer/1-of-2", "gateway/1-of-2"]
    assert len(expected_stages(whole)) == 6

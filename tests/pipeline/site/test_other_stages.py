"""Which processes the outputs of a shard miss when they do not come: those of its own trays alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from bench.stage_context import stage_context
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.site.other_stages import expected_stages, page_address

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


@pytest.mark.parametrize(
    ("section", "address"),
    [
        ("", "http://127.0.0.1:8080/"),
        ('hosts = ["localhost", "fans.plant.example"]', "https://fans.plant.example/"),
        (
            'host = "192.0.2.7"\nport = 8443\ncertificate = "c.pem"\nkey = "k.pem"\nusers = "u.toml"',
            "https://192.0.2.7:8443/",
        ),
    ],
)
def test_the_address_of_the_page_follows_from_its_section(section, address):
    config = parse_config(f"[gateway]\n{section}\n{CONFIGURATION}", Path("fantwin.toml"))
    context = replace(
        stage_context(config, "gateway"),
        configuration_path=config.path,
        configuration_text=f"[gateway]\n{section}\n{CONFIGURATION}",
    )
    assert page_address(context) == address
    assert page_address(replace(context, configuration_path=None)) == ""

"""docs/how-to/sources.md: each configuration that it shows is one, and its source can be built."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from pipeline.config.loading import parse_config
from pipeline.devices.sample_source import SourceContext
from pipeline.devices.source_kinds import SOURCE_KINDS, build_source

PAGE = (Path(__file__).parents[3] / "docs" / "how-to" / "sources.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```toml\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("block", BLOCKS, ids=lambda block: re.findall(r'kind = "(\w+)"', block)[0])
def test_a_configuration_of_the_page_can_be_used(block: str) -> None:
    config = parse_config(block, Path("fantwin.toml"), stages=())
    for tray in config.trays:
        source = build_source(tray.source, SourceContext(tray.fans, tray.speed_unit, Path()))
        assert source.name
        if f'kind = "{tray.source.kind}"' in block and "average_s" in block:
            assert tray.stated_tachos


def test_the_page_has_every_kind_of_source() -> None:
    assert all(f"| `{kind}` |" in PAGE for kind in SOURCE_KINDS)

"""docs/how-to: each configuration that a page shows is one, and its sources can be built."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.sources.kinds import SOURCE_KINDS, build_source
from fantwin.pipeline.sources.source import SourceContext

PAGES = {
    page.stem: page.read_text(encoding="utf-8") for page in (Path(__file__).parents[3] / "docs/how-to").glob("*.md")
}
SHOWN = [
    pytest.param(block, id=f"{name}-{number}")
    for name, text in sorted(PAGES.items())
    for number, block in enumerate(re.findall(r"^```toml\n(.*?)^```", text, re.DOTALL | re.MULTILINE), start=1)
]
TRAYS = "".join(f'[[tray]]\nname = "tray{number}"\nfans = 2\n' for number in (1, 2, 3, 4))


@pytest.mark.parametrize("block", SHOWN)
def test_a_configuration_of_a_how_to_is_one(block: str) -> None:
    table = tomllib.loads(block)
    text = block if "tray" in table else block + TRAYS
    config = parse_config(text, Path("fantwin.toml"), stages=STAGES.keys() & table.keys())
    for tray in config.trays if "tray" in table else ():
        assert build_source(tray.source, SourceContext(tray.fans, tray.speed_unit, Path())).name


def test_the_page_of_sources_has_every_kind_of_source() -> None:
    assert all(f"| `{kind}` |" in PAGES["sources"] for kind in SOURCE_KINDS)

"""docs/how-to/deployment.md: what it says that two sites on one host need, is enough and can be set."""

from __future__ import annotations

import re
from pathlib import Path

from pipeline.config.loading import parse_config
from pipeline.config.models import Config

PAGE = (Path(__file__).parents[3] / "docs" / "how-to" / "deployment.md").read_text(encoding="utf-8")
TRAY = '[[tray]]\nname = "tray1"\nfans = 1\n'


def ports(config: Config) -> set[int]:
    """All ports on which a site listens with its default settings otherwise."""
    viewer = config.sections["viewer"].model_dump()
    of_viewer = {viewer["grpc_port"], viewer["web_port"]} if viewer["serve"] else set[int]()
    return {int(config.bus.endpoint.rpartition(":")[2]), *of_viewer}


def test_two_sites_on_one_host_share_no_port_with_the_settings_of_the_page() -> None:
    (section,) = re.findall(r"^Two sites on one host need\n(.*?)\n\n[^-]", PAGE, re.DOTALL | re.MULTILINE)
    named = re.findall(r"--set ([^\s`;]+)", section)
    assert len(named) == 4
    first = parse_config(TRAY, Path("fantwin.toml"), stages=("viewer",))
    for left_out in ("viewer.serve", "viewer.grpc_port"):
        settings = [each for each in named if not each.startswith(left_out)]
        second = parse_config(TRAY, Path("fantwin.toml"), settings, ("viewer",))
        assert not ports(first) & ports(second)

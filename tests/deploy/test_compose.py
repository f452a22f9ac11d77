"""compose.yaml and Dockerfile, where bringing them up would not show it; that is in tests/deploy/compose."""

from __future__ import annotations

import re
import shlex
from itertools import product
from pathlib import Path
from typing import Any

import yaml

from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.runtime.stage import load_stage
from tests.support.fantwin_words import parsed

ROOT = Path(__file__).parents[2]
COMPOSE = (ROOT / "compose.yaml").read_text(encoding="utf-8")
SERVICES: dict[str, dict[str, Any]] = yaml.safe_load(COMPOSE)["services"]
ENABLED = load_config(ROOT / "pipeline/demo/compose.toml").stages


def needs(service: str) -> set[str]:
    """The services that start before this one and stop after it."""
    direct = set(SERVICES[service].get("depends_on", ()))
    return direct.union(*map(needs, direct))


def test_a_stage_stops_before_those_that_read_from_it_and_all_before_the_router():
    for writer, reader in product(ENABLED, ENABLED):
        if set(load_stage(writer).writes) & set(load_stage(reader).reads):
            assert reader in needs(writer), f"{writer} is read by {reader}"
    assert all("router" in needs(stage) for stage in ENABLED)


def test_the_command_for_a_real_tray_is_one_that_fantwin_understands():
    commented = re.findall(r"^ *# command: (.*)$", COMPOSE, re.M)
    assert commented
    for command in commented:
        parsed(shlex.split(command))


def test_the_image_has_the_package_and_the_folders_that_it_links_to():
    linked = {path.readlink().name for path in (ROOT / "fantwin").iterdir() if path.is_symlink()}
    copied = re.findall(r"^COPY (\w+) \1$", (ROOT / "Dockerfile").read_text(encoding="utf-8"), re.M)
    assert linked and set(copied) == {"fantwin", *linked}

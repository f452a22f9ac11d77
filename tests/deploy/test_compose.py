"""compose.yaml and Dockerfile, where bringing them up would not show it; that is in tests/deploy/compose."""

from __future__ import annotations

import json
import re
import shlex
from itertools import combinations
from pathlib import Path
from typing import Any

import yaml

from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.runtime.stage import load_stage
from tests.support.fantwin_words import parsed

FOLDER = Path(__file__).parents[2] / "deploy" / "compose"
COMPOSE = (FOLDER / "compose.yaml").read_text(encoding="utf-8")
SERVICES: dict[str, dict[str, Any]] = yaml.safe_load(COMPOSE)["services"]
ENABLED = load_config(FOLDER / "site" / "fantwin.toml").stages


def needs(service: str) -> set[str]:
    """The services that start before this one and stop after it."""
    direct = set(SERVICES[service].get("depends_on", ()))
    return direct.union(*map(needs, direct))


def test_a_stage_stops_before_those_that_read_from_it_and_all_before_the_router():
    for writer, reader in combinations([name for name in STAGES if name in ENABLED], 2):
        if set(load_stage(writer).writes) & set(load_stage(reader).reads):
            assert reader in needs(writer), f"{writer} is read by {reader}"
    assert all("router" in needs(stage) for stage in ENABLED)


def test_the_command_for_a_real_tray_is_one_that_fantwin_understands():
    commented = re.findall(r"^ *# command: (.*)$", COMPOSE, re.M)
    assert commented
    for command in commented:
        parsed(shlex.split(command))


def test_prometheus_and_grafana_find_what_they_are_given() -> None:
    for service in ("prometheus", "grafana"):
        mounted = [volume.split(":") for volume in SERVICES[service]["volumes"] if volume.startswith("./")]
        assert mounted and all((FOLDER / source).is_dir() for source, *_ in mounted)
    board = json.loads((FOLDER / "grafana/dashboards/fantwin.json").read_text())
    (source,) = yaml.safe_load((FOLDER / "grafana/provisioning/datasources/prometheus.yml").read_text())["datasources"]
    assert (source["type"], source["isDefault"], board["uid"]) == ("prometheus", True, "fantwin")
    assert SERVICES["prometheus"]["network_mode"] == "service:gateway", "it scrapes 127.0.0.1:8080"


def test_ports_are_published_on_loopback_alone() -> None:
    published = [port for service in SERVICES.values() for port in service.get("ports", ())]
    assert len(published) == 2 and all(port.startswith("127.0.0.1:") for port in published)

"""compose.yaml, read as text: no container engine is needed. How to bring it up is in
docs/how-to/deployment.md."""

from __future__ import annotations

import re
import shlex
from itertools import pairwise, product
from pathlib import Path

import pytest

from pipeline.config.loading import load_config
from pipeline.config.registry import STAGES
from pipeline.devices.serial_config import SerialConfig
from pipeline.runtime.stage import load_stage
from tests.support.fantwin_words import parsed

ROOT = Path(__file__).parents[2]
COMPOSE = (ROOT / "compose.yaml").read_text(encoding="utf-8")
_BODIES = COMPOSE.partition("\nservices:\n")[2].partition("\nnetworks:\n")[0]
ENABLED = [name for name, row in STAGES.items() if row.enabled_by == "default"]
SERVICES: dict[str, str] = dict(re.findall(r"^  (\w+):\n((?:    .*\n|\n)+)", _BODIES, re.M))


def fantwin_commands(service: str) -> list[list[str]]:
    """The words after `fantwin` of each command of a service, including commented ones that users may enable."""
    lines = re.findall(r"(?:\bcommand: |\bfantwin )(.*?)(?: &)?$", SERVICES[service], re.M)
    return [shlex.split(line) for line in lines]


def needs(service: str) -> set[str]:
    """The services that start before this one and stop after it."""
    listed = re.search(r"depends_on: \[(.*)\]", SERVICES[service])
    direct = set(re.split(r", *", listed[1])) if listed else set()
    return direct.union(*map(needs, direct))


def test_there_is_a_service_for_the_router_and_every_stage_enabled_by_default():
    assert set(SERVICES) == {"router", *ENABLED}


@pytest.mark.parametrize("service", SERVICES)
def test_every_command_is_one_that_fantwin_understands(service):
    for words in fantwin_commands(service):
        parsed(words)


@pytest.mark.parametrize("stage", ENABLED)
def test_a_service_runs_the_stage_it_is_named_after_with_the_configuration_in_the_image(stage):
    runs = [words for words in fantwin_commands(stage) if words[0] == "run"]
    assert runs
    for words in runs:
        assert words[1:4] == [stage, "-c", "/demo/compose.toml"]
    assert "\nCOPY pipeline/demo /demo\n" in (ROOT / "Dockerfile").read_text(encoding="utf-8")


def test_a_stage_stops_before_those_that_read_from_it_and_all_before_the_router():
    for writer, reader in product(ENABLED, ENABLED):
        if set(load_stage(writer).writes) & set(load_stage(reader).reads):
            assert reader in needs(writer), f"{writer} is read by {reader}"
    assert all("router" in needs(stage) for stage in ENABLED)


def test_the_configuration_fits_the_services():
    config = load_config(ROOT / "pipeline" / "demo" / "compose.toml")
    ((_, _, listen, _),) = fantwin_commands("router")
    assert (config.bus.mode, config.bus.endpoint) == ("client", f"tcp/router:{listen.rpartition(':')[2]}")
    (tray,) = config.trays
    simulate = next(words for words in fantwin_commands("acquisition") if words[0] == "simulate")
    options = dict(pairwise(simulate))
    assert isinstance(tray.source, SerialConfig)
    source_options = tuple(options[name] for name in ("--fans", "--link", "--speed-unit"))
    assert source_options == (str(tray.fans), tray.source.port, tray.speed_unit)
    assert f"runs:{config.run_folder}" in SERVICES["recorder"]
    assert f"runs:{config.run_folder}" in SERVICES["viewer"]
    assert f"runs:{config.run_folder}" in SERVICES["scorer"], "it keeps its snapshot there"
    assert tray.twin is not None
    assert (config.folder / tray.twin).is_file()

"""The systemd units: complete, in the order of the data flow, and accepted by systemd itself."""

from __future__ import annotations

import configparser
import os
import re
import shlex
import shutil
import subprocess
from itertools import product
from pathlib import Path

import pytest

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.runtime.stage import load_stage
from tests.support.fantwin_words import parsed

UNITS = Path(__file__).parents[2] / "deploy" / "systemd"
FANTWIN = "/opt/fantwin/bin/fantwin"
SERVICES = [*(f"fantwin-{stage}@2-8.service" for stage in STAGES), "fantwin-router.service"]
HIGHEST_EXPOSURE = 20
"""of 100, as systemd rates what a service may do"""


def section(unit: str, name: str) -> configparser.SectionProxy:
    parser = configparser.ConfigParser(strict=False, interpolation=None, delimiters=("=",))
    parser.optionxform = str  # type: ignore[assignment]
    parser.read(UNITS / unit)
    return parser[name]


def command_of(unit: str, stage: str) -> list[str]:
    """The words after the program, for shard 2/8 of a stage."""
    words = shlex.split(section(unit, "Service")["ExecStart"].replace("%j", stage).replace("%I", "2/8"))
    assert words[0] == FANTWIN
    return words[1:]


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """A folder with the units, and an instance of each template, as it would be on a host where fantwin is."""
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed: the units are not checked by systemd")
    shutil.copytree(UNITS, tmp_path, dirs_exist_ok=True)
    program = tmp_path / "fantwin"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    for unit in tmp_path.glob("*.service"):
        unit.write_text(unit.read_text().replace(FANTWIN, str(program)))
    for service in SERVICES:
        if "@" in service:
            (tmp_path / service).symlink_to(f"{service.partition('@')[0]}@.service")
    return tmp_path


def analyze(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["systemd-analyze", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "SYSTEMD_UNIT_PATH": f"{folder}:"},
    )


def test_a_unit_runs_the_shard_that_its_instance_names_and_the_router_listens():
    configuration = Path("/etc/fantwin/fantwin.toml")
    for stage in STAGES:
        found = parsed(command_of(f"fantwin-{stage}@.service", stage))
        assert (found["only"], found["shard"], found["config"]) == (stage, "2/8", configuration)
    found = parsed(command_of("fantwin-router.service", ""))
    assert (found["listen"], found["config"]) == ("tls/0.0.0.0:7447", configuration)


def test_a_stage_stops_before_those_that_read_from_it():
    def after(stage: str) -> set[str]:
        found = section(f"fantwin-{stage}@.service", "Unit").get("After", "").split()
        return {match[1] for each in found if (match := re.fullmatch(r"fantwin@(\w+)\.target", each))}

    for writer, reader in product(STAGES, STAGES):
        flows = set(load_stage(writer).writes) & set(load_stage(reader).reads) - {"new_twin", "score"}
        if flows and list(STAGES).index(writer) < list(STAGES).index(reader):
            assert reader in after(writer), f"{writer} is read by {reader}"
    for stage in STAGES:
        assert after(stage) == set(list(STAGES)[list(STAGES).index(stage) + 1 :]), "the order of the registry"
        assert section(f"fantwin-{stage}@.service", "Unit")["Before"] == "fantwin@%j.target"


def test_systemd_accepts_the_units_which_may_do_little_and_only_acquisition_reaches_devices(installed):
    done = analyze(installed, "verify", "--man=no", *SERVICES, "fantwin.target")
    assert (done.returncode, done.stderr) == (0, "")
    for service in SERVICES:
        words = ("security", "--offline=yes", "--no-pager", f"--threshold={HIGHEST_EXPOSURE}", str(installed / service))
        done = analyze(installed, *words)
        assert done.returncode == 0, done.stdout + done.stderr
        (devices,) = (line for line in done.stdout.splitlines() if "PrivateDevices=" in line)
        assert ("✓" in devices) == ("acquisition" not in service)

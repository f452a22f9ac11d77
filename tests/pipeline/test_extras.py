"""Extras: what each brings, that nothing else needs them, and the printed hint that says how to install one."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Mapping
from functools import cache
from importlib.abc import MetaPathFinder
from importlib.metadata import packages_distributions
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline import extras
from fantwin.pipeline.cli import main as command_line
from fantwin.pipeline.extras import EXTRAS, how_to_install
from tests.support.running_chain import DEMO

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
PRODUCT = ("fantwin", "schemas", "scoring", "pipeline", "simulation", "stages", "twin")
PARTS = {"h11": "uvicorn", "markupsafe": "jinja2", "pydantic_core": "pydantic"}
"""modules that a package exposes in its own interface, and which come with it"""
OPTIONAL = {*(module for modules in EXTRAS.values() for module in modules), "torch"}
FEATURES = set(PROJECT["optional-dependencies"]) - {"all", "dev", "bench"}


class NotInstalled(MetaPathFinder):
    """Finds none of the optional modules, as where they are not installed."""

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> None:
        if fullname.partition(".")[0] in OPTIONAL:
            raise ModuleNotFoundError(f"No module named {fullname!r}", name=fullname)


def names(requirements: list[str]) -> set[str]:
    return {re.split("[<>=!~;[]", each)[0].strip() for each in requirements}


@cache
def installed() -> Mapping[str, list[str]]:
    """The packages that have each module: to find them takes a second."""
    return packages_distributions()


def packages_of(modules: set[str]) -> set[str]:
    return {installed()[PARTS.get(module, module)][0].lower().replace("_", "-") for module in modules}


IMPORT = re.compile(r"^\s*(?:from (\w+)[\w.]* import|import (\w+))", re.MULTILINE)


def imported() -> dict[str, set[str]]:
    """The modules of others that the product imports, each with the files that import it."""
    found: dict[str, set[str]] = {}
    for path in (path for folder in PRODUCT for path in (ROOT / folder).rglob("*.py")):
        modules = {of or itself for of, itself in IMPORT.findall(path.read_text(encoding="utf-8"))}
        for module in modules - {*sys.stdlib_module_names, "fantwin"}:
            found.setdefault(module, set()).add(path.relative_to(ROOT).as_posix())
    return found


def test_each_extra_has_the_packages_of_its_modules_and_all_has_every_extra():
    listed = PROJECT["optional-dependencies"]
    assert set(EXTRAS) == FEATURES
    for extra, modules in EXTRAS.items():
        assert names(listed[extra]) == packages_of(set(modules)), extra
    (everything,) = listed["all"]
    assert set(everything.removeprefix("fantwin[").removesuffix("]").split(",")) == FEATURES


def test_every_package_that_is_imported_is_required_and_every_required_one_is_imported():
    found = imported()
    assert found.pop("torch") == {"twin/fitting/torch_reference.py", "twin/fitting/torch_twin.py"}
    assert found.pop("pandas") == {"fantwin/interface/making.py", "fantwin/interface/twin.py"}, "for types alone"
    required = {module for module in found if PARTS.get(module, module) not in OPTIONAL}
    assert packages_of(required) == names(PROJECT["dependencies"])


def test_all_commands_stages_and_sources_load_where_no_extra_is_installed():
    code = """
import sys
from tests.pipeline.test_extras import NotInstalled
sys.meta_path.insert(0, NotInstalled())
from fantwin.pipeline.cli import main
main._register(main.COMMANDS)
from fantwin.pipeline.config.registry import STAGES
for row in STAGES.values():
    row.load()
from fantwin.pipeline.plugins import loaded
from fantwin.pipeline.sources.kinds import SOURCE_KINDS
for row in SOURCE_KINDS.values():
    loaded(row.config), loaded(row.source)
import fantwin.pipeline.outputs.web.app, fantwin.pipeline.http_server, fantwin.pipeline.site.users
import fantwin.twin.build, fantwin.twin.comparison, fantwin.twin.report.assessment, fantwin.twin.export.onnx_twin
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stderr


@pytest.fixture
def without_extras(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    is_installed = extras.is_installed
    monkeypatch.setattr(extras, "is_installed", lambda module: module not in OPTIONAL and is_installed(module))
    monkeypatch.chdir(tmp_path)
    registered = list(command_line.app.registered_commands)
    yield
    command_line.app.registered_commands[:] = registered


def printed_by(command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The lines that a command prints, on standard output and standard error, when it fails."""
    monkeypatch.setattr(sys, "argv", ["fantwin", *command.split()])
    with pytest.raises(SystemExit) as ended:
        command_line.main()
    printed = capsys.readouterr()
    assert ended.value.code in (1, 2), printed.err
    return [*printed.out.splitlines(), *printed.err.splitlines()]


@pytest.mark.usefixtures("without_extras")
@pytest.mark.parametrize(
    ("command", "requirement"),
    [
        ("export r.mcap --to parquet", "fantwin[logs]"),
        ("import log.ulg --preview", "fantwin[logs]"),
        ("view r.mcap -o view.rrd", "fantwin[view]"),
        ("view r.mcap -o r.png", "fantwin[report]"),
        (f"report {DEMO / 'twin.onnx'} r.mcap", "fantwin[report]"),
        ("report s3://bucket/day.mcap", "fantwin[remote]"),
        ("train r.mcap -o t.onnx --trainer adam", "torch"),
        ("report r.mcap r.mcap --jobs tcp://127.0.0.1:1", "fantwin[remote]"),
    ],
)
def test_a_command_without_its_extra_prints_one_line_with_what_to_type(
    command: str, requirement: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("log.ulg").write_bytes(b"ULog\x01\x12\x35")
    (line,) = printed_by(command, capsys, monkeypatch)
    assert line.startswith("fantwin: ")
    assert line.endswith(f": {how_to_install(requirement)}")
    assert requirement.removeprefix("fantwin") in line


CONFIGURATION = """
run_folder = "{folder}"
bus = {{ endpoint = "tcp/127.0.0.1:1" }}
{launcher}
[[tray]]
name = "broker"
fans = 1
source = {{ kind = "mqtt", url = "mqtt://127.0.0.1", topic = "a" }}
[[tray]]
name = "drive"
fans = 1
source = {{ kind = "modbus", line = "127.0.0.1", fan = [{{ speed = {{ address = 0 }}, command = {{ address = 1 }} }}] }}
[[tray]]
name = "server"
fans = 1
source = {{ kind = "redfish", url = "https://127.0.0.1" }}
[[tray]]
name = "switch"
fans = 1
[tray.source]
kind = "snmp"
host = "127.0.0.1"
community_file = "community"
fan = [{{ speed = "1.3.6" }}]
[opcua]
[mqtt]
url = "mqtt://127.0.0.1"
[notifier]
target = [{{ name = "mail", url_file = "url" }}]
"""
NAMED = '[launcher]\nstages = ["acquisition", "viewer", "opcua", "mqtt", "notifier"]\n'


@pytest.mark.usefixtures("without_extras")
def test_doctor_prints_what_each_source_and_stage_lacks(capsys, monkeypatch):
    Path("fantwin.toml").write_text(CONFIGURATION.format(folder=Path.cwd(), launcher=NAMED))
    lines = printed_by("doctor --listen-s 0", capsys, monkeypatch)
    for what, extra in {
        **{f"source {kind}": "devices" for kind in ("mqtt", "modbus", "snmp")},
        **{f"stage {stage}": "outputs" for stage in ("opcua", "mqtt")},
        "target mail: apprise": "outputs",
        "stage viewer": "view",
    }.items():
        hint = f"{what} needs the extra `{extra}`: {how_to_install(f'fantwin[{extra}]')}"
        assert [line for line in lines if line.startswith("FIX") and line.endswith(hint)], what


@pytest.mark.parametrize(
    ("is_active", "has_pip", "requirement", "command"),
    [
        (True, True, "fantwin[view]", "pip install 'fantwin[view]'"),
        (False, True, "torch", f"{sys.executable} -m pip install torch"),
        (False, False, "fantwin[view]", f"uv pip install --python {sys.executable} 'fantwin[view]'"),
    ],
)
def test_the_command_is_for_the_environment_of_this_process(
    monkeypatch: pytest.MonkeyPatch, is_active: bool, has_pip: bool, requirement: str, command: str
) -> None:
    monkeypatch.setattr(extras, "is_installed", lambda _: has_pip)
    monkeypatch.setenv("VIRTUAL_ENV", sys.prefix if is_active else "")
    assert how_to_install(requirement) == command

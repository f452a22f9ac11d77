"""`fantwin doctor` says what keeps an installation or a configuration from working, and sends test messages."""

from __future__ import annotations

import json
import re
import socket
import tomllib
from collections.abc import Callable, Iterator
from contextlib import closing
from importlib.metadata import PackageNotFoundError
from pathlib import Path

import pytest

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.cli.watch import doctor as module
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.config.shards import Shard
from fantwin.pipeline.extras import how_to_install
from fantwin.pipeline.runtime.sessions import Session
from fantwin.pipeline.sources.simulated.device import PseudoTerminal
from tests.support.fantwin_command import error_of, fantwin, usage_error_of
from tests.support.message_receivers import HttpReceiver
from tests.support.notified_alarms import secret
from tests.support.ports import free_port
from tests.support.running_chain import DEMO

PROJECT = tomllib.loads((DEMO.parents[1] / "pyproject.toml").read_text())["project"]
NEEDED = [re.split("[<>=]", requirement)[0] for requirement in PROJECT["dependencies"]]


@pytest.fixture
def port() -> Iterator[str]:
    """A serial port that exists."""
    with closing(PseudoTerminal()) as line:
        yield line.port


def examine(config: Path | None = None, *settings: str) -> tuple[int, dict]:
    overrides = ["viewer.grpc_port=0", *settings] if config else []  # its ports may be taken on this computer
    words = [*(("-c", config) if config else ()), *(word for each in overrides for word in ("--set", each))]
    done = fantwin("doctor", "--json", "--listen-s", 0, *words)
    return done.exit_code, json.loads(done.stdout)


@pytest.fixture
def demo(port: str, tmp_path: Path) -> Callable[..., tuple[int, dict]]:
    """Examines the configuration of the demo, with some settings of its own."""
    settings = (f"tray.0.port='{port}'", f"run_folder='{tmp_path}'")
    return lambda *more: examine(DEMO / "demo.toml", *settings, *more)


def test_an_installation_in_order_is_fine_and_each_package_that_fantwin_needs_is_looked_at(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, found = examine()
    assert code == 0
    assert "no fantwin.toml in this folder, and none given with -c: only the installation was checked" in found["good"]
    assert found["ok"] and found["problems"] == []
    assert f"{len(NEEDED)} packages that it needs are installed" in found["good"]
    (line,) = (line for line in found["good"] if line.startswith("extras installed: "))
    assert {*line.split(": ")[1].split(", ")} == set(PROJECT["optional-dependencies"]) - {"all", "dev", "bench"}


def test_a_bus_that_others_reach_without_certificates_is_a_problem(demo):
    code, found = demo("bus.endpoint='tcp/0.0.0.0:17447'")
    assert code == 1
    assert [line for line in found["problems"] if "can drive the fans" in line and "--insecure" in line]


def test_a_configuration_in_order_can_start(demo):
    code, found = demo()
    assert (code, found["problems"]) == (0, [])
    assert {"acquisition/tray1: can start", "twin_integrator: can start"} <= set(found["good"])


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("tray.0.port='/dev/none'", ["acquisition/tray1: /dev/none: no such port", "connect the device"]),
        ("tray.0.port=''", ["acquisition/tray1", "port is missing"]),
        ("tray.0.twin='none.onnx'", ["twin_integrator", "none.onnx: cannot read the twin", "correct [[tray]] twin"]),
        ("tray.0.twin='demo.toml'", ["twin_integrator", "not an ONNX file"]),
        ("tray.0.fans=3", ["twin_integrator", "a twin of 8 fans", "choose a twin that fits"]),
        ("run_folder='/etc/hostname/x'", ["run_folder /etc/hostname/x", "not a folder this user may write to"]),
        ("bus.endpoint='tcp/127.0.0.1:99999'", ["bus.endpoint", "port 99999 is out of range"]),
        ("bus.endpoint='tcp/no-such-host.invalid:7447'", ["bus.endpoint", "'no-such-host.invalid' cannot be found"]),
        ("scorer.alarm_shrae=1", ["scorer.alarm_shrae", "did you mean 'alarm_share'"]),
    ],
)
def test_each_problem_is_one_line_that_says_what_to_do(demo, setting, words):
    code, found = demo(setting)
    assert code == 1
    (line, *again) = found["problems"]
    assert not again or setting.startswith("run_folder")  # the recorder, too, says that it cannot write there
    for word in words:
        assert word in line


def test_only_the_lines_of_the_named_trays_are_checked(tmp_path, port):
    path = tmp_path / "fantwin.toml"
    text = "".join(
        f'[[tray]]\nname = "{name}"\nfans = 1\nport = "{line}"\n' for name, line in (("a", port), ("b", "none"))
    )
    path.write_text(text + '[launcher]\nstages = ["acquisition", "recorder"]\n', encoding="utf-8")

    def problems(*words: str) -> list[str]:
        return json.loads(fantwin("doctor", "-c", path, "--listen-s", 0, "--json", *words).stdout)["problems"]

    (problem,) = problems()
    assert problem.startswith(f"acquisition/b: {tmp_path / 'none'}: no such port"), "beside the configuration"
    good = json.loads(fantwin("doctor", "-c", path, "--listen-s", 0, "--json").stdout)["good"]
    assert any(line.startswith("recorder: recordings: 0 bytes of ") and line.endswith("of 14 days") for line in good)
    assert problems("--tray", "b") == [problem]
    assert problems("--tray", "a") == []
    lines = fantwin("doctor", "-c", path, "--listen-s", 0).stdout.splitlines()
    assert f"FIX  {problem}" in lines and "ok   acquisition/a: can start" in lines
    assert problems("--tray", "c") == [f"{path}: no tray called 'c'; known: a, b"]


def test_row_15_a_foreign_program_at_the_endpoint_is_a_problem(demo, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.bus.opening.MEETING_LIMIT_S", 0.0)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        endpoint = f"tcp/127.0.0.1:{listening.getsockname()[1]}"
        code, found = demo(f"bus.endpoint='{endpoint}'")
    assert code == 1
    assert found["problems"] == [
        f"bus.endpoint = '{endpoint}': the program that listens there is not fantwin, or hangs, so stages cannot "
        "connect: stop it, or choose another port"
    ]


def test_the_ports_of_the_own_running_site_are_no_problem_and_those_of_a_stranger_are(demo, endpoint):
    with socket.create_server(("127.0.0.1", 0)) as taken, Bus(BusConfig(endpoint=endpoint)) as bus:
        viewer_port = taken.getsockname()[1]
        settings = [f"bus.endpoint='{endpoint}'", f"viewer.grpc_port={viewer_port}"]
        settings.append("launcher.stages=['resampler', 'viewer']")
        code, found = demo(*settings)
        assert code == 1
        assert f"viewer: viewer.grpc_port: port {viewer_port} on 127.0.0.1 is taken" in found["problems"][0]
        assert f"bus.endpoint {endpoint}: fantwin answers there" in found["good"]

        bus.declare_alive(Session.of_this_process("scorer", Shard("all", ()), 1, "scorer-all-1").key("hall"))
        code, found = demo(*settings)
        (other,) = found["warnings"]
        assert other.startswith(f"bus.endpoint {endpoint}: site 'hall' runs there, not 'demo': ")

        session = Session.of_this_process("viewer", Shard("all", ()), 1, "viewer-all-1")
        bus.declare_alive(session.key("demo"))
        code, found = demo(*settings)
        assert (code, found["problems"]) == (0, [])
        runs = f"viewer: runs already ({session.process})"
        assert {f"bus.endpoint {endpoint}: site 'demo' runs there", runs, "resampler: can start"} <= set(found["good"])


@pytest.mark.parametrize(
    ("missing", "kind", "line"),
    [
        (NEEDED[0], "problems", f"{NEEDED[0]}: not installed; {how_to_install('fantwin')}"),
        (NEEDED[-1], "problems", f"{NEEDED[-1]}: not installed; {how_to_install('fantwin')}"),
        ("pymodbus", "good", f"extra 'devices': not installed (pymodbus); {how_to_install('fantwin[devices]')}"),
    ],
)
def test_a_package_that_fantwin_needs_is_a_problem_when_it_is_missing_and_one_of_an_extra_is_none(
    monkeypatch, missing, kind, line
):
    versions = module._version
    monkeypatch.setattr(module, "_version", lambda name: "" if name == missing else versions(name))
    code, found = examine()
    assert line in found[kind]
    assert (code, len(found["problems"])) == ((1, 1) if kind == "problems" else (0, 0))


def test_running_from_files_without_an_installation_is_a_problem(monkeypatch):
    def not_installed(name: str) -> list[str]:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(module, "requires", not_installed)
    code, found = examine()
    assert code == 1
    assert found["problems"] == ["fantwin is not installed: in its checkout, pip install -e ."]


def test_little_disk_is_a_problem(demo, monkeypatch):
    monkeypatch.setattr(module, "_MIN_FREE_BYTES", 1 << 62)
    _, found = demo()
    assert "make room" in found["problems"][0]


def test_without_c_the_configuration_of_this_folder_is_checked_and_one_that_is_missing_is_a_problem(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "fantwin.toml").write_text('[[tray]]\nname = "tray1"\nfanz = 1\n')
    code, found = examine()
    assert code == 1 and "fanz" in found["problems"][0]
    code, found = examine(tmp_path / "none.toml")
    assert code == 1 and "cannot read the configuration" in found["problems"][0]


def test_what_several_processes_have_wrong_is_one_line(tmp_path, endpoint):
    file = tmp_path / "fantwin.toml"
    trays = "".join(f'[[tray]]\nname = "{name}"\nfans = 1\nport = "/dev/none"\n' for name in "abc")
    file.write_text(f'[bus]\nendpoint = "{endpoint}"\n[launcher]\nstages = ["acquisition", "recorder"]\n{trays}')
    found = examine(file)[1]["problems"]
    assert len([line for line in found if "/dev/none" in line]) == 1
    assert found[-1].startswith("acquisition/a, acquisition/b, acquisition/c: ")


CONFIGURATION = """
site = "hall"
run_folder = "runs"
[[tray]]
name = "tray1"
fans = 8
[launcher]
stages = ["notifier"]
[notifier]
page = "https://hall.example"
[[notifier.target]]
name = "hook"
url_file = "hook.url"
[[notifier.target]]
name = "other"
kind = "alertmanager"
url_file = "other.url"
"""


@pytest.fixture
def receiver() -> Iterator[HttpReceiver]:
    server = HttpReceiver()
    yield server
    server.stop()


def site(folder: Path, receiver: HttpReceiver, alertmanager_port: int) -> Path:
    secret(folder, "hook", f"json://127.0.0.1:{receiver.port}/")
    secret(folder, "other", f"http://127.0.0.1:{alertmanager_port}")
    config = folder / "fantwin.toml"
    config.write_text(CONFIGURATION)
    return config


def test_each_target_gets_a_test_message(tmp_path, receiver):
    config = site(tmp_path, receiver, receiver.port)
    done = fantwin("doctor", "notify", "-c", config)
    assert (done.exit_code, done.stdout) == (0, "hook: delivered\nother: delivered\n")
    message, (alert,) = receiver.received
    assert message["title"] == "Test (hall)"
    assert "A test of target hook of the notifier at hall." in message["message"]
    assert alert["labels"] == {"alertname": "FantwinTest", "site": "hall", "severity": "none"}


def test_one_that_is_away_is_named_and_the_others_get_theirs(tmp_path, receiver):
    config = site(tmp_path, receiver, free_port())
    done = fantwin("doctor", "notify", "-c", config, "--json")
    hook, other = map(json.loads, done.stdout.splitlines())
    assert hook == {"target": "hook", "delivered": True, "reason": ""}
    assert not other["delivered"] and "refused" in other["reason"]
    assert error_of("doctor", "notify", "-c", config) == "no test message for other"
    assert fantwin("doctor", "notify", "hook", "-c", config).stdout == "hook: delivered\n"
    assert "no target nobody: there is hook, other" in usage_error_of("doctor", "notify", "nobody", "-c", config)


def test_doctor_reads_secrets_and_urls(tmp_path, receiver):
    config = site(tmp_path, receiver, receiver.port)

    def problems() -> list[str]:
        return [line for line in examine(config)[1]["problems"] if line.startswith("notifier")]

    (tmp_path / "hook.url").chmod(0o644)
    assert ["others may read it" in line for line in problems()] == [True]
    secret(tmp_path, "hook", "mailto://127.0.0.1/?from=f@hall.example&to=ann@hall.example,bob@hall.example")
    assert ["recipients" in line for line in problems()] == [True]

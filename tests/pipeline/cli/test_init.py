"""`fantwin init` writes what is there, or is chosen, as a configuration that loads, and says what is next."""

from __future__ import annotations

import json
import os
import threading
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from serial.tools import list_ports
from serial.tools.list_ports_common import ListPortInfo

from fantwin.pipeline.cli.watch import init as module
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.sources.hwmon.config import HwmonConfig
from fantwin.pipeline.sources.redfish.config import RedfishConfig
from fantwin.pipeline.sources.serial.config import SerialConfig
from fantwin.schemas.wire import Protocol, Sample, encode
from tests.support.fantwin_command import as_typed, error_of, fantwin, usage_error_of
from tests.support.hwmon_trees import add_chip, board
from tests.support.ports import free_port
from tests.support.redfish_server import Controller, redfish_server
from tests.support.written_logs import write_ulog


@pytest.fixture
def root(tmp_path: Path) -> Path:
    root = tmp_path / "hwmon"
    board(root, 2, "i2c-1/1-002f")
    add_chip(root, 8, "thinkpad", "platform/thinkpad_hwmon", {"fan1_input": 3000, "fan2_input": 3100, "pwm1": 128})
    return root


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path / "fantwin.toml"


@contextmanager
def device(protocol: Protocol, speed: float) -> Iterator[str]:
    """A serial line on which three fans are sampled; its port."""
    ours, theirs = os.openpty()
    tty.setraw(theirs)
    stopping = threading.Event()

    def send() -> None:
        number = 0
        while not stopping.wait(0.005):
            number += 1
            os.write(ours, encode(protocol, Sample(10_000 * number, number, (40.0, 80.0, 60.0), (speed,) * 3)))

    sending = threading.Thread(target=send)
    sending.start()
    try:
        yield os.ttyname(theirs)
    finally:
        stopping.set()
        sending.join()
        os.close(ours)
        os.close(theirs)


def trays(file: Path) -> list[TrayConfig]:
    return list(load_config(file).trays)


def test_the_fans_of_this_computer_are_a_configuration_that_loads_and_the_next_command_is_said(
    root: Path, file: Path
) -> None:
    done = fantwin("init", "--root", root, "--writable", "--json")
    found = json.loads(done.stdout)
    assert (done.exit_code, found["written"], found["next"]) == (0, "fantwin.toml", ["fantwin commission --sweep"])
    assert [tray.name for tray in trays(file)] == ["nct6798", "thinkpad"]
    assert all(isinstance(tray.source, HwmonConfig) and tray.source.writable for tray in trays(file))
    _, said = as_typed().stdout.splitlines()[:2]
    assert said.startswith("next: fantwin commission --sweep  ("), "as init has said"
    before = file.read_bytes()
    exists = "fantwin.toml: exists and was not changed: name another file with -c, or remove it"
    assert error_of("init", "--root", root, "--hwmon") == exists
    shown = fantwin("init", "--root", root, "--hwmon", "-c", "other.toml").stdout.splitlines()
    assert shown[-1] == "next: fantwin commission -c other.toml"
    lacks = "thinkpad (hwmon8, thinkpad_hwmon): thinkpad has no pwm2, so the command of fan2 is not known"
    assert any(line.startswith(lacks) for line in shown)
    assert file.read_bytes() == before


@pytest.mark.parametrize(
    ("protocol", "speed", "unit", "command_max"), [("text", 1200.0, "rpm", 100.0), ("binary", 120.0, "rad/s", 100.0)]
)
def test_the_device_at_a_serial_port_is_heard(
    file: Path, protocol: Protocol, speed: float, unit: str, command_max: float
) -> None:
    with device(protocol, speed) as port:
        done = fantwin("init", "--serial", port)
    following = done.stdout.splitlines()[-2:]
    assert (done.exit_code, following) == (0, ["next: fantwin doctor", "next: fantwin commission --sweep"]), done.output
    (tray,) = trays(file)
    assert tray.source == SerialConfig(port=port, protocol=protocol)
    assert (tray.fans, tray.speed_unit, tray.command_max) == (3, unit, command_max)


def test_a_silent_port_is_a_guess_that_says_so(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module.discover_device, "__defaults__", (0.05,))
    ours, theirs = os.openpty()
    assert "nothing of the protocol was heard" in fantwin("init", "--serial", os.ttyname(theirs)).stdout
    os.close(ours)
    os.close(theirs)
    assert "are a guess" in file.read_text()


def test_the_fans_of_a_controller_are_named_as_it_names_them(file: Path) -> None:
    with redfish_server(Controller(is_new=True)) as url:
        done = fantwin("init", "--redfish", url, "--redfish", url)
    following = done.stdout.splitlines()[-2:]
    assert (done.exit_code, following) == (0, ["next: fantwin doctor", "next: fantwin commission"]), done.output
    one, other = trays(file)
    assert (one.name, other.name, one.fans) == ("127-0-0-1", "127-0-0-1-2", 2)
    assert isinstance(one.source, RedfishConfig) and one.source.fans == ("FAN1", "FAN2")
    with redfish_server(Controller(is_new=False)) as url:
        missing = fantwin("init", "--redfish", url, "-c", "old.toml").stdout
    assert "no command is known: say where by source.command; FAN1 has Reading 4000, Oem/Vendor/PWM 40" in missing
    gone = f"{url}: does not answer within 5 s, or cannot be reached; waiting for it"
    assert error_of("init", "--redfish", url, "-c", "new.toml") == gone


def test_a_range_of_controllers_is_one_tray_with_hosts_and_one_that_does_not_answer_is_named(file: Path) -> None:
    with redfish_server(Controller(is_new=True)) as one, redfish_server(Controller(is_new=True)) as other:
        ports = sorted(int(url.rpartition(":")[2]) for url in (one, other))
        gone = free_port()
        url = f"http://127.0.0.1:[{ports[0]},{gone},{ports[1]}]"
        done = fantwin("init", "--redfish", url)
    assert done.exit_code == 0, done.output
    assert [tray.fans for tray in trays(file)] == [2, 2]
    assert [tray.source.url for tray in trays(file) if isinstance(tray.source, RedfishConfig)] == [
        f"http://127.0.0.1:{port}" for port in ports
    ]
    assert file.read_text().count("[[tray]]") == 1
    assert f"left out: http://127.0.0.1:{gone}: does not answer within 5 s, or cannot" in done.stdout
    assert f"trays of 2 devices, 127.0.0.1:{ports[0]} to 127.0.0.1:{ports[1]}, fans 2" in done.stdout
    assert error_of("init", "--redfish", "https://bmc[9-1]", "-c", "x.toml").startswith(
        "--redfish https://bmc[9-1]: a r"
    )


def test_logs_need_no_configuration_and_the_command_that_reads_them_is_said(file: Path, tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    (logs / "day").mkdir(parents=True)
    write_ulog(logs / "day" / "flight.ulg", {"a": ("uint64_t timestamp;float b;", [(1000, 1.0)])})
    (logs / "bench.csv").write_text("t,u,y\n0,1,2\n")
    shown = fantwin("init", "--logs", logs).stdout.splitlines()
    assert shown[-2:] == [
        f"next: fantwin import {logs}/day/flight.ulg --preview",
        f"next: fantwin import {logs}/bench.csv --preview",
    ]
    assert not file.exists()


def test_on_a_terminal_it_asks_and_elsewhere_it_says_what_it_takes_and_what_is_there(
    root: Path, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = ListPortInfo("/dev/ttyUSB9")
    port.description, port.hwid = "FT232R USB UART", "USB VID:PID=0403:6001"
    monkeypatch.setattr(list_ports, "comports", lambda: [port, ListPortInfo("/dev/ttyS9")])
    options = "say what to watch: --hwmon, --serial PORT, --redfish URL, --ipmi URL, --snmp HOST, --prometheus URL or "
    options += "--logs FOLDER"
    there = "nct6798 (hwmon2, 1-002f), thinkpad (hwmon8, thinkpad_hwmon), /dev/ttyUSB9"
    assert usage_error_of("init", "--root", root) == f"{options}; here: {there}"
    monkeypatch.setattr(module, "_is_terminal", lambda: True)
    done = fantwin("init", "--root", root, typed="y\ny\nn\n\n\n\n")
    assert done.exit_code == 0, done.output
    assert "fan 0 is fan1_input: 900 rpm" in done.stdout and "FT232R USB UART" in done.stdout
    assert all(isinstance(tray.source, HwmonConfig) and tray.source.writable for tray in trays(file))
    assert done.stdout.splitlines()[-1] == "next: fantwin commission --sweep"
    asked = error_of("init", "--root", root, "-c", "none.toml", typed="n\nn\n\n\n\n")
    assert asked == "no fan to watch: nothing was chosen"


@pytest.mark.parametrize(
    ("option", "address"),
    [
        ("--redfish", "https://ann:swordfish@127.0.0.1:9"),
        ("--redfish", "https://ann:sw/ord:fish@bmc[1-2]"),
        ("--ipmi", "ipmi://ann:swordfish@bmc1"),
        ("--prometheus", "http://ann:swordfish@127.0.0.1:9"),
        ("--snmp", "ann:swordfish@switch7:161"),
    ],
)
def test_a_password_in_an_address_is_refused_and_not_shown(option: str, address: str, tmp_path: Path) -> None:
    said = error_of("init", option, address, "-c", tmp_path / "new.toml")
    assert said == f"{option}: an address is shown, so no password in it: give USER@HOST and --password-file"

"""The units that `fantwin service` and `fantwin deploy systemd` make: systemd accepts them, and they may do little."""

from __future__ import annotations

import configparser
import os
import pwd
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from fantwin.pipeline.cli.watch import service_files
from fantwin.pipeline.cli.watch.service_files import RULES, UNITS, USERS, Service, written_below
from fantwin.pipeline.config.loading import parse_config
from tests.support.fantwin_words import parsed

HIGHEST_EXPOSURE = 20
"""of 100, as systemd rates what a service may do"""
HWMON = """[[tray]]
name = "board"
fans = 2
source = { kind = "hwmon", chip = "nct6798", writable = true }
"""
SERIAL = """[[tray]]
name = "line"
fans = 1
port = "/dev/ttyACM7"
"""
IPMI = '[[tray]]\nname = "host"\nfans = 1\nsource = { kind = "ipmi", fan = [{ speed = "FAN1" }] }\n'
WATCHED = HWMON.replace("writable = true", "writable = false")


def service(text: str, folder: Path = Path("/etc/fantwin"), user: str = "fantwin") -> Service:
    return Service.of(parse_config(f'run_folder = "/var/lib/fantwin"\n{text}', folder / "fantwin.toml"), user)


def settings(made: Service, unit: str = "fantwin.service") -> configparser.SectionProxy:
    parser = configparser.ConfigParser(strict=False, interpolation=None, delimiters=("=",))
    parser.optionxform = str  # type: ignore[assignment]
    parser.read_string((made.files() | made.router())[UNITS / unit])
    return parser["Service"]


def analyze(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed: the units are not checked by systemd")
    environment = {**os.environ, "SYSTEMD_UNIT_PATH": f"{folder / UNITS}:"}
    return subprocess.run(
        ["systemd-analyze", *words], capture_output=True, text=True, check=False, env=environment, cwd=folder / UNITS
    )


@pytest.mark.parametrize(
    "text", [HWMON, SERIAL, WATCHED, HWMON + SERIAL + IPMI], ids=["hwmon", "serial", "watched", "all"]
)
@pytest.mark.parametrize("folder", ["/etc/fantwin", "/home/ann/the fans"])
def test_systemd_accepts_the_units_which_may_do_little(text: str, folder: str, tmp_path: Path) -> None:
    made = service(text, Path(folder))
    written_below(tmp_path, made.files() | made.router())
    done = analyze(tmp_path, "verify", "--man=no", "fantwin.service", "fantwin-router.service")
    assert (done.returncode, done.stderr) == (0, "")
    for unit in ("fantwin.service", "fantwin-router.service"):
        done = analyze(tmp_path, "security", "--offline=yes", "--no-pager", f"--threshold={HIGHEST_EXPOSURE}", unit)
        print(done.stdout.splitlines()[-1])
        assert done.returncode == 0, done.stdout + done.stderr


def test_the_commands_of_the_units_are_those_of_fantwin() -> None:
    for unit, name in (("fantwin.service", "up"), ("fantwin-router.service", "router")):
        words = shlex.split(settings(service(HWMON), unit)["ExecStart"].removeprefix(":"))
        assert words[:5] == [sys.executable, "-P", "-m", "fantwin", name]
        assert parsed(words[4:])["config"] == Path("/etc/fantwin/fantwin.toml")


def test_only_what_a_source_needs_is_open() -> None:
    found = {
        "hwmon": settings(service(HWMON)),
        "serial": settings(service(SERIAL)),
        "watched": settings(service(WATCHED)),
        "ipmi": settings(service(IPMI)),
    }
    assert {name: each["ProtectKernelTunables"] for name, each in found.items()} == {
        "hwmon": "no", "serial": "yes", "watched": "yes", "ipmi": "yes"
    }  # fmt: skip
    assert {name: each["PrivateDevices"] for name, each in found.items()} == {
        "hwmon": "yes", "serial": "no", "watched": "yes", "ipmi": "no"
    }  # fmt: skip
    assert found["ipmi"]["DeviceAllow"] == "char-ipmidev rw"
    assert service(IPMI).files()[RULES] == 'SUBSYSTEM=="ipmi", GROUP="fantwin", MODE="0660"\n'
    assert found["serial"]["DeviceAllow"] == "char-ttyACM rw" and found["serial"]["SupplementaryGroups"] == "dialout"
    assert RULES not in service(SERIAL + WATCHED).files()
    rule = service(HWMON).files()[RULES]
    assert 'ATTR{name}=="nct6798"' in rule and "chgrp -f fantwin /sys%p/pwm[0-9]" in rule


def test_of_a_home_only_the_folders_of_fantwin_are_seen_and_the_user_is_the_one_of_the_configuration(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ann = next(each for each in pwd.getpwall() if each.pw_uid)
    made = service(HWMON.replace("/var", "/home/ann"), Path("/home/ann/fans"), ann.pw_name)
    found = settings(made)
    assert (found["User"], found["ProtectHome"]) == (ann.pw_name, "tmpfs")
    assert "/home/ann/fans" in found["BindReadOnlyPaths"].split()
    assert found["SupplementaryGroups"] == "fantwin", "by which it may command the fans"
    assert made.files()[USERS / "fantwin.conf"] == "g fantwin -\n"
    outside = settings(Service())
    assert outside["ProtectHome"] == "yes" and outside["StateDirectory"] == "fantwin"


HARD = 'ann\'s "$HOME" 5 % a:b \\\\ é'
"""a name of a folder with all that means something in a unit"""


def test_systemd_reads_every_path_as_it_is_called(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service_files, "_HOMES", (f"{tmp_path}/",))
    folder = tmp_path / HARD
    (folder / "bin").mkdir(parents=True)
    (folder / "bin" / "python").symlink_to(sys.executable)
    made = service(HWMON, folder)
    made = replace(made, program=(str(folder / "bin" / "python"), "-P"), run_folder=folder / "runs")
    made = replace(made, written=(folder / "hwmon",))
    written_below(tmp_path, made.files() | made.router())
    done = analyze(tmp_path, "verify", "--man=no", "fantwin.service", "fantwin-router.service")
    assert (done.returncode, done.stderr) == (0, "")
    started = settings(made)["ExecStart"].removeprefix(":")
    words = [word.replace("%%", "%").replace("\\'", "'") for word in shlex.split(started)]
    assert words == ["/usr/bin/env", *made.program, "up", "-c", str(made.config)]


def test_whatever_the_configuration_names_by_a_path_is_seen_of_a_home(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service_files, "_HOMES", (f"{tmp_path}/",))
    folder, others = tmp_path / "site", [tmp_path / name for name in ("users", "mail", "bmc", "certs", "hw", "twins")]
    for each in (folder, *others):
        each.mkdir()
        (each / "file").write_text("https://ntfy.sh/a\n")
        (each / "file").chmod(0o600)
    text = f"""
[bus]
mode = "client"
endpoint = "tls/router:7447"
security = {{ folder = "../certs" }}
[gateway]
users = "../users/file"
[[notifier.target]]
name = "desk"
url_file = "{tmp_path}/mail/file"
[[tray]]
name = "board"
fans = 1
twin = "../twins/file"
source = {{ kind = "hwmon", chip = "nct6798", writable = true, root = "../hw" }}
[[tray]]
name = "bmc"
fans = 1
source = {{ kind = "redfish", url = "https://ann@a", fans = ["F"], password_file = "../bmc/file" }}
"""
    found = settings(service(text, folder))
    assert {str(folder), *map(str, others)} <= set(found["BindReadOnlyPaths"].split())


def test_the_rule_lets_the_group_write_the_commands_of_a_chip(tmp_path: Path) -> None:
    """By the shell that udev would start, on files like those of the kernel."""
    for name in ("pwm1", "pwm1_enable", "fan1_input"):
        (tmp_path / name).touch(mode=0o644)
    script = service(HWMON).files()[RULES].split("-c '")[1].split("'")[0]
    subprocess.run(
        ["sh", "-c", script.replace("/sys%p", str(tmp_path)).replace("fantwin", str(os.getegid()))], check=False
    )
    assert {path.name: path.stat().st_mode & 0o020 for path in tmp_path.iterdir()} == {
        "pwm1": 0o020, "pwm1_enable": 0o020, "fan1_input": 0
    }  # fmt: skip

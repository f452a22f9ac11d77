"""`fantwin service` installs, shows and removes; the programs of the system are stand-ins that note what was asked."""

from __future__ import annotations

import json
import os
import pwd
import shutil
from pathlib import Path
from typing import NoReturn

import pytest

from fantwin.pipeline.cli.watch import service as module
from fantwin.pipeline.cli.watch import service_files
from tests.support.fantwin_command import error_of, fantwin
from tests.support.ports import free_port
from tests.support.running_chain import DEMO

PROGRAMS = ("systemctl", "systemd-sysusers", "udevadm", "chown")
TRAY = '[[tray]]\nname = "board"\nfans = 2\nsource = { kind = "hwmon", chip = "nct6798", writable = true }\n'


class Host:
    """A host that runs systemd: `calls` are what its programs were asked; `active`: the service runs."""

    def __init__(self, folder: Path) -> None:
        self.root, self._log, self._active = folder / "root", folder / "log", folder / "active"
        (self.root / "run/systemd/system").mkdir(parents=True)
        (folder / "bin").mkdir()
        for name in PROGRAMS:
            program = folder / "bin" / name
            program.write_text(
                f'#!/bin/sh\nif [ "$1" = is-active ]; then test -e {self._active}; exit; fi\n'
                f'echo {name} "$@" >> {self._log}\n[ "$1" != restart ] || touch {self._active}\n'
                f'[ "$1" != disable ] || rm {self._active}\n'
            )
            program.chmod(0o755)

    @property
    def calls(self) -> list[str]:
        return self._log.read_text().splitlines()


@pytest.fixture
def host(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Host:
    host = Host(tmp_path)
    monkeypatch.setattr(module, "SYSTEM", host.root)
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(module, "may_be_read", lambda _: "")
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    monkeypatch.chdir(tmp_path)
    bus = f'[bus]\nendpoint = "tcp/127.0.0.1:{free_port()}"\n'
    (tmp_path / "fantwin.toml").write_text(f"{bus}[gateway]\nport = 8123\n{TRAY}")
    return host


def test_it_is_installed_started_shown_and_removed(host: Host, tmp_path: Path) -> None:
    shown = fantwin("service", "status", "--json")
    assert (shown.exit_code, json.loads(shown.stdout)) == (1, {"installed": False, "active": False})
    done = fantwin("service", "install", "--json")
    assert done.exit_code == 0, done.exception
    found = json.loads(done.stdout)
    assert (found["user"], found["pages"]) == ("fantwin", ["http://127.0.0.1:8123/"])
    there = {str(path.relative_to(host.root)) for path in host.root.rglob("*") if path.is_file()}
    files = {"etc/systemd/system/fantwin.service", "etc/udev/rules.d/60-fantwin.rules", "etc/sysusers.d/fantwin.conf"}
    assert there == files == {str(Path(path).relative_to(host.root)) for path in found["files"]}
    order = [call.split()[0] + " " + call.split()[1] for call in host.calls]
    assert order[0].startswith("systemd-sysusers"), "the user is there before files are given to it"
    assert host.calls[-3:] == [
        "systemctl daemon-reload",
        "systemctl enable fantwin.service",
        "systemctl restart fantwin.service",
    ]
    assert f"chown -R fantwin:fantwin {tmp_path / 'runs'}" in host.calls
    assert fantwin("service").exit_code == 0
    removed = fantwin("service", "uninstall")
    assert removed.exit_code == 0 and removed.stdout.count("removed: ") == 3
    assert not [path for path in host.root.rglob("*") if path.is_file()]
    assert (tmp_path / "runs").is_dir(), "data are kept"
    assert error_of("service", "uninstall") == "the service is not installed"


@pytest.mark.skipif(os.getuid() != 0, reason="only root has files that belong to others")
def test_the_service_may_read_what_root_has_made_for_it(host: Host, tmp_path: Path) -> None:
    """root owns the configuration, so the service has a user of its own, to whom a private file is closed."""
    config = tmp_path / "fantwin.toml"
    config.write_text(config.read_text().replace("[gateway]\n", '[gateway]\nusers = "users.toml"\n'))
    add_user = fantwin("users", "add", "ann", typed="correct horse battery\n")
    assert add_user.exit_code == 0, add_user.exception
    done = fantwin("service", "install", "--dry-run")
    assert f"chown -R fantwin:fantwin {tmp_path}/runs {tmp_path}/users.toml" in done.stdout.splitlines()
    os.chown(tmp_path / "users.toml", 7, 7)
    fantwin("users", "add", "vic", typed="correct horse battery\n")
    assert (tmp_path / "users.toml").stat().st_uid == 7, "who may read it can read it still"
    (tmp_path / "users.toml").unlink()
    (tmp_path / "runs").mkdir()
    os.chown(tmp_path / "runs", 7, 7)
    fantwin("users", "add-token", "grafana")
    assert (tmp_path / "users.toml").stat().st_uid == 7, "new ones are of whose the run folder is"
    (tmp_path / "users.toml").rename(tmp_path.parent / "users.toml")
    config.write_text(config.read_text().replace('"users.toml"', '"../users.toml"'))
    there = tmp_path.parent / "users.toml"
    copied = f"cp {there} {tmp_path}, and name the copy"
    assert error_of("service", "install") == f"{there}: the user fantwin may not read it: {copied}"


def test_a_dry_run_prints_the_files_and_commands_and_changes_nothing(host: Host, tmp_path: Path) -> None:
    done = fantwin("service", "install", "--dry-run")
    assert done.exit_code == 0 and "ProtectKernelTunables=no" in done.stdout
    assert done.stdout.splitlines()[-1] == "systemctl restart fantwin.service"
    lacks = (
        "no twin yet of tray board: the service learns it while the plant moves the fans; sooner: fantwin commission"
    )
    assert done.stderr == f"{lacks} --sweep\n"
    named = tmp_path / "named.toml"
    named.write_text(f'{TRAY}twin = "board.onnx"\n')
    for more in ((), ("--dry-run",)):
        missing = error_of("service", "install", "-c", named, *more)
        assert missing.startswith(f"{tmp_path}/board.onnx: "), "as `up` would refuse it"
    named.write_text(f"{TRAY}[launcher]\nwithout = ['learner']\n")
    assert "tray board has no twin: set" in error_of("service", "install", "-c", named, "--dry-run")
    assert not [path for path in host.root.rglob("*") if path.is_file()]


def test_what_keeps_it_from_being_installed_is_one_line(host: Host, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object) -> bool:
        return True

    with monkeypatch.context() as patch:
        patch.setattr(module, "accepts_connections", fails)
        assert "something runs there: end `fantwin up` first (Ctrl-C)" in error_of("service", "install")
    with monkeypatch.context() as patch:
        patch.setattr(os, "geteuid", lambda: 1000)
        said = error_of("service", "install")
        assert said.startswith("service install needs root: sudo ")
        assert said.endswith("-m fantwin service install -c fantwin.toml")
    with monkeypatch.context() as patch:
        patch.setattr(module, "may_be_read", lambda _: "/srv/fans")
        closed = "/srv/fans is closed to the user fantwin: chmod o+x /srv/fans, or name another user with --user"
        assert error_of("service", "install") == closed
    (host.root / "run/systemd/system").rmdir()
    assert "this system is not run by systemd" in error_of("service", "install")
    assert not [path for path in host.root.rglob("*") if path.is_file()]


def test_a_service_that_does_not_start_is_one_line(host: Host, tmp_path: Path) -> None:
    (tmp_path / "bin" / "systemctl").write_text(
        '#!/bin/sh\nif [ "$1" = restart ]; then echo "Job for fantwin.service failed." >&2; exit 1; fi\n'
        '[ "$1" != is-active ]\n'
    )
    said = error_of("service", "install")
    assert said == (
        "systemctl restart fantwin.service: Job for fantwin.service failed.; journalctl -u fantwin says more"
    )


def test_a_configuration_of_nobody_is_refused_and_a_twin_beside_its_folder_is_seen_in_a_home(
    host: Host, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    twins, config = tmp_path / "twins", tmp_path / "site" / "fantwin.toml"
    twins.mkdir()
    config.parent.mkdir()
    shutil.copy(DEMO / "twin.onnx", twins)
    config.write_text('[[tray]]\nname = "tray1"\nfans = 8\nport = "/dev/none"\ntwin = "../twins/twin.onnx"\n')
    monkeypatch.setattr(service_files, "_HOMES", (f"{tmp_path}/",))
    unit = fantwin("service", "install", "--dry-run", "-c", config, "--user", "root").stdout
    (shown,) = (line for line in unit.splitlines() if line.startswith("BindReadOnlyPaths="))
    assert {str(twins), str(config.parent)} <= set(shown.partition("=")[2].split())

    def unknown(_: int) -> NoReturn:
        raise KeyError

    monkeypatch.setattr(pwd, "getpwuid", unknown)
    if os.getuid() == 0:
        os.chown(config, 12345, -1)
    assert "is no user of this system: name one with --user" in error_of("service", "install", "-c", config)

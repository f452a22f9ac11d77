"""`fantwin service`: a site that starts at boot, under systemd."""

from __future__ import annotations

import os
import pwd
import shlex
import shutil
import subprocess
import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from fantwin.pipeline.bus.endpoint import accepts_connections
from fantwin.pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.cli.watch.next_step import next_commands, what_lacks
from fantwin.pipeline.cli.watch.service_files import (
    RULES,
    UNIT,
    UNITS,
    USERS,
    Service,
    may_be_read,
    owner_of,
    unreadable_files,
    written_below,
)
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.launch.launcher import Launcher
from fantwin.pipeline.launch.this_host import load_for_this_host, page_addresses, with_free_ports

SYSTEM = Path("/")
_RUNS_SYSTEMD = Path("run/systemd/system")


class ServiceTask(StrEnum):
    """The tasks, as they are typed."""

    INSTALL = "install"
    UNINSTALL = "uninstall"
    STATUS = "status"


def service(
    task: Annotated[
        ServiceTask, typer.Argument(metavar="TASK", help=f"{', '.join(ServiceTask)}.")
    ] = ServiceTask.STATUS,
    config: ConfigOption = DEFAULT_CONFIG,
    user: Annotated[
        str | None,
        typer.Option(help="install: who runs it. Default: the owner of the configuration; if that is root, fantwin."),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="install: print the files and commands, and change nothing.")
    ] = False,
    json_output: JsonOption = False,
) -> None:
    """Let systemd start `fantwin up` at boot; end that; or say whether it runs.

    install starts this installation with the configuration where it is, with few rights, and prints the address of the
    operators' page. uninstall removes the files that install wrote, and keeps data and user.

    Exit code 1 if it could not be done; status: if it does not run.

    Example: sudo fantwin service install -c fantwin.toml

    Example: fantwin service install --dry-run
    """
    if dry_run and task is not ServiceTask.INSTALL:
        raise UsageError(f"--dry-run is for install: leave it out with {task}")
    if task is ServiceTask.INSTALL:
        _install(config, user, is_dry=dry_run, json_output=json_output)
    elif task is ServiceTask.UNINSTALL:
        _require_root(task, config)
        there = [
            path for path in (SYSTEM / UNITS / UNIT, SYSTEM / RULES, SYSTEM / USERS / "fantwin.conf") if path.exists()
        ]
        if not there:
            raise UserError("the service is not installed")
        _run("systemctl", "disable", "--now", UNIT)
        for path in there:
            path.unlink()
        _run("systemctl", "daemon-reload")
        show(
            {"removed": [str(path) for path in there]}, *(f"removed: {path}" for path in there), json_output=json_output
        )
    else:
        is_active = _is_active()
        is_installed = (SYSTEM / UNITS / UNIT).exists()
        line = "runs" if is_active else "installed, does not run" if is_installed else "not installed"
        found = {"installed": is_installed, "active": is_active}
        show(found, f"{UNIT}: {line}; journalctl -u fantwin shows its log", json_output=json_output)
        if not is_active:
            raise typer.Exit(1)


def _install(config: Path, user: str | None, *, is_dry: bool, json_output: bool) -> None:
    if user is not None and user not in {each.pw_name for each in pwd.getpwall()} | {"fantwin"}:
        raise UsageError(f"--user {user}: no such user")
    here = load_for_this_host(config)
    made = Service.of(here.config, user or owner_of(config))
    if closed := may_be_read(made):
        raise UserError(
            f"{closed} is closed to the user {made.user}: chmod o+x {closed}, or name another user with --user"
        )
    closed_files = unreadable_files(here.config, made.user)
    if elsewhere := [each for each in closed_files if not each.is_relative_to(made.config.parent)]:
        copied = shlex.join(["cp", *map(str, elsewhere), str(made.config.parent)])
        raise UserError(f"{elsewhere[0]}: the user {made.user} may not read it: {copied}, and name the copy")
    Launcher(here.config, here.overrides, typer.echo).refuse_unusable_twins()
    if lacks := what_lacks(here.config):
        makes = next_commands(here.config)[-1][0]
        typer.echo(f"{lacks}: the service learns it while the plant moves the fans; sooner: {makes}", err=True)
    files = made.files()
    folder = made.run_folder
    commands = [["systemd-sysusers", str(SYSTEM / USERS / "fantwin.conf")]]
    if RULES in files:
        subsystems = [f"--subsystem-match={name}" for name in ("hwmon", "ipmi")]
        commands += [["udevadm", "control", "--reload"], ["udevadm", "trigger", *subsystems, "--settle"]]
    commands += [
        ["mkdir", "-p", str(folder)],
        ["chown", "-R", f"{made.user}:{made.group}", str(folder), *map(str, closed_files)],
        ["systemctl", "daemon-reload"],
        ["systemctl", "enable", UNIT],
        ["systemctl", "restart", UNIT],
    ]
    as_text = {str(SYSTEM / path): text for path, text in files.items()}
    shown = [shlex.join(words) for words in commands]
    if is_dry:
        lines = [f"# {path}\n{text}" for path, text in as_text.items()]
        show({"files": as_text, "commands": shown}, *lines, *shown, json_output=json_output)
        return
    _require_root(ServiceTask.INSTALL, config)
    if not _is_active():
        if here.config.bus.mode == "peer" and accepts_connections(here.config.bus.endpoint):
            raise UserError(f"{here.config.bus.endpoint}: something runs there: end `fantwin up` first (Ctrl-C)")
        here = with_free_ports(here, None)
    try:
        written = written_below(SYSTEM, files)
    except OSError as error:
        raise UserError(f"{error.filename}: cannot be written: {error.strerror}") from error
    for words in commands:
        _run(*words)
    pages = page_addresses(here.config)
    lines = [*(f"written: {path}" for path in written), f"{UNIT} runs as {made.user}, and starts at boot"]
    lines += [f"operators' page: {page}" for page in pages]
    found = {"files": [str(path) for path in written], "user": made.user, "pages": pages}
    show(found, *lines, json_output=json_output)


def _require_root(task: ServiceTask, config: Path) -> None:
    if shutil.which("systemctl") is None or not (SYSTEM / _RUNS_SYSTEMD).is_dir():
        raise UserError("this system is not run by systemd: start `fantwin up` by what runs it")
    if os.geteuid():
        words = ["sudo", sys.executable, "-m", "fantwin", "service", task, "-c", str(config)]
        raise UserError(f"service {task} needs root: {shlex.join(words)}")


def _is_active() -> bool:
    if shutil.which("systemctl") is None:
        return False
    done = subprocess.run(["systemctl", "is-active", "--quiet", UNIT], capture_output=True, check=False)
    return done.returncode == 0


def _run(*words: str) -> None:
    """Run a program of the system.

    Raises:
        UserError: it is not there, or has failed.
    """
    try:
        done = subprocess.run(words, capture_output=True, text=True, check=False)
    except FileNotFoundError as error:
        raise UserError(f"{words[0]} is not there: {shlex.join(words)} was not done") from error
    if done.returncode:
        said = " ".join((done.stderr or done.stdout).split()) or f"exit code {done.returncode}"
        raise UserError(f"{shlex.join(words)}: {said}; journalctl -u fantwin says more")

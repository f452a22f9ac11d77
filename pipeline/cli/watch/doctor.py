"""`fantwin doctor`: problems of an installation or a configuration, each with its remedy."""

from __future__ import annotations

import os
import re
import shutil
import sys
import threading
import time
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from enum import StrEnum
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import Annotated

import typer
from rich.text import Text

from fantwin.pipeline.bus.endpoint import accepts_connections, endpoint_problem, foreign_program
from fantwin.pipeline.bus.errors import BusError, NoAnswerError
from fantwin.pipeline.bus.opening import credentials_of
from fantwin.pipeline.bus.rights import SiteRoles
from fantwin.pipeline.bus.session import join_bus
from fantwin.pipeline.cli.exposure import exposure_problem, is_exposed
from fantwin.pipeline.cli.options import DEFAULT_CONFIG, JsonOption, SetOption
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.cli.watch.line_check import Finding, check_line
from fantwin.pipeline.cli.watch.message_check import send_test_messages
from fantwin.pipeline.config.registry import RECORDER, STAGES
from fantwin.pipeline.config.roles import READERS, role_names
from fantwin.pipeline.config.settings import Config, ConfigError
from fantwin.pipeline.config.shards import process_list
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.extras import how_to_install
from fantwin.pipeline.launch.this_host import load_for_this_host
from fantwin.pipeline.recordings.disk_room import usage_of
from fantwin.pipeline.runtime.second_owner import GOSSIP_S
from fantwin.pipeline.runtime.sessions import Session
from fantwin.pipeline.runtime.stage import Context, load_stage
from fantwin.schemas.topics import sessions_key

_NOT_LISTED = {"all", "dev", "bench"}  # a sum of others, or for tests and benches only
_GRANTED = "the router grants its rights"
_NOT_GRANTED = "the router does not grant the rights of its role: restart the router with this configuration"
_MIN_FREE_BYTES = 1 << 30
_KINDS = {True: ("ok  ", "green"), None: ("WARN", "bold yellow"), False: ("FIX ", "bold red")}
_LOOKS = 4
"""for the sessions of a site, GOSSIP_S apart"""


class Task(StrEnum):
    """What the doctor can do."""

    CHECK = "check"
    NOTIFY = "notify"
    SELFTEST = "selftest"
    SCHEMA = "schema"


def doctor(
    task: Annotated[
        Task,
        typer.Argument(
            help="Check installation and configuration, notify by test messages, selftest fantwin itself, or print the "
            "schema of the configuration."
        ),
    ] = Task.CHECK,
    targets: Annotated[
        list[str] | None,
        typer.Argument(metavar="[NAME]...", help="notify: targets; selftest: scenarios; all if omitted."),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            "-c", "--config", help=f"The configuration to check. Default: {DEFAULT_CONFIG}, if it is in this folder."
        ),
    ] = None,
    overrides: SetOption = None,
    json_output: JsonOption = False,
    listen_s: Annotated[
        float,
        typer.Option(min=0.0, max=600.0, help="check: how long to listen to the line of each tray; 0: not at all."),
    ] = 2.0,
    trays: Annotated[
        list[str] | None,
        typer.Option("--tray", metavar="NAME", help="check: only the source and line of this tray. Repeatable."),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FOLDER", help="selftest: keep its files in this new folder."),
    ] = None,
) -> None:
    """Check the installation and a configuration, send test messages, or test fantwin itself on this computer.

    check listens to the line of each tray and names what does not fit: rate, commands, speeds, fans, unit, tachos.
    notify sends a message to the targets of the notifier, and says which ones accepted it. selftest kills, freezes and
    floods the stages of a simulated site with its own port and folder, in about three minutes, and leaves running sites
    alone. schema prints a JSON schema, by which editors complete a fantwin.toml that begins with
    `#:schema ./fantwin.schema.json`.

    Exit code 1 if there is a problem to fix, a message that was not accepted, or a promise that was not kept.

    Example: fantwin doctor -c fantwin.toml

    Example: fantwin doctor selftest kill hang

    Example: fantwin doctor schema > fantwin.schema.json
    """
    if output and task is not Task.SELFTEST:
        raise UsageError(f"-o is for selftest: leave it out with {task}")
    if task is Task.SELFTEST:
        from fantwin.pipeline.cli.watch.selftest import run_selftest  # noqa: PLC0415  loads the simulation

        run_selftest(targets or (), output, json_output=json_output)
    elif task is Task.NOTIFY:
        send_test_messages(config or DEFAULT_CONFIG, overrides or (), targets or (), json_output=json_output)
    elif task is Task.SCHEMA:
        from fantwin.pipeline.config.json_schema import schema_text  # noqa: PLC0415  imports all stages

        typer.echo(schema_text(), nl=False)
    else:
        found = list(_findings(config, overrides, listen_s, trays or []))
        by_kind = {kind: [line for is_kind, line in found if is_kind is kind] for kind in _KINDS}
        lines = [Text.assemble(_KINDS[kind], f" {line}") for kind, listed in by_kind.items() for line in listed]
        good, warnings, problems = by_kind.values()
        said = {"ok": not problems, "problems": problems, "warnings": warnings, "good": good}
        show(said, *lines, json_output=json_output)
        if problems:
            raise typer.Exit(1)


def _findings(config: Path | None, overrides: list[str] | None, listen_s: float, trays: list[str]) -> Iterator[Finding]:
    """The finding of each check. trays: those whose lines are checked; empty for all."""
    yield True, f"Python {sys.version.split()[0]}"
    yield from _check_packages()
    if config is None and not DEFAULT_CONFIG.exists():
        yield True, f"no {DEFAULT_CONFIG} in this folder, and none given with -c: only the installation was checked"
        return
    config = config or DEFAULT_CONFIG
    try:
        here = load_for_this_host(config, overrides or ())
        settings = here.config
        lines = {settings.tray(name).name for name in trays} or {tray.name for tray in settings.trays}
    except ConfigError as error:
        yield False, str(error)
        return
    yield True, f"{config}: site {settings.site!r}, trays {', '.join(tray.name for tray in settings.trays)}"
    yield from ((True, line) for line in here.left_out)
    yield from _check_run_folder(settings.run_folder)
    running: list[Session] = []
    yield from _check_bus(settings, running)
    yield from _check_certificates(settings)
    yield from _check_stages(settings, running, listen_s, lines)


def _check_packages() -> Iterator[Finding]:
    """Every package that fantwin's own metadata requires; one that only an extra requires may be missing."""
    try:
        requirements = requires("fantwin") or []
    except PackageNotFoundError:
        yield False, "fantwin is not installed: in its checkout, pip install -e ."
        return
    extras: dict[str, list[str]] = {}
    needed: list[str] = []
    for requirement in requirements:
        name = re.split(r"[^A-Za-z0-9._-]", requirement)[0]
        if extra := re.search(r"\bextra\s*==\s*['\"]([^'\"]+)", requirement):
            extras.setdefault(extra[1], []).append(name)
        else:
            needed.append(name)
    if missing := [name for name in needed if not _version(name)]:
        yield False, f"{', '.join(missing)}: not installed; {how_to_install('fantwin')}"
    else:
        yield True, f"{len(needed)} packages that it needs are installed"
    there: list[str] = []
    for extra in sorted(extras.keys() - _NOT_LISTED):
        if missing := [name for name in extras[extra] if not _version(name)]:
            yield True, f"extra {extra!r}: not installed ({', '.join(missing)}); {how_to_install(f'fantwin[{extra}]')}"
        else:
            there.append(extra)
    if there:
        yield True, f"extras installed: {', '.join(there)}"


def _check_run_folder(folder: Path) -> Iterator[Finding]:
    existing = next(parent for parent in (folder, *folder.parents) if parent.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        yield False, f"run_folder {folder}: {existing} is not a folder this user may write to; name another"
        return
    free = shutil.disk_usage(existing).free
    advice = "" if free > _MIN_FREE_BYTES else "; make room or name another folder"
    yield not advice, f"run_folder {folder}: {free / 1e9:.1f} GB free{advice}"


def _check_bus(settings: Config, running: list[Session]) -> Iterator[Finding]:
    """Whether processes can meet at the endpoint. Adds the sessions of the site that run there."""
    config, endpoint = settings.bus, settings.bus.endpoint
    if problem := endpoint_problem(endpoint):
        yield False, problem
        return
    if is_exposed(config):
        yield False, exposure_problem(config)
    if not accepts_connections(endpoint):
        yield True, f"bus.endpoint {endpoint}: {'free' if config.mode == 'peer' else 'no router yet'}"
        return
    try:
        running += running_sessions(settings)
        if not running and config.mode == "peer" and (others := sorted(_other_sites(settings))):
            yield (
                None,
                (
                    f"bus.endpoint {endpoint}: site {others[0]!r} runs there, not {settings.site!r}: two sites on one "
                    "host need two ports: choose another"
                ),
            )
        else:
            site = f"site {settings.site!r} runs there" if running else "fantwin answers there"
            yield True, f"bus.endpoint {endpoint}: {site}"
    except NoAnswerError as error:
        yield False, str(error)
    except BusError:
        yield False, foreign_program(endpoint, is_secure=config.security is not None)


def _check_certificates(settings: Config) -> Iterator[Finding]:
    """The certificates of the processes of this configuration that this host has; whether the router grants each of
    them what its role needs."""
    security, site = settings.bus.security, SiteRoles.of(settings)
    if security is None:
        return
    answers = settings.bus.mode == "client" and accepts_connections(settings.bus.endpoint)
    roles = [role for row in process_list(settings) for role in role_names(row.stage, row.shard)]
    here = [role for role in dict.fromkeys((*roles, *READERS)) if security.certificate(role).exists()]
    if not here:
        yield False, f"{security.folder}: no certificate of any role here: `fantwin certs issue` makes them"
    for role in here:
        try:
            credentials = credentials_of(settings.bus, (role,))
            assert credentials
            if warning := credentials.warning():
                yield False, warning
            elif credentials.role not in site.roles:
                yield False, f"{credentials.certificate}: {credentials.role!r} is no role of this configuration"
            elif answers:
                with join_bus(settings, listens=False, roles=(role,)) as bus:
                    is_granted = bus.has_all_rights_of_its_role(site)
                yield is_granted, f"certificate of {role}: {_GRANTED if is_granted else _NOT_GRANTED}"
            else:
                yield True, f"certificate of {role}: until {credentials.own.not_after:%Y-%m-%d}"
        except BusError as error:
            yield False, str(error)


def running_sessions(settings: Config) -> list[Session]:
    """The sessions of the site that run, by name; those are waited for that the first one met still introduces."""
    found = filter(None, map(Session.of_key, _alive(settings, settings.site)))
    return sorted(found, key=lambda session: session.name)


def _other_sites(settings: Config) -> set[str]:
    """The sites whose sessions are at the endpoint of this one."""
    return {key.split("/")[1] for key in _alive(settings, "*")} - {settings.site}


def _alive(settings: Config, site: str) -> set[str]:
    """The tokens of sessions. site: its name, or *."""
    found: set[str] = set()
    with join_bus(settings, listens=False) as bus:
        bus.wait_for_others(threading.Event())
        for _ in range(_LOOKS):
            found |= bus.alive(sessions_key(site))
            time.sleep(GOSSIP_S)
    return found


def _check_stages(
    config: Config, running: Sequence[Session], listen_s: float, lines: Collection[str]
) -> Iterator[Finding]:
    """lines: the trays whose devices are checked."""
    found: dict[str, list[str]] = {}
    """by problem: the processes that have it"""
    for row in process_list(config):
        has_devices = STAGES[row.stage].scope == "tray"
        trays = tuple(config.tray(name) for name in row.shard.trays if not has_devices or name in lines)
        if not trays:
            continue
        ours = Session.of_this_process(row.stage, row.shard, 0, "")
        session = next((s for s in running if s.stage == row.stage and s.shares_a_tray_with(ours)), None)
        whole = Context(
            site=config.site,
            trays=trays,
            config=config.sections[row.stage],
            folder=config.folder,
            run_folder=config.run_folder,
            instance=row.instance,
            shard_number=row.shard.number,
            started_t_ns=time.time_ns(),
            is_running=session is not None and session.host == ours.host,
        )
        stage = load_stage(row.stage)
        contexts = [replace(whole, trays=(tray,)) for tray in trays] if stage.core_per_tray else [whole]
        if problems := dict.fromkeys(problem for context in contexts for problem in stage.check(context)):
            for problem in problems:
                found.setdefault(problem, []).append(row.label)
            continue
        other = f" as {session.name}" if session and session.name != row.label else ""
        yield True, f"{row.label}: {f'runs already{other} ({session.process})' if session else 'can start'}"
        if row.stage == RECORDER:
            yield _recordings(whole, row.label)
        if row.stage == "acquisition" and listen_s:
            for context in contexts:
                yield from check_line(context, config, listen_s, is_running=session is not None)
    yield from ((False, f"{', '.join(labels)}: {problem}") for problem, labels in found.items())


def _recordings(context: Context, label: str) -> tuple[bool, str]:
    """The space and days that recordings take of their limits."""
    try:
        folder = context.own_file(context.config.file).parent
        return True, f"{label}: {usage_of(folder, context.config, context.started_t_ns)}"
    except (OSError, UserError) as error:
        return False, f"{label}: the recordings cannot be read: {error}"


def _version(package: str) -> str:
    """The installed version; empty if the package is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""

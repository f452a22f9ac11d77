"""`fantwin certs`: a site's authority, and the certificates of its processes and people."""

from __future__ import annotations

import re
import socket
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from cryptography.hazmat.primitives.serialization import Encoding

from fantwin.pipeline.bus.credentials import warning
from fantwin.pipeline.certificates import (
    LONGEST_NAME,
    Authority,
    Certificate,
    in_words,
    is_host,
    read_certificate,
    write_pair,
)
from fantwin.pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from fantwin.pipeline.cli.printing import show, table_of
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.roles import default_roles, roles_of
from fantwin.pipeline.config.settings import Config, SecurityConfig, nearest
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.files import PUBLIC, write_whole

_AUTHORITY_DAYS, _DAYS = 3653, 397
_HERE = ("localhost", "127.0.0.1", "::1")
_EVERYWHERE = ("0.0.0.0", "::", "*")
_HOST = re.compile(r"[a-z]+/(\[[^\]]*\]|[^:/?#]*):\d+.*")


class Action(StrEnum):
    """The actions, as they are typed."""

    INIT = "init"
    ISSUE = "issue"
    RENEW = "renew"
    SHOW = "show"


@dataclass(frozen=True)
class _Request:
    """What was typed, except the action."""

    config: Config
    security: SecurityConfig
    authority: Path
    roles: Sequence[str]
    hosts: Sequence[str]
    days: int | None
    replace: bool


def certs(
    action: Annotated[Action, typer.Argument(metavar="ACTION", help=f"{', '.join(Action)}.")],
    roles: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[ROLE]...", help="Roles: a stage, operator, viewer, router, source, ... as explained above."
        ),
    ] = None,
    config: ConfigOption = DEFAULT_CONFIG,
    authority: Annotated[
        Path, typer.Option(help="Folder of the authority's certificate and key; relative to the configuration.")
    ] = Path("authority"),
    tray: Annotated[list[str] | None, typer.Option(metavar="NAME", help="Only for this tray. Repeatable.")] = None,
    host: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="A further name or address at which its owner listens. Repeatable."),
    ] = None,
    days: Annotated[
        int | None,
        typer.Option(
            min=1, max=36_500, help=f"Days for which it is valid; default {_DAYS}, of an authority {_AUTHORITY_DAYS}."
        ),
    ] = None,
    replace: Annotated[bool, typer.Option("--replace", help="Replace what exists.")] = False,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """Make and show certificates of a site: who may do what on its bus (docs/how-to/security.md).

    init makes the site's authority. issue makes the certificates of the named roles; without a role, those that the
    site needs and that do not exist yet. renew makes new ones for the same roles and hosts. show lists all, with their
    roles and when they expire.

    A role is a stage, operator (may command and send requests), viewer (may look), router, source (may push samples),
    replay, or a controller named in bus.security. With --tray it is for one tray only, and called, for example,
    acquisition.tray1. Files are in the folder of bus.security: certs/ROLE.pem and certs/ROLE.key. Give a host only the
    files of its own processes, and keep the folder of the authority elsewhere: whoever has its key can act in every
    role.

    Exit code 1 if show finds a certificate that has expired or is not valid yet.

    Example: fantwin certs init -c fantwin.toml

    Example: fantwin certs issue -c fantwin.toml --host plant-router.example

    Example: fantwin certs issue acquisition --tray tray1 -c fantwin.toml

    Example: fantwin certs show -c fantwin.toml
    """
    for name in host or ():
        if not is_host(name):
            raise UsageError(
                f"--host {name!r}: give a name of ASCII letters (of others its form xn--...) or an address"
            )
    settings = load_config(config, overrides or (), stages=())
    security = settings.bus.security or SecurityConfig().within(settings.folder)
    wanted = _with_trays(settings, roles or [], tray or [])
    request = _Request(settings, security, settings.folder / authority, wanted, host or (), days, replace)
    if action is Action.SHOW:
        _show(request, json_output=json_output)
        return
    if action is Action.INIT and (roles or tray):
        raise UsageError("init takes no role: it makes the authority; `fantwin certs issue` makes certificates")
    made, kept = {Action.INIT: _init, Action.ISSUE: _issue, Action.RENEW: _renew}[action](request)
    found = {"made": [_as_json(each) for each in made], "kept": [str(path) for path in kept]}
    lines = [
        f"{_shown(each.path)}: {'authority' if each.is_authority else f'certificate of {each.role}'}, "
        f"until {in_words(each.not_after)}"
        for each in made
    ]
    lines += [f"{_shown(path)}: exists, left as it is" for path in kept]
    show(found, *lines, *_next_steps(settings, action), json_output=json_output)


def _with_trays(config: Config, roles: Sequence[str], trays: Sequence[str]) -> list[str]:
    """The roles asked for, each for these trays only if any are given.

    Raises:
        UsageError: there is no such role or tray.
    """
    if trays and not roles:
        raise UsageError("--tray needs a role: name one")
    asked = [f"{role}.{config.tray(name).name}" for role in roles for name in trays] if trays else list(roles)
    known = roles_of(config)
    for role in asked:
        if role not in known:
            of_all = [name for name in known if "." not in name]
            raise UsageError(f"no role called {role!r}{nearest(role, list(known) if '.' in role else of_all)}")
        if len(role) > LONGEST_NAME:
            raise UsageError(f"role {role!r} has more than {LONGEST_NAME} characters: give its tray a shorter name")
    return asked


def _init(request: _Request) -> tuple[list[Certificate], list[Path]]:
    ca = request.security.ca
    if not request.replace and ca.exists():
        raise UserError(f"{ca} exists: --replace makes a new authority, and all certificates must be issued again")
    made = Authority.new(request.config.site, timedelta(days=request.days or _AUTHORITY_DAYS))
    made.write(request.authority, replace=request.replace)
    write_whole(ca, made.certificate.public_bytes(Encoding.PEM), "", PUBLIC)
    return [read_certificate(request.authority / "ca.pem"), read_certificate(ca)], []


def _issue(request: _Request) -> tuple[list[Certificate], list[Path]]:
    files = {role: request.security.certificate(role) for role in request.roles or default_roles(request.config)}
    stays = [] if request.roles or request.replace else [path for path in files.values() if path.exists()]
    wanted = [role for role, path in files.items() if path not in stays]
    return [_make(request, role, _hosts(request), replace=request.replace) for role in wanted], stays


def _renew(request: _Request) -> tuple[list[Certificate], list[Path]]:
    if request.roles:
        old = [read_certificate(request.security.certificate(role)) for role in request.roles]
    else:
        old = [each for each in _issued(request) if not each.is_authority]
    if not old:
        raise UserError(f"{request.security.folder}: no certificates: `fantwin certs issue` makes them")
    return [
        _make(request, each.role, (*each.hosts, *request.hosts), each.not_after - each.not_before, replace=True)
        for each in old
    ], []


def _make(
    request: _Request, role: str, hosts: Iterable[str], valid: timedelta = timedelta(_DAYS), *, replace: bool
) -> Certificate:
    security = request.security
    authority = Authority.read(request.authority)
    try:
        known = security.ca.read_bytes()
    except OSError as error:
        raise UserError(f"{security.ca}: {error.strerror}: `fantwin certs init` makes it") from error
    if authority.certificate.public_bytes(Encoding.PEM) != known:
        raise UserError(f"{security.ca} is not the certificate of {request.authority}: use the files of one site")
    signed, key = authority.issue(role, list(dict.fromkeys(hosts)), timedelta(request.days) if request.days else valid)
    certificate = security.certificate(role)
    write_pair(certificate, security.key(role), signed, key, replace=replace)
    return read_certificate(certificate)


def _hosts(request: _Request) -> list[str]:
    matches = filter(None, map(_HOST.fullmatch, request.config.bus.endpoints))
    of_endpoints = [match[1].strip("[]") for match in matches]
    names = [*_HERE, socket.gethostname(), *of_endpoints, *request.hosts]
    return [name for name in dict.fromkeys(names) if is_host(name) and name not in _EVERYWHERE]


def _issued(request: _Request) -> list[Certificate]:
    """The certificates in the folder of the site, and that of its authority first. A file of no role of the site that
    is no certificate is named on standard error, and left out.

    Raises:
        UserError: the file of a role, or of the authority, is no certificate.
    """
    security = request.security
    paths = [security.ca, *sorted(security.folder.glob("*.pem"))]
    own = {security.ca, *map(security.certificate, roles_of(request.config))}
    found: list[Certificate] = []
    for path in dict.fromkeys(paths):
        try:
            found += [read_certificate(path)] if path.exists() else []
        except UserError as error:
            if path in own:
                raise
            typer.echo(str(error), err=True)
    return found


def _show(request: _Request, *, json_output: bool) -> None:
    if request.roles:
        found = [read_certificate(request.security.certificate(role)) for role in request.roles]
    else:
        found = _issued(request)
    if not found:
        raise UserError(f"{request.security.folder}: no certificates: start with `fantwin certs init`")
    now, roles = datetime.now(UTC), roles_of(request.config)
    table = table_of((), (), ("role", "until", "days", "used by", *(["hosts"] if request.roles else [])))
    for column in table.columns:
        column.overflow = "fold"
    for each in found:
        known = roles.get(each.role)
        about = "authority of the site" if each.is_authority else known.about if known else "no role of this site"
        row = (each.role, f"{each.not_after:%Y-%m-%d}", str((each.not_after.date() - now.date()).days), about)
        table.add_row(*row, *([" ".join(each.hosts)] if request.roles else []))
    show([_as_json(each) for each in found], table, *filter(None, map(warning, found)), json_output=json_output)
    if any(each.time_problem(now) for each in found):
        raise typer.Exit(1)


def _shown(path: Path) -> Path:
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path


def _as_json(each: Certificate) -> dict[str, object]:
    return {
        "role": each.role,
        "file": str(each.path),
        "hosts": list(each.hosts),
        "from": each.not_before.isoformat(),
        "until": each.not_after.isoformat(),
        "is_authority": each.is_authority,
        "warning": warning(each),
    }


def _next_steps(config: Config, action: Action) -> list[str]:
    if action is Action.INIT:
        return [f"next: fantwin certs issue -c {config.path}"]
    if action is Action.ISSUE and config.bus.security is None:
        place = config.bus.endpoint.partition("/")[2]
        return [f'next: write into {config.path}: endpoint = "tls/{place}" in [bus], and a section [bus.security]']
    return []

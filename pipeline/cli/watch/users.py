"""`fantwin users`: the users of the gateway and of OPC UA."""

from __future__ import annotations

import sys
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from fantwin.pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.outputs.opcua.config import OpcuaConfig
from fantwin.pipeline.outputs.web.config import GatewayConfig
from fantwin.pipeline.site.users import (
    NAME,
    Accounts,
    Token,
    User,
    UserRole,
    checked_password,
    hasher,
    new_token,
    read_accounts,
    write_accounts,
)


class UserAction(StrEnum):
    """The actions, as they are typed."""

    LIST = "list"
    ADD = "add"
    REMOVE = "remove"
    ADD_TOKEN = "add-token"
    REMOVE_TOKEN = "remove-token"


def users(
    action: Annotated[UserAction, typer.Argument(metavar="ACTION", help=f"{', '.join(UserAction)}.")] = UserAction.LIST,
    name: Annotated[str | None, typer.Argument(help="Letters, digits, `.`, `_`, `@` and `-`.")] = None,
    role: Annotated[str, typer.Option(help="viewer: may only view; operator: may also act.")] = "viewer",
    days: Annotated[
        float | None, typer.Option(min=0.01, max=36500, help="With add-token: it ends after this time.")
    ] = None,
    config: ConfigOption = DEFAULT_CONFIG,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """List the users who may log in to the operators' page and over OPC UA, and the tokens of programs that use the
    page's API; add or remove one.

    `add` asks for the password, or reads it from a pipe. For an existing user, it changes the password and the role.
    `add-token` prints a token, once; a program sends it as `Authorization: Bearer TOKEN`.

    Example: fantwin users add ann --role operator

    Example: fantwin users remove ann

    Example: fantwin users add-token grafana --days 365
    """
    settings = load_config(config, overrides or (), stages=("gateway", "opcua"))
    gateway, opcua = settings.sections["gateway"], settings.sections["opcua"]
    assert isinstance(gateway, GatewayConfig)
    assert isinstance(opcua, OpcuaConfig)
    named = gateway.users or opcua.users
    if named is None:
        raise UserError(f'{config}: neither [gateway] nor [opcua] names a file of users: add users = "users.toml"')
    path = settings.folder / named
    if days is not None and action != UserAction.ADD_TOKEN:
        raise UsageError("--days is of a token: it needs add-token")
    found = read_accounts(path) if path.exists() else Accounts()
    if action == UserAction.LIST:
        _list(path, found, json_output=json_output)
        return
    if name is None:
        raise UsageError(f"give a name: fantwin users {action} NAME")
    if action in (UserAction.ADD_TOKEN, UserAction.REMOVE_TOKEN):
        if action == UserAction.ADD_TOKEN and gateway.users is None:
            raise UserError(
                f'{config}: [gateway] names no file of users, so its API takes no token: add users = "{named}"'
            )
        if action == UserAction.ADD_TOKEN and name in found.users:
            raise UserError(f"{path}: {name} is a user: give the token another name, which is shown where it acts")
        done = _change_tokens(path, found.tokens, action, name, role, days)
        lines = [*done.values()]
    else:
        if action == UserAction.ADD and name in found.tokens:
            raise UserError(f"{path}: {name} is a token: give the user another name")
        if action == UserAction.ADD:
            found.users[name] = _asked_for(name, role)
        elif found.users.pop(name, None) is None:
            raise UserError(f"{path}: no user {name!r}: there is {', '.join(found.users) or 'none'}")
        done = {"name": name, "done": "removed" if action == UserAction.REMOVE else f"{found.users[name].role} now"}
        lines = [f"{path}: {name}: {done['done']}"]
    write_accounts(path, found, next(each for each in (settings.run_folder, settings.folder) if each.exists()))
    show(done, *lines, json_output=json_output)


def _list(path: Path, found: Accounts, *, json_output: bool) -> None:
    users, tokens = found.users, found.tokens
    ends = {name: token.expires.isoformat() if token.expires else None for name, token in tokens.items()}
    listed = [{"kind": "user", "name": user.name, "role": str(user.role)} for user in users.values()]
    of_programs = [
        {"kind": "token", "name": name, "role": str(token.role), "expires": ends[name]}
        for name, token in tokens.items()
    ]
    lines = [f"{user.name}  {user.role}" for user in users.values()]
    for name, token in tokens.items():
        lines.append(f"{name}  {token.role}  token, {f'until {ends[name]}' if ends[name] else 'without an end'}")
    nobody = [f"{path}: no users: add one with `fantwin users add NAME`"]
    show([*listed, *of_programs], *(lines or nobody), json_output=json_output)


def _change_tokens(
    path: Path, tokens: dict[str, Token], action: UserAction, name: str, role: str, days: float | None
) -> dict[str, str]:
    """What was done, for people and machines: a new token, or that one was removed."""
    if action == UserAction.REMOVE_TOKEN:
        if tokens.pop(name, None) is None:
            raise UserError(f"{path}: no token {name!r}: there is {', '.join(tokens) or 'none'}")
        done = {"done": f"{name}: removed"}
    elif name in tokens:
        raise UserError(f"{path}: {name} has a token: end that first: fantwin users remove-token {name}")
    else:
        expires = datetime.now(UTC).replace(microsecond=0) + timedelta(days=days) if days is not None else None
        text, tokens[name] = new_token(name, _role(name, role), expires)
        done = {"token": text}
    return done


def _role(name: str, role: str) -> UserRole:
    """The role that is named, for a valid name."""
    if not NAME.fullmatch(name):
        raise UsageError(f"{name!r} is not a valid name: use up to 64 letters, digits, `.`, `_`, `@` and `-`")
    roles = [each.value for each in UserRole]
    if role not in roles:
        raise UsageError(f"--role {role}: {' or '.join(roles)}")
    return UserRole(role)


def _asked_for(name: str, role: str) -> User:
    named = _role(name, role)
    if sys.stdin.isatty():
        password = typer.prompt("Password", hide_input=True, confirmation_prompt=True)
    else:
        password = sys.stdin.readline().rstrip("\n")
    return User(name, named, hasher().hash(checked_password(password, name)))

"""`fantwin users`: the users of the gateway and of OPC UA."""

from __future__ import annotations

import sys
from enum import StrEnum
from typing import Annotated

import typer

from fantwin.pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.outputs.opcua.config import OpcuaConfig
from fantwin.pipeline.outputs.web.config import GatewayConfig
from fantwin.pipeline.site.users import NAME, User, UserRole, checked_password, hasher, read_users, write_users


class UserAction(StrEnum):
    """The actions, as they are typed."""

    ADD = "add"
    REMOVE = "remove"
    LIST = "list"


def users(
    action: Annotated[UserAction, typer.Argument(metavar="ACTION", help=f"{', '.join(UserAction)}.")] = UserAction.LIST,
    name: Annotated[str | None, typer.Argument(help="Letters, digits, `.`, `_`, `@` and `-`.")] = None,
    role: Annotated[str, typer.Option(help="viewer: may only view; operator: may also act.")] = "viewer",
    config: ConfigOption = DEFAULT_CONFIG,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """List the users who may log in to the operators' page and over OPC UA; add or remove one.

    `add` asks for the password, or reads it from a pipe. For an existing user, it changes the password and the role.

    Example: fantwin users add ann --role operator

    Example: fantwin users remove ann
    """
    settings = load_config(config, overrides or (), stages=("gateway", "opcua"))
    gateway, opcua = settings.sections["gateway"], settings.sections["opcua"]
    assert isinstance(gateway, GatewayConfig)
    assert isinstance(opcua, OpcuaConfig)
    named = gateway.users or opcua.users
    if named is None:
        raise UserError(f'{config}: neither [gateway] nor [opcua] names a file of users: add users = "users.toml"')
    path = settings.folder / named
    found = read_users(path) if path.exists() else {}
    if action == UserAction.LIST:
        listed = [{"name": user.name, "role": str(user.role)} for user in found.values()]
        lines = [f"{user.name}  {user.role}" for user in found.values()]
        show(listed, *(lines or [f"{path}: no users: add one with `fantwin users add NAME`"]), json_output=json_output)
        return
    if name is None:
        raise UsageError(f"name a user: fantwin users {action} NAME")
    if action == UserAction.REMOVE:
        if found.pop(name, None) is None:
            raise UserError(f"{path}: no user {name!r}: there is {', '.join(found) or 'none'}")
        done = "removed"
    else:
        found[name] = _asked_for(name, role)
        done = f"{found[name].role} now"
    write_users(path, found)
    show({"name": name, "done": done}, f"{path}: {name}: {done}", json_output=json_output)


def _asked_for(name: str, role: str) -> User:
    if not NAME.fullmatch(name):
        raise UsageError(f"{name!r} is not a valid name: use up to 64 letters, digits, `.`, `_`, `@` and `-`")
    roles = [each.value for each in UserRole]
    if role not in roles:
        raise UsageError(f"--role {role}: {' or '.join(roles)}")
    if sys.stdin.isatty():
        password = typer.prompt("Password", hide_input=True, confirmation_prompt=True)
    else:
        password = sys.stdin.readline().rstrip("\n")
    return User(name, UserRole(role), hasher().hash(checked_password(password, name)))

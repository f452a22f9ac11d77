"""Whether the words of a command, as a file outside of the code has them, are such that fantwin understands them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from typer.main import get_command

from fantwin.pipeline.cli import main as command_line
from fantwin.pipeline.cli.main import COMMANDS


def parsed(words: Sequence[str]) -> dict[str, Any]:
    """The values of the options and arguments of a command.

    Raises:
        click.UsageError: it is not understood.
    """
    name, *others = words
    registered = {command.name for command in command_line.app.registered_commands}
    command_line._register({name} & COMMANDS.keys() - registered)
    group = get_command(command_line.app)
    context = group.commands[name].make_context(name, list(others))  # pyright: ignore[reportAttributeAccessIssue]
    return context.params

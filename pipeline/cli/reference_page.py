"""docs/reference/commands.md: every command with its options, from the functions that are the commands.

`python -m fantwin.pipeline.cli.reference_page` writes the page to standard output, `make reference` the file.
"""

from __future__ import annotations

import inspect
import json
import sys
from collections.abc import Iterator, Sequence
from typing import Any

import typer
from typer.main import get_command

from fantwin.pipeline.cli.main import COMMANDS, PANELS, VARIADIC, app, function_of
from fantwin.pipeline.cli.simulation.scenario import Scenario
from fantwin.pipeline.config.reference_page import table, tables_within

_INTRODUCTION = f"""# Commands

`fantwin COMMAND --help` says the same on a terminal. Every command prints JSON for machines with `--json`, and what
went wrong as one line on standard error.

{app.info.epilog}

This page is made from the commands in the code: `make reference`. Options of several commands:
"""
_HEAD = ("| | default | |", "|---|---|---|")


def page() -> str:
    """The page, in Markdown."""
    group = typer.Typer()
    for name in COMMANDS:
        group.command(name)(function_of(name))
    commands: dict[str, Any] = get_command(group).commands  # pyright: ignore[reportAttributeAccessIssue]
    common = _in_several(commands)
    parts = [_INTRODUCTION, "\n".join([*_HEAD, *common, ""])]
    for folder, heading in PANELS.items():
        parts.append(f"## {heading}\n")
        for name in (name for name, (module, _) in COMMANDS.items() if module.startswith(f"{folder}.")):
            parts += _command(name, commands[name], common)
    parts += [
        "### The keys of a scenario\n",
        f"{inspect.getdoc(Scenario)}\n",
        table(Scenario),
        *tables_within(Scenario),
    ]
    return "\n".join(parts)


def _command(name: str, command: Any, common: Sequence[str]) -> Iterator[str]:
    arguments = [each for each in command.params if each.param_type_name == "argument"]
    options = [each for each in command.params if each.param_type_name == "option" and not each.hidden]
    options = [each for each in options if each.name != "help"]
    usage = " ".join(each.metavar or each.name.upper() for each in arguments)
    yield f"### `fantwin {' '.join(filter(None, (name, usage)))}`\n"
    about, *examples = (inspect.cleandoc(command.help).split("\n\nExample: ")) if command.help else ("",)
    yield f"{about}\n"
    if examples:
        yield "\n".join(f"    {' '.join(example.split())}" for example in examples) + "\n"
    rows = [f"| `{each.metavar or each.name.upper()}` | | {_text(each.help)} |" for each in arguments]
    rows += [_row(each, name) for each in options if _row(each, name) not in common]
    shared = [each.opts[0] for each in options if _row(each, name) in common]
    yield "\n".join([*_HEAD, *rows, ""] if rows else [])
    if shared:
        yield f"{'And' if rows else 'Options:'} {', '.join(f'`{each}`' for each in shared)}.\n"


def _row(option: Any, command: str = "") -> str:
    return f"| {_names(option, command)} | {_default(option)} | {_text(option.help)} |"


def _in_several(commands: dict[str, Any]) -> list[str]:
    """The rows of the options that are the same in three commands or more."""
    rows = [_row(each) for command in commands.values() for each in command.params if each.param_type_name == "option"]
    return [row for row in dict.fromkeys(rows) if rows.count(row) > 2 and "`--help`" not in row]


def _names(option: Any, command: str) -> str:
    names = ", ".join(f"`{each}`" for each in (*option.opts, *option.secondary_opts))
    if option.is_flag:
        return names
    more = "..." if option.opts[-1] in VARIADIC.get(command, ()) else ""
    plain = str(option.display_type(None)).strip("<>").removesuffix(" range").upper()
    value = (option.metavar or plain).removesuffix("...")
    return f"{names} `{value}{more}`".replace("|", "\\|")


def _default(option: Any) -> str:
    default = option.default
    if default is None or default is False or default == () or default == float("inf"):
        return ""
    is_number = isinstance(default, int | float) and not isinstance(default, bool)
    return f"{default:g}" if is_number else f"`{json.dumps(default, default=str)}`"


def _text(text: str | None) -> str:
    return " ".join((text or "").split()).replace("|", "\\|")


if __name__ == "__main__":
    sys.stdout.write(page())

"""Pages of docs/reference that are made of the code: commands, topics, keys of a scenario, and values of bounds.

`make reference` writes them again. The words of bounds.md are its own; each row names a constant, whose value is filled
in here.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from textwrap import fill
from typing import Any

import typer
from typer.cli import get_docs_for_click
from typer.main import get_command

from fantwin.pipeline.cli.main import COMMANDS, PANELS, app, function_of
from fantwin.pipeline.cli.simulation.scenario import ClockScenario, FileScenario, Scenario, SurroundingsScenario
from fantwin.pipeline.config.json_schema import schema_text
from fantwin.pipeline.config.reference_page import table
from fantwin.pipeline.config.registry import STAGES
from fantwin.schemas.topics import KIB, MIB, TOPICS

_INTRODUCTION = f"""# Commands

`fantwin COMMAND --help` says the same on a terminal. Every command prints JSON for machines with `--json`, and what
went wrong as one line on standard error.

{fill(app.info.epilog or "", 120)}

This page is made from the commands in the code: `make reference`. Options of several commands are listed here alone:

"""
_EXAMPLE = re.compile(r"^Example: ((?:.+\n)+)", re.MULTILINE)
_OF_ALL = re.compile(
    r"^\* `--(help|json)`.*\n|^\*\*(Usage|Options|Arguments)\*\*:\n\n(```console\n.*\n```\n\n)?", re.MULTILINE
)
"""what each command has alike"""
_CHOICE = re.compile(r"(<([\w|-]+)>`): ([\w, -]+)\.(?:  (\[.*\]))?$", re.MULTILINE)
"""an argument, its choices, and its help"""
_OPTION = re.compile(r"^\* `(-[\w-]+(?:, --[\w-]+)?).*\n?", re.MULTILINE)


def page() -> str:
    """commands.md: every command with its options, from the functions that are the commands."""
    group = typer.Typer()
    for name in COMMANDS:
        group.command(name)(function_of(name))
    abouts = {name: _about(get_command(group), name) for name in COMMANDS}
    options = Counter(found[0].strip() for about in abouts.values() for found in _OPTION.finditer(about))
    shared = {line for line, commands in options.items() if commands > 1}
    parts = [_INTRODUCTION + "".join(f"{line}\n" for line in sorted(shared))]
    for folder, heading in PANELS.items():
        parts.append(f"## {heading}\n")
        parts += [
            _without(shared, abouts[name]) for name, module in COMMANDS.items() if module.startswith(f"{folder}.")
        ]
    return "\n".join(parts)


def _about(click: Any, name: str) -> str:
    """Heading, help, example and options of a command."""
    about = get_docs_for_click(
        obj=click.commands[name], ctx=typer.Context(click), indent=2, name=name, call_prefix="fantwin"
    )
    examples = _EXAMPLE.sub(lambda found: f"    {' '.join(found[1].split())}\n", about)
    own = _CHOICE.sub(_choice, _OF_ALL.sub("", examples)).replace(" range>`", ">`")  # the bounds follow
    return f"{own.strip()}\n"


def _choice(found: re.Match[str]) -> str:
    """An argument, without a help that only says the choices again."""
    if found[2].split("|") != found[3].split(", "):
        return found[0]
    return f"{found[1]}: {found[4]}" if found[4] else found[1]


def _without(shared: set[str], about: str) -> str:
    """The same, with the names alone of options that several commands have alike."""
    has = [f"`{found[1]}`" for found in _OPTION.finditer(about) if found[0].strip() in shared]
    own = _OPTION.sub(lambda found: "" if found[0].strip() in shared else found[0], about)
    return f"{own.rstrip()}\n" + (f"* and {', '.join(has)}\n" if has else "")


PAGES = Path("docs", "reference")
_BOUND = re.compile(r"^\| `([\w.]+)\.([A-Z_]+)` \|[^|]*\|", re.MULTILINE)
_TOPICS = re.compile(r"^\| topic \|.*?\n\n", re.MULTILINE | re.DOTALL)
_BESIDE_PIPELINE = ("client", "schemas", "scoring")
_KEYS = re.compile(r"^<!-- (\w+) -->\n(?:\|.*\n)*", re.MULTILINE)
_SCENARIO = {model.__name__: model for model in (Scenario, ClockScenario, SurroundingsScenario, FileScenario)}
_TABLES_OF_SCENARIO = ("tacho", "clock", "surroundings", "file")
_OTHER_WRITERS = {
    "health": "every stage",
    "consumed": "stages that make samples from samples",
    "clock": "`fantwin replay`",
}
_EXACT = 1 << 53  # from here on a power of two is easier to read
_PER_SECOND = {"_S": 1, "_MS": 1_000, "_US": 1_000_000, "_NS": 1_000_000_000}


def with_topics(page: str) -> str:
    """The page of messages, with the table of topics as the code has it."""
    return _TOPICS.sub(lambda _: _topics() + "\n", page, count=1)


def with_values(page: str) -> str:
    """The page of bounds, with the value of each constant that it names.

    Raises:
        ModuleNotFoundError, AttributeError: there is no such constant.
    """
    return _BOUND.sub(lambda row: f"| `{row[1]}.{row[2]}` | {_value(row[1], row[2])} |", page)


def with_keys(page: str) -> str:
    """The page of the simulated tray, with the keys of a scenario below the comment that names their model."""
    return _KEYS.sub(lambda found: f"<!-- {found[1]} -->\n{table(_SCENARIO[found[1]], but=_TABLES_OF_SCENARIO)}", page)


def _topics() -> str:
    rows = [
        "| topic | message | | written by | read by | rate | longest | kept |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for topic in TOPICS:
        writers = ", ".join(
            [name for name, row in STAGES.items() if topic.name in row.writes] + ["programs"] * topic.is_of_people
        )
        readers = ", ".join(name for name, row in STAGES.items() if topic.name in row.reads)
        about = topic.about if topic.recorded else f"{topic.about}; not recorded"
        rows.append(
            f"| `{topic.name}` | `{topic.message.__name__}` | {about} "
            f"| {_OTHER_WRITERS.get(topic.name, writers)} | {readers or 'stages that a replay feeds'} | {topic.rate} "
            f"| {_bytes(topic.largest_bytes)} | {topic.kept:,} |"
        )
    return "\n".join(rows) + "\n"


def _value(module: str, name: str) -> str:
    """The value of a constant, with the unit that is in its name."""
    room = "fantwin" if module.partition(".")[0] in _BESIDE_PIPELINE else "fantwin.pipeline"
    value = float(getattr(import_module(f"{room}.{module}"), name))
    if "BYTES" in name:
        return _bytes(round(value))
    unit = name[name.rindex("_") :]
    if unit in _PER_SECOND and not name.endswith("_PER_S"):
        return f"{value / _PER_SECOND[unit]:,.10g} s"
    return f"2^{round(value).bit_length() - 1}" if value >= _EXACT else f"{value:,.10g}"


def _bytes(size: int) -> str:
    return f"{size // MIB} MiB" if size % MIB == 0 else f"{size // KIB} KiB"


SCHEMA = "fantwin.schema.json"
MADE: dict[str, Callable[[str], str]] = {
    "commands.md": lambda _: page(),
    "messages.md": with_topics,
    "bounds.md": with_values,
    "simulated-tray.md": with_keys,
}

if __name__ == "__main__":
    (PAGES / SCHEMA).write_text(schema_text(), encoding="utf-8")
    for name, made in MADE.items():
        (PAGES / name).write_text(made((PAGES / name).read_text(encoding="utf-8")), encoding="utf-8")

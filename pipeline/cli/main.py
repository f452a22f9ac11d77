"""The command `fantwin`: a table of commands, and the one place where a `UserError` becomes one line."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from importlib import import_module
from typing import Annotated

import typer

from pipeline.errors import UsageError, UserError

PANELS = {
    "watch": "Watch",
    "recordings": "Recordings",
    "twins": "Twins",
    "simulation": "Simulated tray",
}
"""folder -> heading of its commands in `fantwin --help`"""
COMMANDS = {
    "demo": "watch.demo",
    "commission": "watch.commission",
    "up": "watch.up",
    "run": "watch.run",
    "status": "watch.status",
    "alarms": "watch.alarms",
    "wear": "watch.wear",
    "command": "watch.command",
    "sweep": "watch.sweep",
    "discover": "watch.discover",
    "doctor": "watch.doctor",
    "selftest": "watch.selftest",
    "router": "watch.router",
    "certs": "watch.certs",
    "users": "watch.users",
    "notify": "watch.notify",
    "replay": "recordings.replay",
    "info": "recordings.info",
    "recover": "recordings.recover",
    "import": "recordings.import_table",
    "export": "recordings.export",
    "view": "recordings.view",
    "plot": "recordings.plot",
    "picture": "recordings.picture",
    "identify": "twins.identify",
    "train": "twins.train",
    "place": "twins.place",
    "calibrate": "twins.calibrate",
    "evaluate": "twins.evaluate",
    "compare": "twins.compare",
    "report": "twins.report",
    "learn": "twins.learn",
    "twins": "twins.twins",
    "simulate": "simulation.simulate",
}
"""command -> its module in this folder; the module's function of the same name is the command"""
VARIADIC: dict[str, tuple[str, ...]] = {
    "train": ("--validate",),
    "place": ("--validate",),
    "compare": ("--validate", "--test"),
    "calibrate": ("--verify", "--feedback"),
    "alarms": ("--recordings",),
}
"""command -> options that take all words up to the next option"""

app = typer.Typer(
    name="fantwin",
    epilog="Exit codes: 0 success; 1 failed, and one line says why; 2 wrong usage; 3 data were lost; 4 bad "
    "recordings were skipped.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib import metadata  # noqa: PLC0415  a stage's process does not need it

        typer.echo(f"fantwin {metadata.version('fantwin')}")
        raise typer.Exit


@app.callback()
def _group(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Digital twins of fans: run a healthy twin beside each fan, raise an alarm when the two diverge."""


def _register(names: Iterable[str]) -> None:
    for name in names:
        folder, module = COMMANDS[name].split(".")
        function = getattr(import_module(f"pipeline.cli.{folder}.{module}"), module)
        app.command(name, rich_help_panel=PANELS[folder])(function)


def expand_variadic(words: Sequence[str]) -> list[str]:
    """The command line with the option repeated before each of its values, as the parser requires.

    `--validate C D` becomes `--validate C --validate D`.
    """
    variadic = VARIADIC.get(words[0], ()) if words else ()
    expanded: list[str] = []
    option, has_value = "", False
    for word in words:
        if word.startswith("-"):
            option, has_value = (word, False) if word in variadic else ("", False)
        elif option and has_value:
            expanded.append(option)
        else:
            has_value = True
        expanded.append(word)
    return expanded


def main() -> None:
    """Entry point: runs a command, turns a `UserError` and a lack of memory into one line and an exit code."""
    words = expand_variadic(sys.argv[1:])
    named = [word for word in words[:1] if word in COMMANDS]
    _register(named or COMMANDS)  # a stage's process imports its own command only
    try:
        app(words)
    except UserError as error:
        from rich.console import Console  # noqa: PLC0415  a stage's process needs no rich
        from rich.markup import escape  # noqa: PLC0415

        Console(stderr=True, soft_wrap=True, highlight=False).print(f"[red]fantwin:[/red] {escape(str(error))}")
        sys.exit(2 if isinstance(error, UsageError) else 1)
    except MemoryError:
        sys.stderr.write("fantwin: not enough memory for this; use smaller files, or a machine with more\n")
        sys.exit(1)

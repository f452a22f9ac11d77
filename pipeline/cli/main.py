"""The command `fantwin`: one table of commands, and one place where a user's error becomes one line."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from importlib import import_module

import typer
from rich.console import Console
from rich.markup import escape

from pipeline.errors import UserError

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("watch.demo", "Watch"),
    "up": ("watch.up", "Watch"),
    "run": ("watch.run", "Watch"),
    "status": ("watch.status", "Watch"),
    "alarms": ("watch.alarms", "Watch"),
    "wear": ("watch.wear", "Watch"),
    "command": ("watch.command", "Watch"),
    "doctor": ("watch.doctor", "Watch"),
    "router": ("watch.router", "Watch"),
    "replay": ("recordings.replay", "Recordings"),
    "info": ("recordings.info", "Recordings"),
    "recover": ("recordings.recover", "Recordings"),
    "import": ("recordings.import_table", "Recordings"),
    "export": ("recordings.export", "Recordings"),
    "plot": ("recordings.plot", "Recordings"),
    "picture": ("recordings.picture", "Recordings"),
    "identify": ("twins.identify", "Twins"),
    "train": ("twins.train", "Twins"),
    "calibrate": ("twins.calibrate", "Twins"),
    "evaluate": ("twins.evaluate", "Twins"),
    "compare": ("twins.compare", "Twins"),
    "report": ("twins.report", "Twins"),
    "simulate": ("simulation.simulate", "Simulated tray"),
}

VARIADIC: dict[str, tuple[str, ...]] = {
    "train": ("--validate",),
    "compare": ("--validate", "--test"),
    "calibrate": ("--verify",),
}
"""Options that take all words up to the next option, by command."""

app = typer.Typer(
    name="fantwin",
    epilog="Exit codes: 0 all well; 1 could not be done, one line says why; 2 wrong usage; 3 something was lost.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)


@app.callback()
def _group() -> None:
    """Digital twins of fans: run a healthy twin beside each fan, raise an alarm when the two part."""


def _register(names: Iterable[str]) -> None:
    for name in names:
        module, panel = COMMANDS[name]
        function = getattr(import_module(f"pipeline.cli.{module}"), module.rpartition(".")[2])
        app.command(name, rich_help_panel=panel)(function)


def spell_out(words: Sequence[str]) -> list[str]:
    """The words of a command line with each word of a variadic option given its own: `--validate C D` becomes
    `--validate C --validate D`, which is all the parser understands."""
    variadic = VARIADIC.get(words[0], ()) if words else ()
    spelt: list[str] = []
    option, given = "", False
    for word in words:
        if word.startswith("-"):
            option, given = (word, False) if word in variadic else ("", False)
        elif option and given:
            spelt.append(option)
        else:
            given = True
        spelt.append(word)
    return spelt


def main() -> None:
    """Entry point: runs a command, turns a user's error into one line and exit code 1."""
    words = spell_out(sys.argv[1:])
    wanted = [word for word in words[:1] if word in COMMANDS]
    _register(wanted or COMMANDS)  # a stage starts sooner when it does not import every command
    try:
        app(words)
    except UserError as error:
        Console(stderr=True, soft_wrap=True, highlight=False).print(f"[red]fantwin:[/red] {escape(str(error))}")
        sys.exit(1)

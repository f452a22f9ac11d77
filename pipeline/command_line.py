"""The command `fantwin`: one table of commands, and one place where a user's error becomes one line."""

from __future__ import annotations

import sys
from importlib import import_module

import typer
from rich.console import Console

from pipeline.errors import UserError

COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("demo", "Watch"),
    "up": ("up", "Watch"),
    "run": ("run", "Watch"),
    "status": ("status", "Watch"),
    "doctor": ("doctor", "Watch"),
    "import": ("import_table", "Recordings"),
    "plot": ("plot", "Recordings"),
    "picture": ("picture", "Recordings"),
    "identify": ("identify", "Twins"),
    "train": ("train", "Twins"),
    "evaluate": ("evaluate", "Twins"),
    "simulate": ("simulate", "Simulated tray"),
}

app = typer.Typer(
    name="fantwin",
    help="Digital twins of fans: run a healthy twin beside each fan, raise an alarm when the two part.",
    epilog="Exit codes: 0 all well; 1 could not be done, one line says why; 2 wrong usage; 3 something was lost.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)


def _register() -> None:
    for name, (module, panel) in COMMANDS.items():
        function = getattr(import_module(f"pipeline.commands.{module}"), module)
        app.command(name, rich_help_panel=panel)(function)


def main() -> None:
    """Entry point: runs a command, turns a user's error into one line and exit code 1."""
    _register()
    try:
        app()
    except UserError as error:
        Console(stderr=True, soft_wrap=True, highlight=False).print(f"[red]fantwin:[/red] {_escape(str(error))}")
        sys.exit(1)


def _escape(text: str) -> str:
    return text.replace("[", r"\[")

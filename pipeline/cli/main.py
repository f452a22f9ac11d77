"""The command `fantwin`: a table of commands, and the one place where a `UserError` becomes one line."""

from __future__ import annotations

import os
import re
import signal
import sys
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer

from fantwin.pipeline.errors import UsageError, UserError

PANELS = {
    "watch": "Watch",
    "recordings": "Recordings",
    "twins": "Twins",
    "simulation": "Simulated tray",
}
"""folder -> heading of its commands in `fantwin --help`"""
COMMANDS = {
    "demo": "watch.demo",
    "init": "watch.init",
    "commission": "watch.commission",
    "up": "watch.up",
    "service": "watch.service",
    "status": "watch.status",
    "alarms": "watch.alarms",
    "command": "watch.command",
    "doctor": "watch.doctor",
    "router": "watch.router",
    "certs": "watch.certs",
    "deploy": "watch.deploy",
    "users": "watch.users",
    "replay": "recordings.replay",
    "info": "recordings.info",
    "import": "recordings.import_table",
    "export": "recordings.export",
    "view": "recordings.view",
    "train": "twins.train",
    "calibrate": "twins.calibrate",
    "evaluate": "twins.evaluate",
    "report": "twins.report",
    "twins": "twins.twins",
    "simulate": "simulation.simulate",
}
"""command -> its module in this folder, whose function of the same name is the command"""
VARIADIC: dict[str, tuple[str, ...]] = {
    "train": ("--validate", "--test"),
    "calibrate": ("--verify", "--feedback"),
    "alarms": ("--recordings",),
}
"""command -> options that take all words up to the next option"""

app = typer.Typer(
    name="fantwin",
    epilog="Exit codes: 0 success; 1 failed, and one line says why; 2 wrong usage; 3 finished with a bad result: data "
    "were lost or could not be read in full, or a declared rate was not kept; 4 bad recordings were skipped; 130 "
    "interrupted by Ctrl-C.",
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
    """Digital twins of fans: run a healthy twin beside each fan, raise an alarm when the two diverge.

    Without a command: what to do next on this computer.
    """


def function_of(name: str) -> Callable[..., Any]:
    """The function that is a command."""
    path = COMMANDS[name]
    return getattr(import_module(f"fantwin.pipeline.cli.{path}"), path.rpartition(".")[2])


def _register(names: Iterable[str]) -> None:
    for name in names:
        folder, _, _ = COMMANDS[name].partition(".")
        app.command(name, rich_help_panel=PANELS[folder])(function_of(name))


def _list_commands() -> None:
    """All commands for `--help` and for a mistyped name, without importing any."""
    for name, module in COMMANDS.items():
        app.command(name, help=about(name), rich_help_panel=PANELS[module.split(".")[0]])(lambda: None)


def about(name: str) -> str:
    """The first paragraph of a command's docstring, from its source: to import all commands takes seconds."""
    folder, _, function = COMMANDS[name].rpartition(".")
    source = (Path(__file__).parent / folder / f"{function}.py").read_text(encoding="utf-8")
    found = re.search(rf'^def {function}\(.*?^    """(.+?)(?:\n\n|""")', source, re.MULTILINE | re.DOTALL)
    assert found
    return " ".join(found[1].split())


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


def _words_to_complete() -> list[str]:
    """The command line so far, from the shell that asks how it may go on; empty: it does not ask."""
    if "_FANTWIN_COMPLETE" not in os.environ:
        return []
    line = os.environ.get("_TYPER_COMPLETE_ARGS") or os.environ.get("COMP_WORDS", "")
    return [*line.split(), *([""] if line.endswith(" ") else [])]


def main() -> None:
    """Entry point: runs a command, turns a `UserError` and a lack of memory into one line and an exit code."""
    words = expand_variadic(sys.argv[1:])
    named = next((word for word in words if word != "--"), "")
    completed = _words_to_complete()
    if completed:
        named = completed[1] if len(completed) > 2 else ""
    if named in COMMANDS:
        _register([named])  # a stage's process imports its own command only
    else:
        _list_commands()
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:  # commands clean up when they are interrupted
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        if words or completed:
            app(words)
        else:
            from fantwin.pipeline.cli.watch.next_step import show_next_step  # noqa: PLC0415

            show_next_step()
    except UserError as error:
        from rich.console import Console  # noqa: PLC0415  a stage's process needs no rich
        from rich.markup import escape  # noqa: PLC0415

        Console(stderr=True, soft_wrap=True, highlight=False).print(f"[red]fantwin:[/red] {escape(str(error))}")
        sys.exit(2 if isinstance(error, UsageError) else 1)
    except MemoryError:
        sys.stderr.write("fantwin: not enough memory for this; use smaller files, or a machine with more\n")
        sys.exit(1)

"""The command `fantwin`: a table of commands, and the one place where a `UserError` becomes one line."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
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
COMMANDS: dict[str, tuple[str, str]] = {
    "demo": (
        "watch.demo",
        "Run a simulated tray of eight fans through the whole pipeline; cover one inlet, disturb one rotor.",
    ),
    "commission": (
        "watch.commission",
        "Record healthy fans, train their twins, calibrate them, add them to the configuration, start `fantwin up`.",
    ),
    "up": ("watch.up", "Start all stages, restart those that die, stop all in order on Ctrl-C."),
    "status": ("watch.status", "Show stages, rates, latency, losses and alarms of a running site."),
    "alarms": (
        "watch.alarms",
        "List the current alarms; acknowledge, shelve or suppress the alarm of a fan, or say whether it was true "
        "(docs/reference/alarms.md).",
    ),
    "wear": (
        "watch.wear",
        "Show how the speed of each fan has changed since commissioning, how fast, and when its limit will be reached\n"
        "(docs/explanation/wear.md).",
    ),
    "command": (
        "watch.command",
        "Send a command to one fan, or move the commands of all over their range while `fantwin up` records.",
    ),
    "doctor": (
        "watch.doctor",
        "Check the installation and a configuration, find the fans of this computer, or send test messages.",
    ),
    "selftest": (
        "watch.selftest",
        "Kill, freeze and flood the stages of a simulated site, and check that fantwin keeps its promises.",
    ),
    "router": ("watch.router", 'Run a Zenoh router until Ctrl-C, for stages with bus.mode = "client".'),
    "certs": (
        "watch.certs",
        "Make and show certificates of a site: who may do what on its bus (docs/how-to/security.md).",
    ),
    "users": (
        "watch.users",
        "List the users who may log in to the operators' page and over OPC UA; add or remove one.",
    ),
    "replay": (
        "recordings.replay",
        "Publish a recording on the bus in recorded time, for the viewer or the stages; or score recordings again "
        "offline.",
    ),
    "info": (
        "recordings.info",
        "Show what a recording contains: time, trays, twins, messages and losses of each topic, problems of stages.",
    ),
    "import": (
        "recordings.import_table",
        "Turn a measured table or a log into a recording, the data format of training, evaluation and replay.",
    ),
    "export": (
        "recordings.export",
        "Export a recording as tables: one per topic and tray, with a row per sample and fan.",
    ),
    "view": (
        "recordings.view",
        "Turn a recording into a view file for Rerun, or plot its speeds, predictions, bands, alarms and states.",
    ),
    "train": ("twins.train", "Train a twin of healthy fans and write it, with its card, as an ONNX file."),
    "calibrate": (
        "twins.calibrate",
        "Learn from healthy recordings how far a twin's fans may differ from it, and write that into its card.",
    ),
    "evaluate": (
        "twins.evaluate",
        "Compare the free run of a twin with the measured speeds of recordings, in the recordings' own units.",
    ),
    "report": (
        "twins.report",
        "Compare the free run of a twin with recordings on an HTML page, or identify the fans of recordings.",
    ),
    "twins": (
        "twins.twins",
        "List the versions of a learned twin, make the next one, put one in force, or mark a time span as faulty.",
    ),
    "simulate": (
        "simulation.simulate",
        "Simulate a tray of fans on a serial port that any program can open, or as the fans of a computer.",
    ),
}
"""command -> its module in this folder, whose function of the same name is the command; the first line of its help"""
VARIADIC: dict[str, tuple[str, ...]] = {
    "train": ("--validate", "--test"),
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


def function_of(name: str) -> Callable[..., Any]:
    """The function that is a command."""
    path = COMMANDS[name][0]
    return getattr(import_module(f"fantwin.pipeline.cli.{path}"), path.rpartition(".")[2])


def _register(names: Iterable[str]) -> None:
    for name in names:
        folder, _, _ = COMMANDS[name][0].partition(".")
        app.command(name, rich_help_panel=PANELS[folder])(function_of(name))


def _list_commands() -> None:
    """All commands for `--help` and for a mistyped name, without importing any."""
    for name, (module, about) in COMMANDS.items():
        app.command(name, help=about, rich_help_panel=PANELS[module.split(".")[0]])(lambda: None)


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
    named = next((word for word in words if word != "--"), "")
    if named in COMMANDS:
        _register([named])  # a stage's process imports its own command only
    else:
        _list_commands()
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:  # commands clean up when they are interrupted
        signal.signal(signal.SIGINT, signal.default_int_handler)
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

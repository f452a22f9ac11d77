"""`fantwin run`: one stage in this process."""

from __future__ import annotations

import json
import os
import sys
import threading
from contextlib import suppress
from typing import Annotated

import typer

from pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from pipeline.config.loading import load_config
from pipeline.config.registry import STAGES
from pipeline.errors import UsageError, UserError
from pipeline.launch.event_log import without_figures
from pipeline.launch.processes import EXIT_CANNOT_START
from pipeline.runtime.notifier import starting
from pipeline.runtime.runner import Runner
from pipeline.runtime.signals import set_when_stdin_closes, stop_on_signals
from pipeline.runtime.stage import load_stage
from schemas.messages import Health
from schemas.streams import LOSS_PREFIX


def run(
    stage: Annotated[str, typer.Argument(help=f"One of {', '.join(STAGES)}.")],
    config: ConfigOption = DEFAULT_CONFIG,
    tray: Annotated[str | None, typer.Option(help="Which tray, for a stage with one process for each.")] = None,
    overrides: SetOption = None,
    json_output: JsonOption = False,
    until_stdin_closes: Annotated[bool, typer.Option(hidden=True)] = False,
) -> None:
    """Run one stage alone, until Ctrl-C.

    It discovers the other stages on the bus; the order of starting does not matter. `fantwin up` starts all of them.

    Example: fantwin run scorer -c fantwin.toml
    """
    if stage not in STAGES:
        raise UsageError(f"no stage called {stage!r}; known: {', '.join(STAGES)}")
    settings = load_config(config, overrides or (), stages=(stage,))
    stop = threading.Event()
    stop_on_signals(stop)
    try:
        with starting():
            on_health = None if until_stdin_closes else Problems(stage).report  # the launcher reports them itself
            runner = Runner(load_stage(stage), settings, tray, stop, on_health)
    except UserError as error:
        if not until_stdin_closes:
            raise
        typer.echo(error, err=True)  # for the launcher, which then gives up instead of restarting it
        raise typer.Exit(EXIT_CANNOT_START) from error
    if until_stdin_closes:
        set_when_stdin_closes(runner.launcher_gone)
    try:
        last = runner.run()
    except (OSError, UserError) as error:
        _say(f"fantwin: {stage}: {error}" if isinstance(error, OSError) else f"fantwin: {error}")
        if runner.is_hung:
            os._exit(1)  # the end of the interpreter would wait for what hangs
        raise typer.Exit(1) from error
    if json_output:
        typer.echo(
            json.dumps({"stage": stage, "lost": last.lost, "counters": {c.name: c.value for c in last.counters}})
        )
    if last.lost:
        if not until_stdin_closes:
            counts = ", ".join(
                f"{c.name} {c.value}" for c in last.counters if c.name.startswith(LOSS_PREFIX) and c.value
            )
            _say(f"{stage}: {last.lost} lost" + (f" ({counts})" if counts else ""))
        raise typer.Exit(3)


class Problems:
    """Says what is wrong with a stage that runs alone, and when it is over."""

    def __init__(self, stage: str) -> None:
        self._stage = stage
        self._said = ""

    def report(self, health: Health) -> None:
        """Handle a health message of the stage."""
        meaning = without_figures(health.problem)
        if meaning != self._said:
            self._said = meaning
            _say(f"{self._stage}: {health.problem or 'the problem is resolved'}")


def _say(line: str) -> None:
    """To standard error; the launcher that reads it may have gone."""
    with suppress(OSError):
        os.write(sys.stderr.fileno(), f"{line}\n".encode())

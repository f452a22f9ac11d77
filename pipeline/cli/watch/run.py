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
from pipeline.config.shards import chosen_shard
from pipeline.errors import UsageError, UserError
from pipeline.launch.event_log import without_figures
from pipeline.launch.processes import EXIT_CANNOT_START
from pipeline.runtime.notifier import starting
from pipeline.runtime.runner import Runner
from pipeline.runtime.signals import set_when_stdin_closes, stop_on_signals
from pipeline.runtime.stage import load_stage
from schemas.messages import Health
from schemas.streams import LOSS_PREFIX
from schemas.topics import stage_label


def run(
    stage: Annotated[str, typer.Argument(help=f"One of {', '.join(STAGES)}.")],
    config: ConfigOption = DEFAULT_CONFIG,
    trays: Annotated[
        str | None, typer.Option("--trays", "--tray", metavar="A,B", help="Only these trays. Default: all.")
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option(metavar="K/N", help="Only the K-th tray of the configuration and every N-th after it; K from 1."),
    ] = None,
    overrides: SetOption = None,
    json_output: JsonOption = False,
    until_stdin_closes: Annotated[bool, typer.Option(hidden=True)] = False,
) -> None:
    """Run one stage alone, until Ctrl-C.

    It discovers the other stages on the bus; the order of starting does not matter. `fantwin up` starts all of them.
    Several processes of a stage share the trays of a site: each has some of them, on this host or on others.

    Example: fantwin run scorer -c fantwin.toml

    Example: fantwin run scorer -c fantwin.toml --shard 2/8
    """
    if stage not in STAGES:
        raise UsageError(f"no stage called {stage!r}; known: {', '.join(STAGES)}")
    settings = load_config(config, overrides or (), stages=(stage,))
    chosen = chosen_shard(stage, settings, trays, shard)
    name = stage_label(stage, chosen.name)
    stop = threading.Event()
    stop_on_signals(stop)
    try:
        with starting():
            on_health = None if until_stdin_closes else Problems(name).report  # the launcher reports them itself
            runner = Runner(load_stage(stage), settings, chosen, stop, on_health)
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
        _say(f"fantwin: {name}: {error}" if isinstance(error, OSError) else f"fantwin: {error}")
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
            _say(f"{name}: {last.lost} lost" + (f" ({counts})" if counts else ""))
        raise typer.Exit(3)


class Problems:
    """Says what is wrong with a stage that runs alone, and when it is over."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._said = ""

    def report(self, health: Health) -> None:
        """Handle a health message of the stage."""
        meaning = without_figures(health.problem)
        if meaning != self._said:
            self._said = meaning
            _say(f"{self._name}: {health.problem or 'the problem is resolved'}")


def _say(line: str) -> None:
    """To standard error; the launcher that reads it may have gone."""
    with suppress(OSError):
        os.write(sys.stderr.fileno(), f"{line}\n".encode())

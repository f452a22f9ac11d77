"""`fantwin run`: one stage in this process."""

from __future__ import annotations

import json
import os
import sys
import threading
from contextlib import nullcontext, suppress
from typing import Annotated

import typer

from fantwin.pipeline.bus.errors import NoAnswerError
from fantwin.pipeline.cli.exposure import InsecureOption, checked_exposure
from fantwin.pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.models import Config
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.shards import Shard, chosen_shard
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.launch.processes import EXIT_CANNOT_START
from fantwin.pipeline.runtime.figures import without_figures
from fantwin.pipeline.runtime.notifier import starting
from fantwin.pipeline.runtime.runner import Runner
from fantwin.pipeline.runtime.signals import set_when_stdin_closes, stop_on_signals
from fantwin.pipeline.runtime.stage import load_stage
from fantwin.schemas.health import Health
from fantwin.schemas.streams import LOSS_PREFIX
from fantwin.schemas.topics import stage_label


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
    insecure: InsecureOption = False,
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
    stop = threading.Event()
    stop_on_signals(stop)
    # a launcher has checked it itself
    with checked_exposure(settings.bus, _say, insecure=insecure) if not until_stdin_closes else nullcontext():
        _run(stage, settings, chosen, stop, json_output=json_output, until_stdin_closes=until_stdin_closes)


def _run(
    stage: str, settings: Config, chosen: Shard, stop: threading.Event, *, json_output: bool, until_stdin_closes: bool
) -> None:
    name = stage_label(stage, chosen.name)
    try:
        with starting():
            problems = Problems(name)

            def report(health: Health) -> None:
                if not until_stdin_closes:  # a launcher hears it itself
                    problems.report(health.problem)

            runner = Runner(load_stage(stage), settings, chosen, stop, report)
    except NoAnswerError as error:  # the bus may answer the next time
        if not until_stdin_closes:
            raise
        typer.echo(error, err=True)
        raise typer.Exit(1) from error
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

    def report(self, problem: str) -> None:
        """What is wrong now; empty: nothing."""
        meaning = without_figures(problem)
        if meaning != self._said:
            self._said = meaning
            _say(f"{self._name}: {problem or 'the problem is resolved'}")


def _say(line: str) -> None:
    """To standard error; the launcher that reads it may have gone."""
    with suppress(OSError):
        os.write(sys.stderr.fileno(), f"{line}\n".encode())

"""`fantwin up --only`: one stage in this process, which imports no launcher and no rich."""

from __future__ import annotations

import json
import os
import sys
import threading
from contextlib import nullcontext, suppress

import typer

from fantwin.pipeline.bus.errors import NoAnswerError
from fantwin.pipeline.cli.exposure import checked_exposure
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.config.shards import Shard
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.launch.processes import EXIT_CANNOT_START
from fantwin.pipeline.runtime.figures import without_figures
from fantwin.pipeline.runtime.runner import Runner
from fantwin.pipeline.runtime.service_manager import starting
from fantwin.pipeline.runtime.signals import when_stdin_closes
from fantwin.pipeline.runtime.stage import load_stage
from fantwin.schemas.health import Health
from fantwin.schemas.streams import LOSS_PREFIX
from fantwin.schemas.topics import stage_label


def run_stage(
    stage: str,
    settings: Config,
    chosen: Shard,
    stop: threading.Event,
    *,
    insecure: bool,
    json_output: bool,
    until_stdin_closes: bool,
) -> None:
    """Run a stage in this process until `stop` is set.

    until_stdin_closes: a launcher started it, which hears its health and has checked what the bus is exposed to.

    Raises:
        typer.Exit: the stage could not start, failed, or lost data.
    """
    name, problems = stage_label(stage, chosen.name), Problems(stage_label(stage, chosen.name))

    def report(health: Health) -> None:
        if not until_stdin_closes:
            problems.report(health.problem)

    with nullcontext() if until_stdin_closes else checked_exposure(settings.bus, _say, insecure=insecure):
        try:
            with starting():
                runner = Runner(load_stage(stage), settings, chosen, stop, report)
        except UserError as error:
            if not until_stdin_closes:
                raise
            typer.echo(error, err=True)  # for the launcher, which gives up unless the bus may answer the next time
            raise typer.Exit(1 if isinstance(error, NoAnswerError) else EXIT_CANNOT_START) from error
        if until_stdin_closes:
            when_stdin_closes(runner.launcher_gone.set)
        try:
            last = runner.run()
        except (OSError, UserError) as error:
            _say(f"fantwin: {name}: {error}" if isinstance(error, OSError) else f"fantwin: {error}")
            if runner.is_hung:
                os._exit(1)  # the end of the interpreter would wait for what hangs
            raise typer.Exit(1) from error
    counters = {counter.name: counter.value for counter in last.counters}
    if json_output:
        typer.echo(json.dumps({"stage": stage, "lost": last.lost, "counters": counters}))
    if last.lost and not until_stdin_closes:
        counts = ", ".join(f"{key} {value}" for key, value in counters.items() if key.startswith(LOSS_PREFIX) and value)
        _say(f"{name}: {last.lost} lost" + (f" ({counts})" if counts else ""))
    if last.lost:
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
    """Write a line to standard error; the launcher that reads it may have gone."""
    with suppress(OSError):
        os.write(sys.stderr.fileno(), f"{line}\n".encode())

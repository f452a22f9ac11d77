"""`fantwin up`: all stages of one configuration, as processes, or one of them in this process."""

from __future__ import annotations

import json
import os
import sys
from contextlib import suppress
from dataclasses import asdict
from typing import Annotated

import typer

from fantwin.pipeline.cli.exposure import InsecureOption, checked_exposure
from fantwin.pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.shards import chosen_shard, chosen_trays
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.runtime.signals import ignore_hangup, stop_on_signals, when_stdin_closes


def up(
    config: ConfigOption = DEFAULT_CONFIG,
    only: Annotated[
        str | None, typer.Option(metavar="STAGE", help=f"Run this stage alone, in this process: {', '.join(STAGES)}.")
    ] = None,
    trays: Annotated[
        str | None,
        typer.Option(
            metavar="A,B", help="Only the processes whose first tray is one of these; with --only, these trays."
        ),
    ] = None,
    shard: Annotated[
        str | None,
        typer.Option(metavar="K/N", help="Only the K-th tray of the configuration and every N-th after it; K from 1."),
    ] = None,
    insecure: InsecureOption = False,
    overrides: SetOption = None,
    json_output: JsonOption = False,
    until_stdin_closes: Annotated[bool, typer.Option(hidden=True)] = False,
) -> None:
    """Start all stages, restart those that die, stop all in order on Ctrl-C.

    Events are written to standard error. The site keeps running when the terminal is closed; SIGTERM stops it, too.
    It serves the operators' page on this host and prints its address.
    For a tray without `twin` in the configuration, a twin is learned in the background (docs/how-to/learned-twins.md).

    With --only, one stage runs until Ctrl-C. It finds the others on the bus; the order of starting does not matter.
    Several hosts or processes share the trays of a site: each has some of them.

    Exit codes: 0 stopped in order, nothing lost; 1 could not start, a stage failed or was killed at the end, or all
    that a device sent was refused; 3 data were lost.

    Example: fantwin up -c fantwin.toml

    Example: fantwin up --only scorer --shard 2/8
    """
    stop = stop_on_signals()  # first: what follows takes a second or two
    if only is not None:
        from fantwin.pipeline.cli.watch.one_stage import run_stage  # noqa: PLC0415  loads the runtime

        if only not in STAGES:
            raise UsageError(f"no stage called {only!r}; known: {', '.join(STAGES)}")
        settings = load_config(config, overrides or (), stages=(only,))
        chosen = chosen_shard(only, settings, trays, shard)
        flags = {"insecure": insecure, "json_output": json_output, "until_stdin_closes": until_stdin_closes}
        run_stage(only, settings, chosen, stop, **flags)
        return
    ignore_hangup()
    if until_stdin_closes:
        when_stdin_closes(stop.set)
    # the process of a stage loads no launcher
    from fantwin.pipeline.launch.launcher import Launcher  # noqa: PLC0415
    from fantwin.pipeline.launch.site_report import EventLog  # noqa: PLC0415
    from fantwin.pipeline.launch.this_host import load_for_this_host, page_addresses, with_free_ports  # noqa: PLC0415
    from fantwin.pipeline.site.loss_accounting import refused_lines  # noqa: PLC0415

    loaded = load_for_this_host(config, overrides or ())
    of_host = chosen_trays(loaded.config, trays, shard)
    here = with_free_ports(loaded, of_host)
    settings = here.config
    log = EventLog(sys.stderr.fileno())
    pages = [f"operators' page: {address}" for address in page_addresses(settings, of_host)]
    launcher = Launcher(settings, here.overrides, log.say, of_host, when_started=(*pages, *here.left_out))
    try:
        with checked_exposure(settings.bus, log.say, insecure=insecure):
            outcome = launcher.run(stop)
        if not json_output:
            for line in (*outcome.notes, *refused_lines(outcome.refused)):
                log.say(line)
            losses = ", ".join(f"{name} {count}" for name, count in outcome.lost.items() if count)
            log.say(f"stopped; lost: {losses or 'nothing'}; recorded: {outcome.recorded}")
            for line in outcome.unusable:
                log.say(line)
    except UserError:
        if launcher.outcome.recordings:
            log.say(f"recorded until then: {launcher.outcome.recorded}")
        raise
    finally:
        log.close()
    if json_output:  # the exit code stands whether or not somebody reads it
        with suppress(OSError):
            os.write(sys.stdout.fileno(), f"{json.dumps(asdict(outcome))}\n".encode())
    if outcome.exit_code:
        raise typer.Exit(outcome.exit_code)

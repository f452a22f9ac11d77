"""`fantwin up`: all stages of one configuration, as processes."""

from __future__ import annotations

import json
import threading

import typer
from rich.console import Console

from pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from pipeline.config.loading import load_config
from pipeline.launch.launcher import Launcher
from pipeline.runtime.signals import stop_on_signals


def up(config: ConfigOption = DEFAULT_CONFIG, overrides: SetOption = None, json_output: JsonOption = False) -> None:
    """Start all stages, restart those that die, stop all in order on Ctrl-C.

    Exit codes: 0 stopped in order, nothing lost; 1 could not start, or a stage failed or was killed at the end;
    3 data were lost.

    Example: fantwin up -c fantwin.toml
    """
    settings = load_config(config, overrides or ())
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    stop = threading.Event()
    stop_on_signals(stop)
    launcher = Launcher(settings, overrides or (), lambda line: console.print(line, markup=False))
    outcome = launcher.run(stop)
    if json_output:
        typer.echo(
            json.dumps(
                {
                    "run_folder": outcome.run_folder,
                    "restarts": outcome.restarts,
                    "killed": outcome.killed,
                    "failed": outcome.failed,
                    "lost": outcome.lost,
                }
            )
        )
    else:
        losses = ", ".join(f"{name} {count}" for name, count in outcome.lost.items() if count)
        console.print(f"stopped; lost: {losses or 'nothing'}; files in {outcome.run_folder}", markup=False)
    if outcome.exit_code:
        raise typer.Exit(outcome.exit_code)

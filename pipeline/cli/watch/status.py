"""`fantwin status`: stages, rates, losses and alarms; live on a terminal, printed once elsewhere."""

from __future__ import annotations

import json
import sys
import threading
import time
from typing import Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from pipeline.bus.session import Bus
from pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from pipeline.config.loading import load_config
from pipeline.config.models import Config
from pipeline.errors import UserError
from pipeline.launch.site_watcher import SiteWatcher, StageView
from pipeline.runtime.signals import stop_on_signals
from schemas.messages import Severity, StageStatus
from schemas.units import NS_PER_S
from scoring.alarms.alarm_flags import is_listed, is_presented
from scoring.alarms.current_alarms import CurrentAlarm, clock

_STYLES = {Severity.NONE: "", Severity.WARNING: "yellow", Severity.ALARM: "bold red"}
_LISTEN_S = 2.5  # two health messages of every stage, which give rates
_SILENT_AFTER_S = 5.0


def status(
    config: ConfigOption = DEFAULT_CONFIG,
    once: Annotated[bool, typer.Option("--once", help="Print once and exit, on a terminal too.")] = False,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """Show stages, rates, latency, losses and alarms of a running site.

    Stays live on a terminal, until Ctrl-C. Into a pipe or a file it prints once and exits.
    Exit code 1 if no stage answers, 3 if a stage has lost something.

    Example: fantwin status -c fantwin.toml --once
    """
    settings = load_config(config, overrides or (), stages=())
    stop = threading.Event()
    stop_on_signals(stop)
    with Bus(settings.bus, listens=False) as bus:
        watcher = SiteWatcher(bus, settings.site)
        if once or json_output or not sys.stdout.isatty():
            stop.wait(_LISTEN_S)
            watcher.ask_for_past_alarms()
            _require_a_stage(watcher, settings)
            if json_output:
                typer.echo(json.dumps(as_json(watcher)))
            else:
                Console().print(stage_table(watcher, settings))
        else:
            watcher.ask_for_past_alarms()
            with Live(console=Console(), refresh_per_second=4) as live:
                while not stop.wait(0.25):
                    live.update(stage_table(watcher, settings))
            _require_a_stage(watcher, settings)
        if any(watcher.losses().values()):
            raise typer.Exit(3)


def _require_a_stage(watcher: SiteWatcher, config: Config) -> None:
    if not watcher.stages():
        raise UserError(f"{_no_stage(config)}; is `fantwin up -c {config.path}` running?")


def _no_stage(config: Config) -> str:
    return f"no stage of site {config.site!r} answers at {config.bus.endpoint}"


def stage_table(watcher: SiteWatcher, config: Config) -> Group:
    """The page for people: a row for each stage, then problems, then alarms."""
    table = Table("stage", "state", title="stages", title_justify="left", box=SIMPLE_HEAD)
    for column in ("in /s", "out /s", "p50 ms", "p99 ms", "lost"):
        table.add_column(column, justify="right")
    views = watcher.stages()
    problems = [] if any(view.alive for view in views) else [Text(_no_stage(config), style="red")]
    for view in views:
        health = view.health
        name = health.stage if health.instance == "all" else f"{health.stage}/{health.instance}"
        lost = Text(str(health.lost), style="red" if health.lost else "")
        latency = (
            (f"{health.latency_p50_ms:.1f}", f"{health.latency_p99_ms:.1f}") if health.latency_p99_ms else ("", "")
        )
        table.add_row(name, _state(view), f"{view.rate_in_hz:.0f}", f"{view.rate_out_hz:.0f}", *latency, lost)
        if health.problem and view.alive:
            problems.append(Text(f"{name}: {health.problem}", style="red"))
    alarms = [_alarm_line(each) for each in watcher.current_alarms() if is_listed(each.newest)]
    if not any(view.alive and view.health.stage == "scorer" for view in views):
        alarms.append(Text("alarms unknown: no scorer is alive", style="red"))
    return Group(*([table] if views else []), *problems, *(alarms or [Text("no alarms", style="green")]))


def _state(view: StageView) -> Text:
    if not view.alive:
        stopped = view.health.status == StageStatus.STOPPED
        return Text("stopped" if stopped else "gone", style="yellow" if stopped else "red")
    if time.time_ns() - view.health.t_ns > _SILENT_AFTER_S * NS_PER_S:
        return Text("silent", style="red")
    styles = {StageStatus.STARTING: "yellow", StageStatus.OK: "green", StageStatus.DEGRADED: "red"}
    return Text(view.health.status.name.lower(), style=styles.get(view.health.status, "yellow"))


def _alarm_line(current: CurrentAlarm) -> Text:
    alarm = current.newest
    style = _STYLES.get(alarm.severity, "bold red") if alarm.active else "green"
    text = Text.assemble(
        (f"{clock(alarm.t_ns)}  {alarm.severity.name:7}", style if is_presented(alarm) else "dim"),
        f"  {alarm.header.tray}  fan {alarm.fan}: {', '.join(current.states())}",
    )
    about = current.message.removeprefix(f"fan {alarm.fan}: ")
    if current.causes:
        first = current.causes[0]
        text.append(f", {first.cause} {100 * first.probability:.0f} %")
    return text.append(f"; {about}") if about else text


def as_json(watcher: SiteWatcher) -> dict[str, object]:
    """The same for machines (`--json`)."""
    return {
        "stages": [
            {
                "stage": view.health.stage,
                "instance": view.health.instance,
                "alive": view.alive,
                "status": view.health.status.name.lower(),
                "problem": view.health.problem,
                "process_id": view.health.process_id,
                "rate_in_hz": round(view.rate_in_hz, 1),
                "rate_out_hz": round(view.rate_out_hz, 1),
                "latency_ms": {"p50": view.health.latency_p50_ms, "p99": view.health.latency_p99_ms},
                "lost": view.health.lost,
                "counters": {counter.name: counter.value for counter in view.health.counters},
            }
            for view in watcher.stages()
        ],
        "alarms": [current.as_json() for current in watcher.current_alarms()],
    }

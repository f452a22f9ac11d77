"""`fantwin demo`: a simulated tray, the whole pipeline, two faults, and a report of what was found."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from fantwin.pipeline.bus.session import Bus, join_bus
from fantwin.pipeline.cli.options import JsonOption
from fantwin.pipeline.cli.printing import table_of
from fantwin.pipeline.cli.progress import Reporter, working
from fantwin.pipeline.cli.watch.demo_report import Summary, summarise
from fantwin.pipeline.config.roles import roles_of
from fantwin.pipeline.config.settings import Config, TrayConfig
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.extras import missing_extra
from fantwin.pipeline.files import write_whole
from fantwin.pipeline.launch.this_host import load_for_this_host, page_addresses
from fantwin.pipeline.runtime.signals import stop_on_signals
from fantwin.pipeline.selftest.scratch_site import free_port, lines_of, started
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.schemas.enums import FanState
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.diagnosis.causes import short_name

DEMO_FOLDER = Path(__file__).parents[2] / "demo"
SEED = 7
"""of the commands and the noise of the tray"""
DURATION_S = 36.0
FAULTS = (
    ("inlet", "fan=2,start=8,stop=14,size=1.8"),
    ("rotor", "fan=5,start=18,stop=24,size=0.8"),
)
OUTPUTS = (
    *("recording*.mcap*", "view*.rrd", "bands.png", "summary.json", "truth.json", "up.log", "tray.log", "tray"),
    *("*.snapshot", "alarms.sqlite*", "clips/*"),
)
ERROR_PREFIX = "fantwin: "
"""start of the line in which a command says why it failed"""
_START_TIMEOUT_S = _STOP_TIMEOUT_S = 60.0


def demo(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the files it writes.")] = Path("runs/demo"),
    json_output: JsonOption = False,
) -> None:
    """Run a simulated tray of eight fans through the whole pipeline; cover one inlet, disturb one rotor.

    Exit code 1 if a fault was missed, a healthy fan raised an alarm, or data were lost.

    Example: fantwin demo -o runs/demo
    """
    console = Console(stderr=json_output, highlight=False)
    out = out.resolve()
    _clear(out)
    overrides = [
        "viewer.grpc_port=0",
        f"run_folder={json.dumps(str(out))}",
        f"tray.0.port={json.dumps(str(out / 'tray'))}",
        f"bus.endpoint='tcp/127.0.0.1:{free_port()}'",
        f"gateway.port={free_port()}",
    ]
    here = load_for_this_host(DEMO_FOLDER / "demo.toml", overrides)
    config, overrides = here.config, list(here.overrides)
    for line in here.left_out:
        console.print(line, markup=False, soft_wrap=True)
    started_s = time.monotonic()
    lost = _run(config, overrides, out, console)
    summary = summarise(out / "truth.json", sorted(out.glob("recording*.mcap")), lost)
    _draw(out, console)
    write_whole(out / "summary.json", f"{summary.to_json()}\n".encode(), "; name another folder")
    if json_output:
        typer.echo(summary.to_json())
    _print_report(summary, out, time.monotonic() - started_s, console)
    if summary.problems:
        raise typer.Exit(1)


def _clear(out: Path) -> None:
    """Remove the files of an earlier demo, and nothing else."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        for pattern in OUTPUTS:
            for path in out.glob(pattern):
                path.unlink()
    except OSError as error:
        raise UserError(
            f"{out}: cannot be used for the demo's files: {error.strerror}; name another with -o"
        ) from error


def _run(config: Config, overrides: list[str], out: Path, console: Console) -> dict[str, int]:
    """Run tray and pipeline to the end of the schedule; returns the losses that each stage reports, without zeros.

    Raises:
        UserError: it was interrupted, did not start, failed, or did not stop in time.
    """
    stop = stop_on_signals()
    tray = config.trays[0]
    simulate = [
        *("simulate", "--fans", str(tray.fans), "--profile", "manual", "--seed", str(SEED)),
        *("--duration", str(DURATION_S), "--set", f"speed_unit={tray.speed_unit}", "--link", str(out / "tray")),
        *("--truth", str(out / "truth.json"), "--wait-for-reader"),
    ]
    for kind, settings in FAULTS:
        simulate += ["--fault", f"{kind}:{settings}"]
    up = ["up", "-c", str(config.path), "--json", *(word for override in overrides for word in ("--set", override))]
    with (
        (out / "up.log").open("w", encoding="utf-8") as log,
        (out / "tray.log").open("w", encoding="utf-8") as tray_log,
        _child(simulate, stdout=tray_log, stderr=tray_log) as device,
        _child(up, stdout=subprocess.PIPE, stderr=log) as pipeline,
        join_bus(config, listens=False) as bus,
    ):
        count = len(config.stages)
        console.print(f"simulated tray of {tray.fans} fans; starting {count} stages, each as a process of its own")
        for address in page_addresses(config):
            console.print(f"operators' page, while the demo runs: {address}", soft_wrap=True)
        _watch(config, bus, device, pipeline, stop)
        if pipeline.poll() is None:
            pipeline.send_signal(signal.SIGINT)
        try:
            answer, _ = pipeline.communicate(timeout=_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired as error:
            raise UserError(f"the pipeline did not stop within {_STOP_TIMEOUT_S:g} s; see {out / 'up.log'}") from error
    if stop.is_set():
        raise UserError(f"stopped before the end of the schedule; what was recorded is in {out}")
    if pipeline.returncode not in (0, 3):
        raise _unfinished("pipeline", out / "up.log")
    if device.returncode:
        raise _unfinished("simulated tray", out / "tray.log")
    return {name: count for name, count in json.loads(answer)["lost"].items() if count}


@contextmanager
def _child(words: list[str], **streams: object) -> Iterator[subprocess.Popen[str]]:
    """A `fantwin` command, which has ended on exit, killed if it does not stop."""
    process = started(words, **streams)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(_STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def _watch(
    config: Config, bus: Bus, device: subprocess.Popen[str], pipeline: subprocess.Popen[str], stop: threading.Event
) -> None:
    """Show what happens until the tray has sent its last sample, or a process ends too early."""
    watcher = SiteWatcher(bus, config.site, roles_of(config), config.trays, has_scores=True)
    began_s = time.monotonic()
    with Reporter() as reporter:
        while device.poll() is None and pipeline.poll() is None and not stop.wait(0.25):
            reporter.show("running", note=_line(config.trays[0], watcher))
            if not watcher.model.trays_now() and time.monotonic() > began_s + _START_TIMEOUT_S:
                raise UserError(
                    f"no score arrived within {_START_TIMEOUT_S:.0f} s; see up.log, and run `fantwin doctor`"
                )


def _line(tray: TrayConfig, watcher: SiteWatcher) -> str:
    """The state of the fans in one line."""
    if not watcher.model.trays_now():
        return "waiting for the first score"
    states = [watcher.model.fan_now(Fan(tray.name, fan)).state for fan in range(tray.fans)]
    notable = (f"{tray.label(fan)} {state}" for fan, state in enumerate(states) if state != FanState.NORMAL.words)
    said = f"all fans {states[0]}" if len(set(states)) == 1 else ", ".join(notable)
    return f"{said}; lost {sum(watcher.losses().values())}"


def _draw(out: Path, console: Console) -> None:
    if problem := missing_extra("bands.png is left out: it", "report", "matplotlib"):
        console.print(problem, markup=False, soft_wrap=True)
        return
    from fantwin.pipeline.outputs.rerun.band_plot import plot_recording  # noqa: PLC0415  an extra

    with working("drawing bands.png"):
        plot_recording(sorted(out.glob("recording*.mcap")), out / "bands.png", truth=out / "truth.json")


_TIME = re.compile(r"^\d\d:\d\d:\d\d +")
"""time at the beginning of an event of `fantwin up`"""


def _unfinished(what: str, log: Path) -> UserError:
    return UserError(f"the {what} did not run to its end: {_reason(log)} (full log: {log})")


def _reason(log: Path) -> str:
    """Why a command failed: its error, else its last line about a failed stage, else its last line."""
    lines = lines_of(log)
    for mark in (ERROR_PREFIX, "ended with status", "cannot start", "not arrive", "never ready", "killed"):
        if found := [line for line in lines if mark in line]:
            return _TIME.sub("", found[-1]).removeprefix(ERROR_PREFIX)
    return lines[-1]


def _print_report(summary: Summary, out: Path, took_s: float, console: Console) -> None:
    columns = ("fan", "start", "alarm", "delay", "removed", "cleared")
    title = "what happened, seconds since the first sample"
    table = table_of(["fault"], columns, ["probable cause"], title=title)
    for fault in summary.faults:
        times = (fault.start_ns, fault.alarm_ns, fault.stop_ns, fault.cleared_ns)
        cells = ["missed" if t is None else f"{(t - summary.start_ns) / NS_PER_S:.2f}" for t in times]
        cells.insert(2, "" if fault.delay_s is None else f"{fault.delay_s:.2f}")
        cause = f"{short_name(fault.cause)}, {fault.probability:.0%}" if fault.cause else ""
        table.add_row(fault.kind, str(fault.fan), *cells, cause)
    console.print(table)
    p50, p99 = ("unknown" if t is None else f"{t:.1f} ms" for t in summary.latency_ms.values())
    console.print(
        f"{summary.fans} fans, {summary.samples_sent} samples of the tray sent, {summary.samples_recorded} recorded, "
        f"{summary.lost} lost, {summary.false_alarms} false alarms; "
        f"sample to score {p50} (median), {p99} (p99); "
        f"{took_s:.0f} s in all",
        soft_wrap=True,
    )
    shown, programs = (Path(os.path.relpath(path)) for path in (out, Path(sys.executable).parent))
    picture = f"picture: {shown / 'bands.png'}" if (out / "bands.png").exists() else ""
    view = f"interactive: {programs / 'rerun'} {shown / 'view.rrd'}" if (out / "view.rrd").exists() else ""
    for line in (
        f"results: {shown / 'summary.json'} and {shown / 'recording.mcap'}",
        "; ".join(filter(None, (picture, view))),
    ):
        if line:
            console.print(line, markup=False, soft_wrap=True)  # to be copied
    for problem in summary.problems:
        console.print(f"[bold red]PROBLEM:[/bold red] {escape(problem)}")

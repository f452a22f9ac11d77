"""`fantwin demo`: a simulated tray, the whole pipeline, two faults, and an account of what happened."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console, Group
from rich.live import Live
from rich.table import Table
from rich.text import Text

from pipeline.bus import Bus
from pipeline.commands.options import JsonOption
from pipeline.commands.status import stage_table
from pipeline.config import RAD_S_PER_UNIT, Config, load_config
from pipeline.demo_report import Summary, summarise
from pipeline.errors import UserError
from pipeline.signals import stop_on_signals
from pipeline.watcher import Watcher
from schemas.codec import decode
from schemas.messages import FanState, Score, WhyNot
from schemas.topics import tray_key

DEMO_FOLDER = Path(__file__).parents[2] / "demo"
DURATION_S = 32.0
FAULTS = (
    ("inlet", "fan=2,start=8,stop=14,size=1.8"),
    ("rotor", "fan=5,start=18,stop=24,size=0.8"),
)
OUTPUTS = ("recording*.mcap*", "view*.rrd", "bands.png", "summary.json", "truth.json", "up.log", "tray")
_START_TIMEOUT_S = 60.0
_STOP_TIMEOUT_S = 60.0


def demo(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for what it makes.")] = Path("runs/demo"),
    seed: Annotated[int, typer.Option(help="Seed of the simulated tray's commands and noise.")] = 7,
    json_output: JsonOption = False,
) -> None:
    """Run a simulated tray of eight fans through the whole pipeline, cover one inlet, disturb one rotor.

    Exit code 1 when a fault was missed, a healthy fan alarmed, or anything was lost.

    Example: fantwin demo -o runs/demo
    """
    console = Console(stderr=json_output, highlight=False)
    out = out.resolve()
    _clear(out)
    overrides = [
        f"run_folder='{out}'",
        f"tray.0.port='{out / 'tray'}'",
        f"bus.endpoint='tcp/127.0.0.1:{_free_port()}'",
    ]
    config = load_config(DEMO_FOLDER / "demo.toml", overrides)
    started_s = time.monotonic()
    lost = _run(config, overrides, out, seed, console)
    summary = summarise(out / "truth.json", sorted(out.glob("recording*.mcap")), lost)
    _draw(out, console)
    (out / "summary.json").write_text(summary.to_json() + "\n", encoding="utf-8")
    if json_output:
        typer.echo(summary.to_json())
    _tell(summary, out, time.monotonic() - started_s, console)
    if summary.problems:
        raise typer.Exit(1)


def _clear(out: Path) -> None:
    """Remove what an earlier demo made, and nothing else."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        for pattern in OUTPUTS:
            for path in out.glob(pattern):
                path.unlink()
    except OSError as error:
        raise UserError(
            f"{out}: cannot be used for the demo's files: {error.strerror}; name another with -o"
        ) from error


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def _run(config: Config, overrides: list[str], out: Path, seed: int, console: Console) -> dict[str, int]:
    """Run tray and pipeline to the end of the schedule; what each stage says it has lost."""
    stop = threading.Event()
    stop_on_signals(stop)
    tray = config.trays[0]
    simulate = [
        *("simulate", "--fans", str(tray.fans), "--profile", "manual", "--seed", str(seed)),
        *("--duration", str(DURATION_S), "--speed-unit", tray.speed_unit, "--link", tray.port),
        *("--truth", str(out / "truth.json"), "--wait-for-reader"),
    ]
    for kind, settings in FAULTS:
        simulate += ["--fault", f"{kind}:{settings}"]
    up = ["up", "-c", str(config.path), "--json", *(word for override in overrides for word in ("--set", override))]
    with (
        (out / "up.log").open("w", encoding="utf-8") as log,
        _child(simulate, stdout=log, stderr=log) as device,
        _child(up, stdout=subprocess.PIPE, stderr=log) as pipeline,
        Bus(config.bus) as bus,
    ):
        console.print(f"simulated tray of {tray.fans} fans on {tray.port}; six stages start as processes of their own")
        _watch(config, bus, device, pipeline, stop, console)
        if pipeline.poll() is None:
            pipeline.send_signal(signal.SIGINT)
        answer, _ = pipeline.communicate(timeout=_STOP_TIMEOUT_S)
    if stop.is_set():
        raise UserError(f"stopped before the end of the schedule; what was recorded is in {out}")
    if device.returncode or pipeline.returncode not in (0, 3):
        raise UserError(
            f"the pipeline did not run to its end: {_last_line(out / 'up.log')} (all of it in {out / 'up.log'})"
        )
    return {name: count for name, count in json.loads(answer)["lost"].items() if count}


@contextmanager
def _child(arguments: list[str], **streams: object) -> Iterator[subprocess.Popen[str]]:
    """A `fantwin` command in a process (group) of its own, ended whatever happens."""
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "pipeline", *arguments],
        stdin=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
        **streams,  # pyright: ignore[reportArgumentType, reportCallIssue]
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.terminate()
            try:
                process.wait(_STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()


class _Screen:
    """What is shown while the demo runs."""

    def __init__(self, config: Config, bus: Bus) -> None:
        self._tray = config.trays[0]
        self._watcher = Watcher(bus, config.site)
        self.score: Score | None = None
        bus.subscribe(tray_key(config.site, self._tray.name, "score"), self._note_score)

    def _note_score(self, _key: str, payload: bytes) -> None:
        score = decode(Score, payload)
        assert isinstance(score, Score)
        self.score = score

    def render(self) -> Group:
        """Stages and alarms, and below them the fans."""
        return Group(stage_table(self._watcher), self._fan_table())

    def line(self) -> str:
        """The same in a line, where there is no terminal."""
        if self.score is None:
            return "waiting for the first score"
        states = " ".join(FanState(state).name.lower() for state in self.score.state[-1])
        return f"fans: {states}; lost {sum(self._watcher.losses().values())}"

    def _fan_table(self) -> Table:
        unit = self._tray.speed_unit
        table = Table("fan", title=f"{self._tray.name}, speeds in {unit}", title_justify="left")
        for column in ("command", "measured", "twin", "residual"):
            table.add_column(column, justify="right")
        table.add_column("state")
        score = self.score
        if score is None:
            return table
        scale = 1 / RAD_S_PER_UNIT[unit]
        for fan in range(score.fans):
            state = FanState(score.state[-1, fan])
            style = {FanState.NORMAL: "green", FanState.UNKNOWN: "dim", FanState.SUSPECT: "yellow"}.get(
                state, "bold red"
            )
            why = "" if score.valid[-1, fan] else f" ({WhyNot(score.why_not[-1, fan]).name.lower().replace('_', ' ')})"
            table.add_row(
                str(fan),
                f"{score.command[-1, fan]:.2f}",
                f"{score.measured_speed_rad_s[-1, fan] * scale:.0f}",
                f"{score.predicted_speed_rad_s[-1, fan] * scale:.0f}",
                f"{score.smoothed_residual_rad_s[-1, fan] * scale:+.0f}",
                Text(state.name.lower() + why, style=style),
            )
        return table


def _watch(
    config: Config,
    bus: Bus,
    device: subprocess.Popen[str],
    pipeline: subprocess.Popen[str],
    stop: threading.Event,
    console: Console,
) -> None:
    """Show what happens until the tray has sent its last sample, or something ends too early."""
    screen = _Screen(config, bus)
    deadline_s = time.monotonic() + _START_TIMEOUT_S
    next_line_s = 0.0
    live = Live(console=console, refresh_per_second=4, transient=True) if console.is_terminal else None
    if live:
        live.start()
    try:
        while device.poll() is None and pipeline.poll() is None and not stop.wait(0.25):
            if live:
                live.update(screen.render())
            elif time.monotonic() >= next_line_s:
                next_line_s = time.monotonic() + 4.0
                console.print(f"  {screen.line()}")
            if screen.score is None and time.monotonic() > deadline_s:
                raise UserError(f"no score came in {_START_TIMEOUT_S:.0f} s; see up.log, and `fantwin doctor`")
    finally:
        if live:
            live.stop()


def _draw(out: Path, console: Console) -> None:
    from pipeline.band_plot import plot_recording  # noqa: PLC0415  matplotlib is slow to import

    with console.status("drawing bands.png"):
        plot_recording(sorted(out.glob("recording*.mcap")), out / "bands.png", truth=out / "truth.json")


def _last_line(path: Path) -> str:
    lines = path.read_text(encoding="utf-8").strip().splitlines()
    return lines[-1] if lines else "it said nothing"


def _tell(summary: Summary, out: Path, took_s: float, console: Console) -> None:
    table = Table("fault", title="what happened", title_justify="left")
    for column in ("fan", "start s", "alarm s", "delay s", "removed s", "cleared s"):
        table.add_column(column, justify="right")
    first_ns = min((fault.start_ns for fault in summary.faults), default=0)
    for fault in summary.faults:
        times = (fault.start_ns, fault.alarm_ns, None, fault.stop_ns, fault.cleared_ns)
        cells = ["missed" if t is None else f"{(t - first_ns) / 1e9:.2f}" for t in times]
        cells[2] = "" if fault.delay_s is None else f"{fault.delay_s:.2f}"
        table.add_row(fault.kind, str(fault.fan), *cells)
    console.print(table)
    console.print(
        f"{summary.fans} fans, {summary.samples_sent} samples sent, {summary.samples_recorded} recorded, "
        f"{summary.lost} lost, {summary.false_alarms} false alarms; "
        f"sample to score {summary.latency_ms['p50']:.1f} ms (median), {summary.latency_ms['p99']:.1f} ms (p99); "
        f"{took_s:.0f} s in all"
    )
    console.print(f"look at {out / 'bands.png'}, or live over time: rerun {out / 'view.rrd'}")
    for problem in summary.problems:
        console.print(f"[bold red]NOT AS IT MUST BE:[/bold red] {problem}")

"""`fantwin simulate`: plays a simulated tray or a measured file on a serial line, or serves or records a simulated
tray."""

from __future__ import annotations

import json
import time as clock
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fantwin.pipeline.cli.options import JsonOption, SetOption
from fantwin.pipeline.cli.progress import Reporter
from fantwin.pipeline.cli.simulation.scenario import Scenario, read_scenario
from fantwin.pipeline.cli.simulation.serving import serve_hwmon, serve_line
from fantwin.pipeline.cli.simulation.simulated_hwmon import RATE_HZ, tachos_of
from fantwin.pipeline.cli.simulation.summary import count_text, save, save_start, summary_of_file, summary_of_tray
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.recordings.simulated import record
from fantwin.pipeline.sources.simulated.device import PlaybackCounts
from fantwin.schemas.tacho import INSTANTANEOUS

if TYPE_CHECKING:
    from fantwin.simulation.tray import SimulatedTray


def simulate(
    scenario: Annotated[
        Path | None,
        typer.Argument(
            metavar="[SCENARIO.toml]", help="What is simulated: docs/reference/simulated-tray.md lists the keys."
        ),
    ] = None,
    fans: Annotated[int | None, typer.Option(help="Number of fans, 1 to 64. Default: 8.")] = None,
    profile: Annotated[
        str | None, typer.Option(help="Commands: staircase, prbs, multisine, chirp, manual (default) or thermostat.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Random seed of commands, noise, jitter and losses. Default: 1.")
    ] = None,
    duration: Annotated[float | None, typer.Option(help="Seconds to run; default: until Ctrl-C.")] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND:fan=N,start=S,stop=S,size=X", help="Scheduled fault. Repeatable."),
    ] = None,
    link: Annotated[Path | None, typer.Option(help="Symbolic link to create, as the name of the port.")] = None,
    wait: Annotated[bool, typer.Option("--wait-for-reader", help="Start when a program has opened the port.")] = False,
    hwmon: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="No port, but files such as those in /sys/class/hwmon. To inject a fault, write it to `fault` in it.",
        ),
    ] = None,
    recording: Annotated[Path | None, typer.Option(help="No port, but a recording, faster than real time.")] = None,
    truth: Annotated[Path | None, typer.Option(help="JSON file for the ground truth.")] = None,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """Simulate a tray of fans on a serial port that any program can open, or as the fans of a computer.

    A scenario file says what is simulated: kind of fan, tacho, supply, imperfections, or a measured file to play.
    --set changes one of its keys.

    Example: fantwin simulate --link /tmp/fan-tray --fault inlet:fan=2,start=10,stop=18,size=1.6 --truth truth.json

    Fans of a computer: fantwin simulate --hwmon hw --set fan=4-pin --fans 3 --profile thermostat

    A rack: fantwin simulate rack.toml --recording rack.mcap --duration 600
    """
    options = {"fans": fans, "profile": profile, "seed": seed, "duration_s": duration, "faults": fault}
    wanted = read_scenario(scenario, overrides or (), options)
    tachos = INSTANTANEOUS
    tray: SimulatedTray | None = None
    if hwmon and (wanted.file or recording or link or wait):
        raise UsageError("--hwmon excludes a file, --recording, --link and --wait-for-reader")
    if wanted.file and (recording or wanted.faults):
        raise UsageError(
            "a measured file is played unchanged: leave out faults; `fantwin import` makes a recording of it"
        )
    if device := wanted.table():
        assert wanted.file
        summary_of = partial(summary_of_file, wanted.file.path, device)
    else:
        tachos = wanted.tacho
        if hwmon and tachos == INSTANTANEOUS:
            tachos = tachos_of(wanted.chip)
        device = tray = wanted.tray(tachos, wanted.rate_hz or (RATE_HZ if hwmon else 100.0))
        summary_of = partial(summary_of_tray, tray)
    if hwmon and tray:
        played = serve_hwmon(tray, hwmon, wanted.chip, err=json_output)
    elif recording:
        if link or wait:
            raise UsageError("--recording excludes --link and --wait-for-reader")
        if recording.exists():
            raise UserError(f"{recording}: exists; name another file with --recording, or delete it")
        epoch_ns = clock.time_ns() if wanted.epoch_ns is None else wanted.epoch_ns
        length_s, doing = _length_s(wanted), "simulating, s"
        with Reporter(quietly=doing) as reporter:
            played = record(
                *(device, recording, epoch_ns, wanted.speed_unit, tachos),
                lambda t_s: reporter.show(doing, int(t_s), int(length_s)),
            )
    else:
        save(truth, summary_of(PlaybackCounts(), complete=False))
        on_start = partial(save_start, truth, summary_of)
        played = serve_line(device, link, wanted.protocol, wanted.speed_unit, on_start, wait=wait, err=json_output)
    summary = summary_of(played, complete=True)
    save(truth, summary)
    typer.echo(json.dumps(summary) if json_output else count_text(played))


def _length_s(wanted: Scenario) -> float:
    if wanted.duration_s is None:
        raise UsageError("a recording needs its length in seconds: --duration S")
    return wanted.duration_s

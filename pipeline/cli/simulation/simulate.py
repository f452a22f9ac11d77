"""`fantwin simulate`: a simulated tray on a pseudo-terminal, or in a recording; or a measured file on the same line."""

from __future__ import annotations

import json
import math
import threading
import time as clock
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from pipeline.cli.options import JsonOption
from pipeline.devices.measured_table import read_table
from pipeline.devices.simulated_device import Played, PseudoTerminal, play, wait_for_reader
from pipeline.devices.table_device import TableDevice
from pipeline.errors import UserError
from pipeline.recordings.simulated import record
from pipeline.runtime.signals import stop_on_signals
from schemas import wire
from schemas.units import RAD_S_PER_UNIT, SpeedUnit

if TYPE_CHECKING:
    from simulation.tray import SimulatedTray

StreamCounts = dict[str, Any]

_LINE = "Line"
_RECORDING = "Recording instead of a line"
_FILE = "Measured file instead of a simulation"
_REALITY = "What real trays have"


def simulate(
    fans: Annotated[int, typer.Option(help="How many fans, 1 to 64.")] = 8,
    rate: Annotated[float, typer.Option(help="Samples a second.")] = 100.0,
    profile: Annotated[str, typer.Option(help="staircase, prbs, multisine, chirp or manual.")] = "manual",
    seed: Annotated[int, typer.Option(help="Of commands, noise, jitter and losses.")] = 1,
    duration: Annotated[float | None, typer.Option(help="Seconds; without it, until Ctrl-C.")] = None,
    link: Annotated[
        Path | None, typer.Option(help="Symbolic link to make to the line: a port with a name.", rich_help_panel=_LINE)
    ] = None,
    protocol: Annotated[wire.Protocol, typer.Option(help="Of the line.", rich_help_panel=_LINE)] = "binary",
    speed_unit: Annotated[SpeedUnit, typer.Option(help="Of the line.", rich_help_panel=_LINE)] = "rad/s",
    wait: Annotated[
        bool, typer.Option("--wait-for-reader", help="Begin when somebody has opened the line.", rich_help_panel=_LINE)
    ] = False,
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND:fan=N,start=S,stop=S,size=X", help="A fault on a schedule. Repeatable."),
    ] = None,
    truth: Annotated[Path | None, typer.Option(help="JSON file for what really happened.")] = None,
    spread: Annotated[
        float, typer.Option(help="How much fans differ: relative standard deviation.", rich_help_panel=_REALITY)
    ] = 0.03,
    fans_seed: Annotated[
        int, typer.Option(help="Which fans: the same seed gives the same ones.", rich_help_panel=_REALITY)
    ] = 1,
    noise: Annotated[
        float, typer.Option(help="Of the tacho, rad/s, standard deviation.", rich_help_panel=_REALITY)
    ] = 4.0,
    lost: Annotated[
        float, typer.Option(help="Share of samples lost on the line, 0 to 1.", rich_help_panel=_REALITY)
    ] = 0.0,
    jitter_us: Annotated[
        float, typer.Option(help="Of the time of sampling, standard deviation.", rich_help_panel=_REALITY)
    ] = 100.0,
    drift_ppm: Annotated[float, typer.Option(help="How fast the device's clock is.", rich_help_panel=_REALITY)] = 40.0,
    clock_start_us: Annotated[
        int, typer.Option(help="Where the device's clock begins; it wraps at 2^32.", rich_help_panel=_REALITY)
    ] = 0,
    recording: Annotated[
        Path | None,
        typer.Option(
            help="Write the samples to this recording at once, instead of a line.", rich_help_panel=_RECORDING
        ),
    ] = None,
    epoch_ns: Annotated[
        int | None,
        typer.Option(
            help="Time at which the recording begins, ns since 1970; without it, now.", rich_help_panel=_RECORDING
        ),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace a recording that exists.", rich_help_panel=_RECORDING)
    ] = False,
    from_csv: Annotated[
        Path | None,
        typer.Option(help="Play this measured file at its own times, instead of simulating.", rich_help_panel=_FILE),
    ] = None,
    time: Annotated[
        str, typer.Option(metavar="COLUMN[:UNIT]", help="Time column of the file.", rich_help_panel=_FILE)
    ] = "",
    period: Annotated[
        str | None,
        typer.Option(help="Time between rows of a file without a time column, e.g. 10ms.", rich_help_panel=_FILE),
    ] = None,
    command: Annotated[
        list[str] | None,
        typer.Option(
            metavar="COLUMN", help="Command column of the file, one a fan. Repeatable.", rich_help_panel=_FILE
        ),
    ] = None,
    speed: Annotated[
        list[str] | None,
        typer.Option(metavar="COLUMN[:UNIT]", help="Speed column, one a fan. Repeatable.", rich_help_panel=_FILE),
    ] = None,
    from_s: Annotated[
        float, typer.Option("--from", help="Where in the file to begin, s since its first row.", rich_help_panel=_FILE)
    ] = 0.0,
    to_s: Annotated[
        float, typer.Option("--to", help="Where in the file to end, s since its first row.", rich_help_panel=_FILE)
    ] = math.inf,
    json_output: JsonOption = False,
) -> None:
    """Simulate a tray of fans on a serial line that any program can open.

    Example: fantwin simulate --link /tmp/fan-tray --fault inlet:fan=2,start=10,stop=18,size=1.6 --truth truth.json
    """
    device: SimulatedTray | TableDevice
    if from_csv:
        if recording or fault:
            raise UserError("--from-csv plays a file as it is: leave out --fault; for --recording use `fantwin import`")
        device = TableDevice(
            read_table(from_csv, time or None, command or [], speed or [], period=period), from_s, to_s
        )
        account_of = partial(_account_of_file, from_csv, device)
    else:
        if time or period or command or speed:
            raise UserError(
                "--time, --period, --command and --speed are about a file: name it with --from-csv FILE.csv"
            )
        device = _tray(
            faults=fault or [],
            tacho={"noise_rad_s": noise},
            clock={"drift_ppm": drift_ppm, "start_us": clock_start_us},
            fans=fans,
            rate_hz=rate,
            duration_s=math.inf if duration is None else duration,
            profile=profile,
            seed=seed,
            fans_seed=fans_seed,
            spread=spread,
            lost=lost,
            jitter_us=jitter_us,
        )
        account_of = partial(_account_of_tray, device)
    if recording:
        if duration is None or link or wait:
            raise UserError("--recording needs --duration; a line's --link and --wait-for-reader do not go with it")
        if not math.isfinite(duration):
            raise UserError(f"--duration {duration}: a recording must end; give a number of seconds")
        if recording.exists() and not force:
            raise UserError(f"{recording}: exists; name another file with --recording, or replace it with --force")
        played = record(device, recording, clock.time_ns() if epoch_ns is None else epoch_ns, duration, speed_unit)
        account = account_of(played, complete=True)
        _save(truth, account)
    else:
        stop = threading.Event()
        stop_on_signals(stop)
        line = PseudoTerminal(link)
        try:
            _save(truth, account_of(Played(), complete=False))
            fans_on = "1 fan on" if device.fans == 1 else f"{device.fans} fans on"
            typer.echo(f"{fans_on} {link or line.port}: {protocol}, speeds in {speed_unit}", err=json_output)
            if wait:
                wait_for_reader(line, stop)
            began = partial(_save_start, truth, account_of)
            played = play(device, line, protocol, RAD_S_PER_UNIT[speed_unit], stop, began)
            account = account_of(played, complete=True)
            _save(truth, account)
        finally:
            line.close()
    typer.echo(json.dumps(account) if json_output else _sentence(played))


def _tray(*, faults: list[str], tacho: Mapping[str, Any], clock: Mapping[str, Any], **settings: Any) -> SimulatedTray:
    """The tray of these settings; see `simulation.tray.TraySettings`.

    Raises:
        UserError: a setting is out of its range, or a fault cannot be understood.
    """
    from simulation.errors import SimulationError  # noqa: PLC0415  the command line loads twin only when it is needed
    from simulation.faults import parse_fault  # noqa: PLC0415
    from simulation.plant import DeviceClock, Tacho  # noqa: PLC0415
    from simulation.tray import SimulatedTray, TraySettings  # noqa: PLC0415

    try:
        schedule = tuple(map(parse_fault, faults))
        return SimulatedTray(
            TraySettings(faults=schedule, tacho=Tacho(**tacho), clock=DeviceClock(**clock), **settings)
        )
    except SimulationError as error:
        raise UserError(str(error)) from error


def _counts(played: Played) -> StreamCounts:
    counts = asdict(played)
    del counts["start_ns"]
    return counts


def _account_of_tray(tray: SimulatedTray, played: Played, *, complete: bool) -> StreamCounts:
    from simulation.truth import truth  # noqa: PLC0415

    return truth(tray, played.start_ns, complete=complete, counts=_counts(played))


def _account_of_file(path: Path, table: TableDevice, played: Played, *, complete: bool) -> StreamCounts:
    return {
        "complete": complete,
        "start_ns": played.start_ns,
        **_counts(played),
        "faults": [],
        "fans": table.fans,
        "file": str(path),
    }


def _save(path: Path | None, account: StreamCounts) -> None:
    from simulation.truth import write_truth  # noqa: PLC0415

    if path is None:
        return
    try:
        write_truth(path, account)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}; name another file with --truth") from error


def _save_start(path: Path | None, account_of: Callable[..., StreamCounts], start_ns: int) -> None:
    _save(path, account_of(Played(start_ns=start_ns), complete=False))


def _sentence(played: Played) -> str:
    parts = [f"{played.samples_sent} samples sent"]
    if played.samples_dropped:
        parts.append(f"{played.samples_dropped} lost on purpose")
    if played.samples_unsent:
        parts.append(f"{played.samples_unsent} not sent because nobody read the line (fast enough)")
    if played.bytes_unread:
        parts.append(f"the last {played.bytes_unread} bytes were never read")
    if played.samples_late:
        parts.append(f"{played.samples_late} sent late, at worst by {played.worst_lateness_s * 1e3:.0f} ms")
    return "; ".join(parts)

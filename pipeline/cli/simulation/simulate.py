"""`fantwin simulate`: plays a simulated tray or a measured file on a serial line, or serves or records a simulated
tray."""

from __future__ import annotations

import json
import math
import time as clock
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from fantwin.pipeline.cli.options import (
    CurrentOption,
    JsonOption,
    SupplyVoltageOption,
    TemperatureOption,
    auxiliary_options,
)
from fantwin.pipeline.cli.simulation.serving import serve_hwmon, serve_line
from fantwin.pipeline.cli.simulation.simulated_hwmon import RATE_HZ, tachos_of
from fantwin.pipeline.cli.simulation.simulated_tray import made_tacho, made_tray, measured_columns
from fantwin.pipeline.cli.simulation.summary import count_text, save, save_start, summary_of_file, summary_of_tray
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.recordings.simulated import record
from fantwin.pipeline.sources.simulated.device import PlaybackCounts
from fantwin.pipeline.sources.simulated.table import TableDevice
from fantwin.pipeline.sources.tables.measured_table import read_table
from fantwin.schemas import wire
from fantwin.schemas.tacho import INSTANTANEOUS
from fantwin.schemas.units import SpeedUnit

if TYPE_CHECKING:
    from fantwin.simulation.tray import SimulatedTray

_LINE = "Serial line"
_HWMON = "Fans of a computer instead"
_RECORDING = "Write a recording instead"
_FILE = "Play a measured file instead of simulating"
_TACHO = "Tacho"
_SURROUNDINGS = "Supply and air"
_IMPERFECTIONS = "Imperfections of real trays"


def simulate(
    fans: Annotated[int, typer.Option(help="Number of fans, 1 to 64.")] = 8,
    rate: Annotated[
        float | None,
        typer.Option(
            help="Samples per second; with --hwmon, how often its files are written. Default 100, with --hwmon 20."
        ),
    ] = None,
    fan: Annotated[
        Literal["dc", "4-pin"], typer.Option(help="Kind of fan: on a bridge, or with a PWM input of its own.")
    ] = "dc",
    profile: Annotated[
        str, typer.Option(help="Commands: staircase, prbs, multisine, chirp, manual or thermostat.")
    ] = "manual",
    seed: Annotated[int, typer.Option(help="Random seed of commands, noise, jitter and losses.")] = 1,
    duration: Annotated[float | None, typer.Option(help="Seconds to run; default: until Ctrl-C.")] = None,
    link: Annotated[
        Path | None, typer.Option(help="Symbolic link to create, as the name of the port.", rich_help_panel=_LINE)
    ] = None,
    protocol: Annotated[
        wire.Protocol, typer.Option(help="Form of the wire protocol.", rich_help_panel=_LINE)
    ] = "binary",
    speed_unit: Annotated[SpeedUnit, typer.Option(help="Unit of speed on the line.", rich_help_panel=_LINE)] = "rad/s",
    wait: Annotated[
        bool, typer.Option("--wait-for-reader", help="Start when a program has opened the port.", rich_help_panel=_LINE)
    ] = False,
    hwmon: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Folder for files such as those in /sys/class/hwmon. To inject a fault, write it to `fault` in it.",
            rich_help_panel=_HWMON,
        ),
    ] = None,
    chip: Annotated[
        str,
        typer.Option(help="Name of the chip, which determines how its driver measures speeds.", rich_help_panel=_HWMON),
    ] = "nct6798",
    fault: Annotated[
        list[str] | None,
        typer.Option(metavar="KIND:fan=N,start=S,stop=S,size=X", help="Scheduled fault. Repeatable."),
    ] = None,
    truth: Annotated[Path | None, typer.Option(help="JSON file for the ground truth.")] = None,
    fan_variation: Annotated[
        float, typer.Option(help="Variation between fans, relative standard deviation.", rich_help_panel=_IMPERFECTIONS)
    ] = 0.03,
    fans_seed: Annotated[
        int, typer.Option(help="Random seed of the variation between fans.", rich_help_panel=_IMPERFECTIONS)
    ] = 1,
    tacho: Annotated[
        Literal["instantaneous", "count", "average", "period"],
        typer.Option(
            help="What a reading is: the speed now, pulses counted or averaged over a window, or the last revolution.",
            rich_help_panel=_TACHO,
        ),
    ] = "instantaneous",
    pulses: Annotated[int, typer.Option(help="Pulses per revolution.", rich_help_panel=_TACHO)] = 2,
    window: Annotated[
        list[float] | None,
        typer.Option(
            help="Seconds over which pulses are counted: one for all fans, or one per fan. Repeatable.",
            rich_help_panel=_TACHO,
        ),
    ] = None,
    update: Annotated[
        float, typer.Option(help="Seconds between new counts; default: the window.", rich_help_panel=_TACHO)
    ] = 0.0,
    tacho_delay: Annotated[
        float, typer.Option(help="Seconds by which readings are late.", rich_help_panel=_TACHO)
    ] = 0.0,
    noise: Annotated[
        float,
        typer.Option(help="Noise of an instantaneous reading, rad/s, standard deviation.", rich_help_panel=_TACHO),
    ] = 4.0,
    missing_edges: Annotated[
        float, typer.Option(help="Share of pulses not seen, 0 to 1.", rich_help_panel=_TACHO)
    ] = 0.0,
    double_edges: Annotated[
        float, typer.Option(help="Share of pulses seen twice, 0 to 1.", rich_help_panel=_TACHO)
    ] = 0.0,
    missing: Annotated[
        float, typer.Option(help="Share of readings that are missing, 0 to 1.", rich_help_panel=_TACHO)
    ] = 0.0,
    lost: Annotated[float, typer.Option(help="Share of samples lost, 0 to 1.", rich_help_panel=_IMPERFECTIONS)] = 0.0,
    jitter_us: Annotated[
        float, typer.Option(help="Jitter of the sampling time, standard deviation.", rich_help_panel=_IMPERFECTIONS)
    ] = 100.0,
    drift_ppm: Annotated[
        float, typer.Option(help="Drift of the device clock; positive: fast.", rich_help_panel=_IMPERFECTIONS)
    ] = 40.0,
    clock_start_us: Annotated[
        int,
        typer.Option(help="First reading of the device clock, which wraps at 2^32.", rich_help_panel=_IMPERFECTIONS),
    ] = 0,
    measure: Annotated[
        list[str] | None,
        typer.Option(
            metavar="COLUMN",
            help="Also send this column: supply_voltage_v, current_a or temperature_c. Repeatable.",
            rich_help_panel=_SURROUNDINGS,
        ),
    ] = None,
    supply_wander: Annotated[
        float,
        typer.Option(
            help="Relative standard deviation of the supply voltage, for example 0.05.", rich_help_panel=_SURROUNDINGS
        ),
    ] = 0.0,
    supply_held: Annotated[
        float,
        typer.Option(
            help="4-pin fans: 1 if they hold their speed against the supply, 0 if it is proportional to the supply.",
            rich_help_panel=_SURROUNDINGS,
        ),
    ] = 1.0,
    air_temperature: Annotated[
        float, typer.Option(help="Mean temperature of the air, °C.", rich_help_panel=_SURROUNDINGS)
    ] = 20.0,
    air_swing: Annotated[
        float,
        typer.Option(
            help="Amplitude of the air temperature around its mean, °C; period 10 minutes.",
            rich_help_panel=_SURROUNDINGS,
        ),
    ] = 0.0,
    recording: Annotated[
        Path | None,
        typer.Option(help="Recording to write, faster than real time.", rich_help_panel=_RECORDING),
    ] = None,
    epoch_ns: Annotated[
        int | None,
        typer.Option(help="Start time of the recording, ns since 1970; default: now.", rich_help_panel=_RECORDING),
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace an existing recording.", rich_help_panel=_RECORDING)
    ] = False,
    from_csv: Annotated[
        Path | None,
        typer.Option(help="Measured file to play at its own times.", rich_help_panel=_FILE),
    ] = None,
    time: Annotated[
        str,
        typer.Option(
            metavar="COLUMN[:UNIT]",
            help="Time column. Units: s (default), ms, us, ns, iso (dates).",
            rich_help_panel=_FILE,
        ),
    ] = "",
    period: Annotated[
        str | None,
        typer.Option(help="Time between rows of a file without a time column, e.g. 10ms.", rich_help_panel=_FILE),
    ] = None,
    command: Annotated[
        list[str] | None,
        typer.Option(
            metavar="COLUMN",
            help="Command column: one for all fans, or one per fan. Repeatable.",
            rich_help_panel=_FILE,
        ),
    ] = None,
    speed: Annotated[
        list[str] | None,
        typer.Option(
            metavar="COLUMN[:UNIT]",
            help="Speed column, one per fan. Units: rpm, hz, deg/s, rad/s (default). Repeatable.",
            rich_help_panel=_FILE,
        ),
    ] = None,
    supply_voltage: SupplyVoltageOption = None,
    current: CurrentOption = None,
    temperature: TemperatureOption = None,
    from_s: Annotated[
        float, typer.Option("--from", help="Start, seconds since the first row.", rich_help_panel=_FILE)
    ] = 0.0,
    to_s: Annotated[
        float, typer.Option("--to", help="End, seconds since the first row.", rich_help_panel=_FILE)
    ] = math.inf,
    json_output: JsonOption = False,
) -> None:
    """Simulate a tray of fans on a serial port that any program can open, or as the fans of a computer.

    Example: fantwin simulate --link /tmp/fan-tray --fault inlet:fan=2,start=10,stop=18,size=1.6 --truth truth.json

    Fans of a computer: fantwin simulate --hwmon hw --fan 4-pin --fans 3 --profile thermostat

    A rack: fantwin simulate --fan 4-pin --fans 4 --tacho count --window 1.0 --pulses 2 --rate 10 --profile thermostat
    """
    device: SimulatedTray | TableDevice
    tachos = INSTANTANEOUS
    tray: SimulatedTray | None = None
    if hwmon and (from_csv or recording or link or wait):
        raise UsageError("--hwmon excludes --from-csv, --recording, --link and --wait-for-reader")
    if from_csv:
        if recording or fault:
            raise UsageError(
                "--from-csv plays a file unchanged: leave out --fault; instead of --recording use `fantwin import`"
            )
        auxiliary = auxiliary_options(supply_voltage, current, temperature)
        table = read_table(from_csv, time or None, command or [], speed or [], period=period, auxiliary=auxiliary)
        device = TableDevice(table, from_s, to_s)
        summary_of = partial(summary_of_file, from_csv, device)
    else:
        if time or period or command or speed or supply_voltage or current or temperature:
            raise UsageError("--time, --period and columns describe a file: name it with --from-csv FILE")
        tachos = tuple(
            made_tacho(kind=tacho, pulses=pulses, window_s=one, update_s=update, delay_s=tacho_delay)
            for one in window or [0.0]
        )
        if hwmon and tacho == "instantaneous":
            tachos = tachos_of(chip)
        device = tray = made_tray(
            faults=fault or [],
            tachos=tachos,
            noise_rad_s=noise,
            shares={"missing_edges": missing_edges, "double_edges": double_edges, "missing_readings": missing},
            clock={"drift_ppm": drift_ppm, "start_us": clock_start_us},
            surroundings={
                "measured": measured_columns(measure or []),
                "supply_wander": supply_wander,
                "supply_held": supply_held,
                "temperature_c": air_temperature,
                "temperature_swing_c": air_swing,
            },
            fans=fans,
            fan=fan,
            rate_hz=rate if rate is not None else RATE_HZ if hwmon else 100.0,
            duration_s=math.inf if duration is None else duration,
            profile=profile,
            seed=seed,
            fans_seed=fans_seed,
            fan_variation=fan_variation,
            lost=lost,
            jitter_us=jitter_us,
        )
        summary_of = partial(summary_of_tray, tray)
    if hwmon and tray:
        played = serve_hwmon(tray, hwmon, chip, err=json_output)
    elif recording:
        if duration is None or link or wait:
            raise UsageError("--recording needs --duration, and excludes --link and --wait-for-reader")
        if not math.isfinite(duration):
            raise UsageError(f"--duration {duration}: a recording needs a finite number of seconds")
        if recording.exists() and not force:
            raise UserError(f"{recording}: exists; name another file with --recording, or replace it with --force")
        epoch_ns = clock.time_ns() if epoch_ns is None else epoch_ns
        played = record(device, recording, epoch_ns, duration, speed_unit, tachos)
    else:
        save(truth, summary_of(PlaybackCounts(), complete=False))
        played = serve_line(
            device, link, protocol, speed_unit, partial(save_start, truth, summary_of), wait=wait, err=json_output
        )
    summary = summary_of(played, complete=True)
    save(truth, summary)
    typer.echo(json.dumps(summary) if json_output else count_text(played))

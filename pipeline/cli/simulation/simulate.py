"""`fantwin simulate`: plays a simulated tray or a measured file on a serial line, or serves or records a simulated
tray."""

from __future__ import annotations

import json
import math
import threading
import time as clock
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from pydantic import ValidationError

from pipeline.cli.options import (
    CurrentOption,
    JsonOption,
    SupplyVoltageOption,
    TemperatureOption,
    auxiliary_options,
)
from pipeline.cli.simulation.simulated_hwmon import RATE_HZ, InjectedFaults, tachos_of
from pipeline.devices.hwmon_simulator import FAULT_FILE, HwmonTree, play_hwmon
from pipeline.devices.measured_table import read_table
from pipeline.devices.simulated_device import PlaybackCounts, PseudoTerminal, play, wait_for_reader
from pipeline.devices.table_device import TableDevice
from pipeline.errors import UsageError, UserError
from pipeline.recordings.simulated import record
from pipeline.runtime.signals import stop_on_signals
from schemas import wire
from schemas.auxiliary import AUXILIARY
from schemas.tacho import INSTANTANEOUS, Tacho
from schemas.units import RAD_S_PER_UNIT, SpeedUnit

if TYPE_CHECKING:
    from simulation.tray import SimulatedTray

Summary = dict[str, Any]

_TACHO_OPTIONS = {
    "kind": "--tacho",
    "pulses": "--pulses",
    "window_s": "--window",
    "update_s": "--update",
    "delay_s": "--tacho-delay",
}

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
            help="Share of it for which 4-pin fans make up: 1 if they control their speed, 0 if it follows the supply.",
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
        summary_of = partial(_summary_of_file, from_csv, device)
    else:
        if time or period or command or speed or supply_voltage or current or temperature:
            raise UsageError("--time, --period and columns describe a file: name it with --from-csv FILE")
        tachos = tuple(
            _tacho(kind=tacho, pulses=pulses, window_s=one, update_s=update, delay_s=tacho_delay)
            for one in window or [0.0]
        )
        if hwmon and tacho == "instantaneous":
            tachos = tachos_of(chip)
        device = tray = _tray(
            faults=fault or [],
            tachos=tachos,
            noise_rad_s=noise,
            shares={"missing_edges": missing_edges, "double_edges": double_edges, "missing_readings": missing},
            clock={"drift_ppm": drift_ppm, "start_us": clock_start_us},
            surroundings={
                "measured": _measured(measure or []),
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
        summary_of = partial(_summary_of_tray, tray)
    if hwmon and tray:
        played = _serve_hwmon(tray, hwmon, chip, err=json_output)
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
        _save(truth, summary_of(PlaybackCounts(), complete=False))
        played = _serve_line(
            device, link, protocol, speed_unit, partial(_save_start, truth, summary_of), wait=wait, err=json_output
        )
    summary = summary_of(played, complete=True)
    _save(truth, summary)
    typer.echo(json.dumps(summary) if json_output else _count_text(played))


def _serve_line(
    device: SimulatedTray | TableDevice,
    link: Path | None,
    protocol: wire.Protocol,
    speed_unit: SpeedUnit,
    on_start: Callable[[int], None],
    *,
    wait: bool,
    err: bool,
) -> PlaybackCounts:
    """Play the device on a pseudo-terminal. wait: for a reader. err: say on stderr where it is."""
    stop = threading.Event()
    stop_on_signals(stop)
    line = PseudoTerminal(link)
    try:
        fans_on = "1 fan on" if device.fans == 1 else f"{device.fans} fans on"
        typer.echo(f"{fans_on} {link or line.port}: {protocol}, speeds in {speed_unit}", err=err)
        if wait:
            wait_for_reader(line, protocol, stop)
        return play(device, line, protocol, RAD_S_PER_UNIT[speed_unit], stop, on_start)
    finally:
        line.close()


def _serve_hwmon(tray: SimulatedTray, root: Path, chip: str, *, err: bool) -> PlaybackCounts:
    """Run the tray behind a tree of files until Ctrl-C. err: say where on stderr."""
    stop = threading.Event()
    stop_on_signals(stop)
    tree = HwmonTree(root, chip, tray.fans)
    try:
        typer.echo(
            f"{tray.fans} fans of {chip} in {root}; faults: echo tacho-stuck:fan=0 > {root / FAULT_FILE}", err=err
        )
        return play_hwmon(tray, tree, stop, InjectedFaults(tray, root).follow)
    finally:
        tree.close()


def _tacho(**settings: Any) -> Tacho:
    """The tacho with these settings; see `schemas.tacho.Tacho`.

    Raises:
        UsageError: they do not fit one another, or one is out of range.
    """
    try:
        return Tacho(**settings)
    except ValidationError as error:
        first = error.errors()[0]
        where = f"{_TACHO_OPTIONS[str(first['loc'][0])]} {first['input']}: " if first["loc"] else ""
        text = first["msg"].removeprefix("Value error, ")
        for field in ("window_s", "update_s"):
            text = text.replace(field, _TACHO_OPTIONS[field])
        raise UsageError(where + text) from error


def _tray(
    *,
    faults: list[str],
    tachos: tuple[Tacho, ...],
    noise_rad_s: float,
    shares: Mapping[str, float],
    clock: Mapping[str, Any],
    surroundings: Mapping[str, Any],
    **settings: Any,
) -> SimulatedTray:
    """The tray with these settings; see `simulation.tray.TraySettings`.

    Raises:
        UsageError: a setting is out of range, or a fault cannot be parsed.
    """
    from simulation.errors import SimulationError  # noqa: PLC0415  loaded only by the commands that need it
    from simulation.faults import parse_fault  # noqa: PLC0415
    from simulation.plant import DeviceClock  # noqa: PLC0415
    from simulation.surroundings import Surroundings  # noqa: PLC0415
    from simulation.tacho import NoisyTacho, TachoSettings  # noqa: PLC0415
    from simulation.tray import SimulatedTray, TraySettings  # noqa: PLC0415

    measured = TachoSettings(tachos, NoisyTacho(noise_rad_s), **shares)
    try:
        schedule = tuple(map(parse_fault, faults))
        around, device_clock = Surroundings(**surroundings), DeviceClock(**clock)
        return SimulatedTray(
            TraySettings(faults=schedule, tacho=measured, clock=device_clock, surroundings=around, **settings)
        )
    except SimulationError as error:
        raise UsageError(str(error)) from error


def _measured(names: list[str]) -> tuple[str, ...]:
    known = [column.name for column in AUXILIARY]
    for name in names:
        if name not in known:
            raise UsageError(f"--measure {name}: known are {', '.join(known)}")
    return tuple(name for name in known if name in names)


def _counts(played: PlaybackCounts) -> Summary:
    counts = asdict(played)
    del counts["start_ns"]
    return counts


def _summary_of_tray(tray: SimulatedTray, played: PlaybackCounts, *, complete: bool) -> Summary:
    from simulation.truth import truth  # noqa: PLC0415

    return truth(tray, played.start_ns, complete=complete, counts=_counts(played))


def _summary_of_file(path: Path, table: TableDevice, played: PlaybackCounts, *, complete: bool) -> Summary:
    return {
        "complete": complete,
        "start_ns": played.start_ns,
        **_counts(played),
        "faults": [],
        "fans": table.fans,
        "file": str(path),
    }


def _save(path: Path | None, summary: Summary) -> None:
    from simulation.truth import write_truth  # noqa: PLC0415

    if path is None:
        return
    try:
        write_truth(path, summary)
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}; name another file with --truth") from error


def _save_start(path: Path | None, summary_of: Callable[..., Summary], start_ns: int) -> None:
    _save(path, summary_of(PlaybackCounts(start_ns=start_ns), complete=False))


def _count_text(played: PlaybackCounts) -> str:
    parts = [f"{played.samples_sent} samples sent"]
    if played.samples_dropped:
        parts.append(f"{played.samples_dropped} lost as simulated")
    if played.samples_unsent:
        parts.append(f"{played.samples_unsent} not sent because no program read the port, or too slowly")
    if played.bytes_unread:
        parts.append(f"the last {played.bytes_unread} bytes were not read")
    if played.samples_late:
        parts.append(f"{played.samples_late} sent late, by up to {played.worst_lateness_s * 1e3:.0f} ms")
    return "; ".join(parts)

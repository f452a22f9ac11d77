"""`fantwin simulate`: plays a simulated tray or a measured file on a line, or serves or records a simulated tray."""

from __future__ import annotations

import json
import math
import time as clock
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fantwin.pipeline.cli.options import JsonOption, SetOption
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.cli.progress import Reporter
from fantwin.pipeline.cli.simulation.scenario import read_scenario
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.files import write_whole
from fantwin.pipeline.recordings.raw_recordings import record
from fantwin.pipeline.runtime.signals import stop_on_signals
from fantwin.pipeline.sources.hwmon.chip_table import chip_of
from fantwin.pipeline.sources.simulated.device import PlaybackCounts, PseudoTerminal, play, wait_for_reader
from fantwin.pipeline.sources.simulated.hwmon import FAULT_FILE, HwmonTree, play_hwmon
from fantwin.pipeline.sources.simulated.table import TableDevice
from fantwin.schemas import wire
from fantwin.schemas.tacho import INSTANTANEOUS, Tacho
from fantwin.schemas.units import RAD_S_PER_UNIT, SpeedUnit

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
        if wanted.duration_s is None:
            raise UsageError("a recording needs its length in seconds: --duration S")
        epoch_ns = clock.time_ns() if wanted.epoch_ns is None else wanted.epoch_ns
        length_s, doing = int(wanted.duration_s), "simulating, s"
        with Reporter(quietly=doing) as reporter:
            played = record(
                *(device, recording, epoch_ns, wanted.speed_unit, tachos),
                lambda t_s: reporter.show(doing, int(t_s), length_s),
            )
    else:

        def on_start(start_ns: int | None) -> None:
            """The truth, with the start, before any sample is counted."""
            save(truth, summary_of(PlaybackCounts(start_ns=start_ns), complete=False))

        on_start(None)
        played = serve_line(device, link, wanted.protocol, wanted.speed_unit, on_start, wait=wait, err=json_output)
    summary = summary_of(played, complete=True)
    save(truth, summary)
    show(summary, count_text(played), json_output=json_output)


def serve_line(
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
    stop = stop_on_signals()
    with closing(PseudoTerminal(link)) as line:
        fans_on = "1 fan on" if device.fans == 1 else f"{device.fans} fans on"
        typer.echo(f"{fans_on} {link or line.port}: {protocol}, speeds in {speed_unit}", err=err)
        if wait:
            wait_for_reader(line, protocol, stop)
        return play(device, line, protocol, RAD_S_PER_UNIT[speed_unit], stop, on_start, say_late())


def serve_hwmon(tray: SimulatedTray, root: Path, chip: str, *, err: bool) -> PlaybackCounts:
    """Run the tray behind a tree of files until Ctrl-C. err: say where on stderr."""
    stop = stop_on_signals()
    with closing(HwmonTree(root, chip, tray.fans)) as tree:
        faults = f"echo tacho-stuck:fan=0 > {root / FAULT_FILE}"
        typer.echo(f"{tray.fans} fans of {chip} in {root}; faults: {faults}", err=err)
        return play_hwmon(tray, tree, stop, InjectedFaults(tray, root).follow, say_late())


TOO_LATE_S, SAID_EVERY_S = 1.0, 60.0


def say_late() -> Callable[[float], None]:
    """What takes the lateness of late samples, and says, at most once a minute, that the simulation is far behind."""
    said_s = -math.inf

    def note(lateness_s: float) -> None:
        nonlocal said_s
        now_s = clock.monotonic()
        if lateness_s > TOO_LATE_S and now_s - said_s >= SAID_EVERY_S:
            said_s = now_s
            typer.echo(
                f"{lateness_s:.1f} s late: this computer is too slow for the simulation now, and what is learned of it "
                "meanwhile is wrong; end other programs, or simulate fewer fans or a lower --set rate_hz",
                err=True,
            )

    return note


RATE_HZ = 20.0
"""at which the files are served"""


def tachos_of(chip: str) -> tuple[Tacho, ...]:
    """The tacho behind the driver of a chip; instantaneous where it is not known, with a note if the chip is not."""
    row = chip_of(chip)
    if row is None:
        typer.echo(f"note: the driver of chip {chip!r} is not known: readings are instantaneous", err=True)
    return (row.tacho,) if row and row.tacho else INSTANTANEOUS


class InjectedFaults:
    """The faults that a file names, one a line as on the command line, besides those of the schedule.

    They begin when the file is written, and end when it no longer names them.
    """

    def __init__(self, tray: SimulatedTray, root: Path) -> None:
        self._tray = tray
        self._file = root / FAULT_FILE
        self._modified_ns = 0
        self._active: dict[str, int] = {}
        """number of the fault in the schedule, by its line"""

    def follow(self) -> None:
        """Read the file again if it has changed."""
        try:
            modified_ns = self._file.stat().st_mtime_ns
            if modified_ns == self._modified_ns:
                return
            lines = [line.strip() for line in self._file.read_text(encoding="utf-8", errors="replace").splitlines()]
        except OSError:
            return
        self._modified_ns = modified_ns
        wanted = dict.fromkeys(filter(None, lines))
        for line in [line for line in self._active if line not in wanted]:
            self._end(self._active.pop(line))
            typer.echo(f"fault removed: {line}", err=True)
        for line in wanted:
            if line not in self._active:
                self._begin(line)

    def _begin(self, line: str) -> None:
        from fantwin.simulation.errors import SimulationError  # noqa: PLC0415  loaded only by the commands that need it
        from fantwin.simulation.faults import parse_fault  # noqa: PLC0415

        tray = self._tray
        faults = tray.settings.faults
        try:
            fault = parse_fault(line)
            begun = replace(fault, start_s=fault.start_s + tray.t_s, stop_s=fault.stop_s + tray.t_s)
            tray.set_faults((*faults, begun))
        except SimulationError as error:
            typer.echo(f"{self._file}: {error}", err=True)
            return
        self._active[line] = len(faults)
        typer.echo(f"fault injected: {line}", err=True)

    def _end(self, number: int) -> None:
        faults = list(self._tray.settings.faults)
        faults[number] = replace(faults[number], stop_s=max(self._tray.t_s, faults[number].start_s + 1e-3))
        self._tray.set_faults(tuple(faults))


Summary = dict[str, Any]


def summary_of_tray(tray: SimulatedTray, played: PlaybackCounts, *, complete: bool) -> Summary:
    """The ground truth of a simulated tray, and how many of its samples were sent, dropped and lost."""
    from fantwin.simulation.truth import truth  # noqa: PLC0415

    counts = {name: count for name, count in asdict(played).items() if name != "start_ns"}
    return truth(tray, played.start_ns, complete=complete, counts=counts)


def summary_of_file(path: Path, table: TableDevice, played: PlaybackCounts, *, complete: bool) -> Summary:
    """The same for a played file, whose faults are not known."""
    return {"complete": complete, **asdict(played), "faults": [], "fans": table.fans, "file": str(path)}


def save(path: Path | None, summary: Summary) -> None:
    """Write the summary, where a file is named.

    Raises:
        UserError: it cannot be written.
    """
    if path is not None:
        content = json.dumps(summary, indent=2) + "\n"
        write_whole(path, content.encode(), "; name another file with --truth")


def count_text(played: PlaybackCounts) -> str:
    """How many samples were sent, dropped and lost, in one line."""
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

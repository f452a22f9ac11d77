"""`fantwin commission`: from a line to alarms, by the documented commands, in one."""

from __future__ import annotations

import json
import os
import shlex
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

from pipeline.bus.endpoint import accepts_connections
from pipeline.cli.options import DEFAULT_CONFIG, ConfigOption, JsonOption, SetOption
from pipeline.cli.progress import EXIT_INTERRUPTED
from pipeline.cli.twins.training_data import check_writable, read_training_data, twin_errors
from pipeline.cli.watch.child_commands import RECORDING_ONLY, Commands, RecordingSite, Stopped
from pipeline.cli.watch.doctor import running_sessions
from pipeline.cli.watch.sweep import range_within
from pipeline.config.loading import load_config
from pipeline.config.models import Config, TrayConfig
from pipeline.config.registry import STAGES
from pipeline.config.twin_entry import with_twin
from pipeline.errors import UserError
from pipeline.learning.ordinary_operation import OrdinaryOperation
from pipeline.runtime.signals import stop_on_signals
from pipeline.runtime.tray_twin import load_tray_twin
from pipeline.selftest.scratch_site import FANTWIN
from scoring.limits import Limits

EXIT_LOST = 3
SHOWN_EVERY_S = 60.0


def commission(
    config: ConfigOption = DEFAULT_CONFIG,
    sweep: Annotated[
        bool,
        typer.Option("--sweep", help="Move the fans, as `fantwin sweep` does; otherwise the plant must move them."),
    ] = False,
    low: Annotated[float | None, typer.Option(help="With --sweep: lowest command.")] = None,
    high: Annotated[float | None, typer.Option(help="With --sweep: highest command.")] = None,
    safe: Annotated[float | None, typer.Option(help="With --sweep: the command at the end.")] = None,
    rounds: Annotated[
        int,
        typer.Option(
            min=1,
            max=100,
            help="With --sweep: how often the first sweep passes all levels; the second passes them once.",
        ),
    ] = 2,
    minutes: Annotated[
        float, typer.Option(min=0.1, max=10_000, help="Length of each recording of ordinary operation.")
    ] = 10.0,
    at_most_hours: Annotated[
        float,
        typer.Option(min=0.01, max=1000, help="Without --sweep: the longest wait for the plant to move the fans."),
    ] = 24.0,
    false_alarms_per_day: Annotated[
        float, typer.Option(min=1e-6, max=8640, help="The rate to declare: false alarms per fan and day.")
    ] = 1.0,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="TWIN.onnx", help="Twin to write. Default: TRAY.onnx.")
    ] = None,
    watch: Annotated[bool, typer.Option(help="Start `fantwin up` at the end.")] = True,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """Record healthy fans, train their twin, set its alarm limits, write it into the configuration, start watching.

    The steps are commands of docs/tutorial/own-fan.md; each is shown before it runs, except the `up` that records. The
    fans must be healthy. Without --sweep no fan is moved: the first recording lasts until the plant has moved every fan
    through enough commands, and what is missing is shown. The limits come from little data: calibrate again after a few
    days.

    Ctrl-C ends it without a twin; recordings stay. With --json it does not start `fantwin up`.

    Exit codes: 0 success; 1 failed, and one line says why; 3 success, but data were lost while recording; 130 Ctrl-C.
    Once `fantwin up` is started, the exit code is that of `up`.

    Example: fantwin commission -c fantwin.toml --sweep --low 0.2
    """
    settings = load_config(config, overrides or (), stages=())
    tray = _only_tray(settings)
    twin = output or settings.folder / f"{tray.name}.onnx"
    _refuse_what_cannot_end_well(settings, tray, twin)
    if sweep:
        range_within(tray, low, high, safe)
    elif given := [name for name, value in (("--low", low), ("--high", high), ("--safe", safe)) if value is not None]:
        raise UserError(f"{given[0]} needs --sweep, which moves the fans: add --sweep")
    configured = ["-c", str(config), *(word for override in overrides or () for word in ("--set", override))]
    stop = threading.Event()
    stop_on_signals(stop)
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as nohup sets it
        signal.signal(signal.SIGHUP, lambda _number, _frame: stop.set())

    def say(line: str) -> None:
        typer.echo(line, err=json_output)

    work = _Commissioning(settings, configured, Commands(stop, say, to_standard_error=json_output))
    try:
        with_sweep = _sweep_words(low, high, safe) if sweep else None
        work.make(twin, with_sweep, rounds, 60.0 * minutes, 3600.0 * at_most_hours, false_alarms_per_day)
    except Stopped:
        kept = ", ".join(map(str, work.recordings))
        typer.echo(f"interrupted: no twin was written; recorded until then: {kept or 'nothing'}", err=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None
    except UserError as error:
        if not work.recordings:
            raise
        raise UserError(f"{error}; recorded until then: {', '.join(map(str, work.recordings))}") from error
    entry = _write_entry(settings, twin)
    for fan in work.held:
        say(
            f"{fan} while the data for its limits were recorded: its limits are uncertain at other commands; "
            "calibrate again later"
        )
    say(f'{config}: tray {tray.name} has twin = "{entry}" now')
    if json_output:
        typer.echo(json.dumps(work.as_json(twin, entry)))
    elif watch and not stop.is_set():
        say(f"fantwin up {shlex.join(configured)}")
        os.execv(FANTWIN[0], [*FANTWIN, "up", *configured])
    if work.lost:
        raise typer.Exit(EXIT_LOST)


def _only_tray(settings: Config) -> TrayConfig:
    tray, *others = settings.trays
    if others:
        names = ", ".join(each.name for each in settings.trays)
        raise UserError(f"{settings.path} has trays {names}: commission each with a configuration of its own")
    return tray


def _refuse_what_cannot_end_well(settings: Config, tray: TrayConfig, twin: Path) -> None:
    """Before anything is recorded."""
    if tray.command_min == tray.command_max:
        raise UserError(
            f"{settings.path}: command_min and command_max of tray {tray.name} are equal: no twin can be made"
        )
    if tray.twin is not None:
        raise UserError(
            f"{settings.path}: tray {tray.name} has twin {tray.twin} already: remove `twin`, then start again"
        )
    judging = [name for name, row in STAGES.items() if row.needs_twin]
    if missing := [name for name in judging if name not in settings.stages]:
        raise UserError(f"{settings.path}: launcher.stages leaves out {', '.join(missing)}: remove launcher.stages")
    with_twin(settings.text, twin.name, settings.path)
    if not os.access(settings.path.resolve().parent, os.W_OK):
        raise UserError(
            f"{settings.path}: its folder is not writable, so the twin could not be added to the configuration"
        )
    if twin.exists():
        raise UserError(f"{twin}: exists already: name another with -o")
    check_writable(twin, ".onnx")
    if accepts_connections(settings.bus.endpoint) and (running := running_sessions(settings)):
        raise UserError(f"site {settings.site!r} runs already ({', '.join(sorted(running))}): stop it first")
    with twin_errors():
        import_module("twin.build")  # the extra may not be installed


def _sweep_words(low: float | None, high: float | None, safe: float | None) -> list[str]:
    given = {"--low": low, "--high": high, "--safe": safe}
    return [word for name, value in given.items() if value is not None for word in (name, repr(value))]


class _Commissioning:
    """The steps, and what was recorded in them."""

    def __init__(self, settings: Config, configured: list[str], commands: Commands) -> None:
        self._settings = settings
        self._configured = configured
        self._commands = commands
        self.recordings: list[Path] = []
        self.lost: dict[str, int] = {}
        """while recording, by stage"""
        self.held: list[str] = []
        """fans that hardly moved while the data for their limits were recorded"""

    def make(
        self,
        twin: Path,
        sweep: list[str] | None,
        rounds: int,
        operation_s: float,
        at_most_s: float,
        false_alarms_per_day: float,
    ) -> None:
        """Make a calibrated twin.

        sweep: the options of a sweep but for its rounds; None: the plant moves the fans, within at_most_s.
        """
        run = self._commands.run
        first, later = (OrdinaryOperation(self._settings.trays[0]) for _ in range(2))
        run("doctor", *self._configured, *RECORDING_ONLY)
        if sweep is None:
            moved = self._recorded(lambda site: self._operate(site, first, operation_s, at_most_s))
        else:
            moved = self._recorded(lambda site: self._sweep(site, sweep, rounds))
        if hints := read_training_data(moved, None, None, 0.0, float("inf")).tacho_hints():
            raise UserError(f"{hints[0]}: declare the tacho that was found as `tacho` in [[tray]], then start again")
        if sweep is None:
            held_out = [self._recorded(lambda site: self._operate(site, later, operation_s))]
        else:  # the limits need other speeds than those that the plant happens to have in some minutes
            held_out = [self._recorded(lambda site: self._sweep(site, sweep, 1))]
        held_out.append(self._recorded(lambda site: self._operate(site, later, operation_s)))
        self.held = later.held() if sweep is None else []
        try:
            run("train", *moved, "--validate", *held_out[0], "-o", twin)
            healthy = [path for recording in held_out for path in recording]
            run("calibrate", twin, *healthy, "--false-alarms-per-day", f"{false_alarms_per_day:g}", "--extrapolate")
        except (Stopped, UserError):
            twin.unlink(missing_ok=True)
            raise

    def as_json(self, twin: Path, entry: str) -> dict[str, object]:
        """The result as JSON fields."""
        rate = Limits.model_validate(load_tray_twin(twin).card.calibration).declared_rate
        assert rate
        return {
            "config": str(self._settings.path),
            "twin": str(twin),
            "entry": entry,
            "recordings": list(map(str, self.recordings)),
            "lost": self.lost,
            "held": self.held,
            "false_alarms_per_day": rate.false_alarms_per_day,
            "extrapolated": rate.extrapolated,
            "fan_hours": rate.fan_hours,
        }

    def _recorded(self, during: Callable[[RecordingSite], None]) -> list[Path]:
        """The parts of one recording, while something is done."""
        self._settings.run_folder.mkdir(parents=True, exist_ok=True)
        site = RecordingSite(
            self._commands, self._settings, self._configured, self._settings.run_folder / "commission.log"
        )
        try:
            with site:
                site.wait_for_samples()
                during(site)
        finally:
            self.recordings += site.recordings
            for name, count in site.lost.items():
                self.lost[name] = self.lost.get(name, 0) + count
        lost = ", ".join(f"{name} {count}" for name, count in site.lost.items())
        self._commands.say(f"recorded {', '.join(map(str, site.recordings))}; lost: {lost or 'nothing'}")
        return site.recordings

    def _sweep(self, site: RecordingSite, options: list[str], rounds: int) -> None:
        self._commands.run("sweep", *self._configured, *options, "--rounds", rounds, site=site)

    def _operate(
        self, site: RecordingSite, operation: OrdinaryOperation, at_least_s: float, at_most_s: float | None = None
    ) -> None:
        """Record ordinary operation, which `operation` sees; with at_most_s until the fans have moved enough."""
        until = "" if at_most_s is None else ", and until the fans have moved enough"
        self._commands.say(f"recording ordinary operation for {at_least_s / 60:.3g} min{until}")
        began_s, shown_s, recorded_s, missing = time.monotonic(), 0.0, 0.0, list[str]()
        while recorded_s < at_least_s or missing:
            for raw in site.wait(1.0):
                operation.take(raw)
            recorded_s = time.monotonic() - began_s
            if at_most_s is not None:
                missing = operation.missing()
                if missing and recorded_s > at_most_s:
                    raise UserError(
                        f"in {at_most_s / 3600:.3g} h the fans have not moved enough ({'; '.join(missing)}): move them "
                        "with --sweep, or wait longer with --at-most-hours"
                    )
            if recorded_s - shown_s >= SHOWN_EVERY_S:
                shown_s = recorded_s
                lacks = f"; still missing: {'; '.join(missing)}" if missing else ""
                self._commands.say(f"{recorded_s / 60:.0f} min of at least {at_least_s / 60:.3g}{lacks}")


def _write_entry(settings: Config, twin: Path) -> str:
    """Write the twin into the configuration; returns the path as it is written there."""
    resolved, folder = twin.resolve(), settings.folder.resolve()
    entry = str(resolved.relative_to(folder)) if resolved.is_relative_to(folder) else str(resolved)
    path = settings.path.resolve()
    unfinished = path.with_name(f"{path.name}.part")
    try:
        text = with_twin(path.read_bytes().decode(), entry, settings.path)  # its user may have edited it meanwhile
        before = path.stat()
        with unfinished.open("wb") as file:
            file.write(text.encode())
            file.flush()
            os.fsync(file.fileno())
        unfinished.chmod(before.st_mode)
        with suppress(PermissionError):
            os.chown(unfinished, before.st_uid, before.st_gid)
        unfinished.replace(path)
    except (OSError, UnicodeDecodeError) as error:
        unfinished.unlink(missing_ok=True)
        raise UserError(f'{settings.path}: cannot be changed ({error}): add twin = "{entry}" to its tray') from error
    return entry

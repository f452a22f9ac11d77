"""`fantwin commission`: from a line to alarms, by the documented commands, in one."""

from __future__ import annotations

import json
import os
import shlex
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from fantwin.pipeline.acquisition.command_sender import require_commandable
from fantwin.pipeline.bus.endpoint import accepts_connections
from fantwin.pipeline.cli.options import (
    DEFAULT_CONFIG,
    ConfigOption,
    HighOption,
    JsonOption,
    LowOption,
    RoundsOption,
    SafeOption,
    SetOption,
)
from fantwin.pipeline.cli.progress import EXIT_INTERRUPTED
from fantwin.pipeline.cli.twins.data_options import check_writable
from fantwin.pipeline.cli.watch.child_commands import Commands, Stopped
from fantwin.pipeline.cli.watch.commission_state import Unfinished
from fantwin.pipeline.cli.watch.commissioning import Commissioning, Plan, TrayWork
from fantwin.pipeline.cli.watch.doctor import running_sessions
from fantwin.pipeline.cli.watch.sweep import range_within
from fantwin.pipeline.config.loading import load_config, with_twin
from fantwin.pipeline.config.registry import RECORDER, STAGES
from fantwin.pipeline.config.settings import Config, TrayConfig
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.replay.offline.calibration_of_twin import calibration_in
from fantwin.pipeline.runtime.signals import stop_on_signals
from fantwin.pipeline.selftest.scratch_site import FANTWIN

EXIT_LOST = 3


def commission(
    config: ConfigOption = DEFAULT_CONFIG,
    tray: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Only this tray. Repeatable. Default: all that name no twin."),
    ] = None,
    sweep: Annotated[
        bool,
        typer.Option("--sweep", help="Move the commands, as `fantwin command --sweep` does; otherwise the plant must."),
    ] = False,
    low: LowOption = None,
    high: HighOption = None,
    safe: SafeOption = None,
    rounds: RoundsOption = 2,
    minutes: Annotated[
        float, typer.Option(min=0.1, max=10_000, help="Length of each recording of ordinary operation.")
    ] = 10.0,
    false_alarms_per_day: Annotated[
        float, typer.Option(min=1e-6, max=8640, help="The rate to declare: false alarms per fan and day.")
    ] = 1.0,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="TWIN.onnx", help="Twin to write, for one tray. Default: TRAY.onnx."),
    ] = None,
    watch: Annotated[bool, typer.Option(help="Start `fantwin up` at the end.")] = True,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """Record healthy fans, train their twins, calibrate them, add them to the configuration, start `fantwin up`.

    Each tray that names no twin gets one; the others stay as they are. The steps are other commands, each shown before
    it runs, except the `up` that records. The fans must be healthy.

    With --sweep, the trays are swept one after another: --rounds times to train on, once more to validate. Without it,
    no command is sent: the first recording lasts until the plant has moved the command of every fan enough, at most a
    day, and what is missing is shown. The calibration is from little data: calibrate again after a few days.

    A tray that fails is left out: the others get their twins, but `fantwin up` is not started. Ctrl-C ends `commission`
    without further twins. Recordings stay, in folders `commissioned-N` that no recorder empties. The same command goes
    on with complete recordings of the last day, unless no twin could be made of them. With --json, `fantwin up` is not
    started.

    Exit codes: 0 success; 1 at least one tray failed, and one line says why; 3 success, but data were lost while
    recording; 130 Ctrl-C. Once `fantwin up` is started, the exit code is that of `up`.

    Example: fantwin commission -c fantwin.toml --sweep --low 0.2
    """
    settings = load_config(config, overrides or (), stages=(RECORDER,))
    chosen = [settings.tray(name) for name in dict.fromkeys(tray or ())] or list(settings.trays)
    works = _works(settings, chosen, output)
    given = {"--low": low, "--high": high, "--safe": safe}
    options = [word for name, value in given.items() if value is not None for word in (name, repr(value))]
    if options and not sweep:
        raise UsageError(f"{options[0]} needs --sweep, which moves the fans: add --sweep")
    for work in works:
        _refuse_what_cannot_end_well(settings, work, "-o" if len(works) == 1 else f"--tray {work.name} -o")
        if sweep:
            instead = "leave out --sweep, and let the fans' own controller vary their commands meanwhile"
            require_commandable(work.tray, instead)
            range_within(work.tray, low, high, safe)
    _refuse_site_that_cannot_end_well(settings, works)
    configured = ["-c", str(config), *(word for override in overrides or () for word in ("--set", override))]
    stop = stop_on_signals()
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # as nohup sets it
        signal.signal(signal.SIGHUP, lambda _number, _frame: stop.set())

    def say(line: str) -> None:
        typer.echo(line, err=json_output)

    for each in chosen:
        if each.twin is not None:
            say(f"{config}: tray {each.name} keeps its twin {each.twin}")
    plan = Plan(options if sweep else None, rounds, 60.0 * minutes, false_alarms_per_day)
    commands = Commands(stop, say, to_standard_error=json_output)
    with Unfinished(settings.run_folder) as unfinished:
        commissioning = Commissioning(settings, configured, commands, works, plan, unfinished)
        _run(commissioning, works)
    for work in commissioning.left:
        for fan in work.so_far.held:
            say(
                f"tray {work.name}, {fan} while it was calibrated: what it does at other commands is uncertain; "
                "calibrate again later"
            )
    if json_output:
        found = {"config": str(config), "trays": [_tray_as_json(work) for work in works if work.entry]}
        found |= {"failed": {work.name: work.failure for work in works if work.failure}}
        found |= {"recordings": list(map(str, commissioning.recordings)), "lost": commissioning.lost}
        typer.echo(json.dumps(found))
    if commissioning.failures:
        raise UserError(f"{commissioning.failures}; recorded: {commissioning.recorded}{commissioning.how_to_go_on}")
    if watch and not json_output and not stop.is_set():
        say(f"fantwin up {shlex.join(configured)}")
        os.execv(FANTWIN[0], [*FANTWIN, "up", *configured])
    if commissioning.lost:
        raise typer.Exit(EXIT_LOST)


def _works(settings: Config, chosen: Sequence[TrayConfig], output: Path | None) -> list[TrayWork]:
    """One for each chosen tray that names no twin.

    Raises:
        UserError: there is none, or there are several and `output` is for one.
    """
    works = [TrayWork(tray, output or settings.folder / f"{tray.name}.onnx") for tray in chosen if tray.twin is None]
    if not works:
        named = ", ".join(f"tray {tray.name} has twin {tray.twin}" for tray in chosen)
        raise UserError(f"{settings.path}: {named} already: remove `twin`, then start again")
    if output and len(works) > 1:
        names = ", ".join(work.name for work in works)
        raise UsageError(f"-o names one twin, and trays {names} get one each: choose one with --tray, or leave out -o")
    return works


def _refuse_what_cannot_end_well(settings: Config, work: TrayWork, option: str) -> None:
    """Refuse what would fail after the recording. option: names another file for its twin."""
    if work.tray.command_min == work.tray.command_max:
        raise UserError(
            f"{settings.path}: command_min and command_max of tray {work.name} are equal: no twin can be made"
        )
    if work.twin.exists():
        raise UserError(f"{work.twin}: exists already: name another with {option}")
    check_writable(work.twin, ".onnx")


def _refuse_site_that_cannot_end_well(settings: Config, works: Sequence[TrayWork]) -> None:
    """Refuse what would fail after the recordings of all trays."""
    judging = [name for name, row in STAGES.items() if row.needs_twin]
    if missing := [name for name in judging if name not in settings.stages]:
        switched_off = [name for name in missing if name in settings.launcher.without]
        key = "launcher.without" if switched_off else "launcher.stages"
        raise UserError(f"{settings.path}: {key} leaves out {', '.join(switched_off or missing)}: remove {key}")
    text = settings.text
    for work in works:
        text = with_twin(text, work.name, work.twin.name, settings.path)
    if not os.access(settings.path.resolve().parent, os.W_OK):
        raise UserError(
            f"{settings.path}: its folder is not writable, so the twin could not be added to the configuration"
        )
    if accepts_connections(settings.bus.endpoint) and (running := running_sessions(settings)):
        names = ", ".join(dict.fromkeys(session.name for session in running))
        raise UserError(f"site {settings.site!r} runs already ({names}): stop it first")


def _run(commissioning: Commissioning, works: Sequence[TrayWork]) -> None:
    """All steps; an early end says what was recorded until then."""
    try:
        commissioning.run()
    except Stopped:
        written = [work.name for work in works if work.entry]
        twins = f"twins were written of tray {', '.join(written)} only" if written else "no twin was written"
        recorded = f"recorded until then: {commissioning.recorded or 'nothing'}{commissioning.how_to_go_on}"
        typer.echo(f"interrupted: {twins}; {recorded}", err=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None
    except UserError as error:
        if not commissioning.recordings:
            raise
        recorded = f"recorded until then: {commissioning.recorded}{commissioning.how_to_go_on}"
        raise UserError(f"{error}; {recorded}") from error


def _tray_as_json(work: TrayWork) -> dict[str, Any]:
    calibration = calibration_in(work.twin, load_tray_twin(work.twin))
    assert calibration
    return {
        "tray": work.name,
        "twin": str(work.twin),
        "entry": work.entry,
        "held": work.so_far.held,
        "false_alarms_per_day": calibration.false_alarms_per_day,
        "is_target": calibration.is_target,
        "fan_hours": calibration.fan_hours,
    }

"""`fantwin command --sweep`: move the commands of a tray's fans, so that a recording determines their twins."""

from __future__ import annotations

import math
import os
import threading
from collections.abc import Mapping

import numpy as np
import typer

from fantwin.pipeline.acquisition.command_sender import (
    CommandSender,
    NotReceivedError,
    command_of,
    require_commandable,
    require_within_limits,
)
from fantwin.pipeline.acquisition.raw_samples import RawSamples
from fantwin.pipeline.bus.session import Bus, join_bus
from fantwin.pipeline.cli.options import fan_numbers
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.config.roles import OPERATOR
from fantwin.pipeline.config.settings import Config, TrayConfig
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.learning.child_command import VARIABLE
from fantwin.pipeline.learning.sweep_steps import FANS_KEEP, Excitation, Observed, StoppedError, range_in_words, turning
from fantwin.pipeline.runtime.signals import stop_on_signals, when_stdin_closes
from fantwin.schemas.messages import Raw
from fantwin.schemas.topics import sweep_key
from fantwin.schemas.units import NS_PER_S

_FIRST_SAMPLE_S = 5.0


def sweep(
    settings: Config,
    chosen: TrayConfig,
    fans: str,
    low: float | None,
    high: float | None,
    safe: float | None,
    rounds: int,
    *,
    json_output: bool,
) -> None:
    """Move the commands of fans over their range: levels up and down, long and short, while a site records.

    Two steps over the whole range show the time constants of the fans; each level then lasts five of the longest. Each
    fan runs through the levels in a different order, so that the load on the common supply does not follow any one fan.
    At the end, after Ctrl-C and after an error each fan gets the command `safe`, or the one it had before.

    Raises:
        UserError: the fans cannot be moved, or not be left as they shall be.
        typer.Exit: the user stopped it.
    """
    require_commandable(chosen, "run `fantwin up` while the fans' own controller varies their commands; it is recorded")
    numbers = fan_numbers(None if fans == "all" else fans, lambda: chosen.names) or list(range(chosen.fans))
    if not all(0 <= number < chosen.fans for number in numbers):
        raise UsageError(f"--fans {fans}: tray {chosen.name} has fans 0 to {chosen.fans - 1}")
    lowest, highest = range_within(chosen, low, high, safe)
    stop = stop_on_signals()
    if VARIABLE in os.environ:
        when_stdin_closes(stop.set)  # the learner that started it has ended, perhaps by SIGKILL
    steps: list[str] = []

    def progress(line: str) -> None:
        steps.append(line)
        if not json_output:
            typer.echo(line)

    with join_bus(settings, listens=False, roles=(OPERATOR,)) as bus:
        line = _BusLine(bus, settings.site, chosen, stop)
        before = line.connect()
        key = sweep_key(settings.site, chosen.name)
        if bus.alive(key):
            raise UserError(f"another sweep moves the fans of tray {chosen.name}: wait until it has ended")
        bus.declare_alive(key)
        at_end = {fan: float(before[fan]) if safe is None else safe for fan in numbers}
        left_at = f"the commands {'they had before' if safe is None else 'of --safe'}: {_in_words(chosen, at_end)}"
        progress(f"tray {chosen.name}: {range_in_words(chosen, lowest, highest)}")
        if low is None and lowest > chosen.command_min:
            progress(f"the lowest command should keep fans turning; --low {chosen.command_min:g} uses the whole range")
        progress(f"at the end and after Ctrl-C the fans get {left_at}")
        is_stopped, constants_s, ended = False, dict[int, float](), ""
        try:
            constants_s = Excitation(line, numbers, lowest, highest, rounds, progress, chosen.names).run()
        except StoppedError:
            is_stopped = True
        except UserError as error:
            ended = f"the sweep has ended: {error}"
            raise UserError(f"{ended}; the fans are left at {left_at}") from error
        finally:
            _leave(line, chosen, at_end, ended)
    known = {str(fan): value if math.isfinite(value) else None for fan, value in constants_s.items()}
    found = {"tray": chosen.name, "names": list(chosen.names.names), "time_constants_s": known, "steps": steps}
    found |= {"left_at": {str(fan): value for fan, value in at_end.items()}, "stopped": is_stopped}
    end = "stopped" if is_stopped else "done"
    show(found, f"{end}; the fans are left at {left_at}; `fantwin command` sets others", json_output=json_output)
    if is_stopped:
        raise typer.Exit(1)


def range_within(tray: TrayConfig, low: float | None, high: float | None, safe: float | None) -> tuple[float, float]:
    """The commands of a sweep, lowest and highest: see `turning`.

    Raises:
        UsageError: one of them, or the safe command, is outside those limits; or --high alone is given, not above the
            lowest: the user must say how low commands may go.
    """
    usual = turning(tray)
    lowest, highest = usual[0] if low is None else low, usual[1] if high is None else high
    if not tray.command_min <= lowest < highest <= tray.command_max:
        raise UsageError(_wrong_range(tray, low, high, lowest))
    if safe is not None:
        require_within_limits(tray, safe, "--safe")
    return lowest, highest


def _wrong_range(tray: TrayConfig, low: float | None, high: float | None, lowest: float) -> str:
    """What is wrong with the options that were given."""
    if low is None and high is not None and tray.command_min < high <= lowest:
        return (
            f"--high {high:g}: name --low, too: without it tray {tray.name} is swept from {lowest:g}, because fans may "
            "stop below"
        )
    given = " ".join(f"{name} {value:g}" for name, value in (("--low", low), ("--high", high)) if value is not None)
    limits = f"{tray.command_min:g} to {tray.command_max:g}"
    return f"{given}: name a range within {limits} of tray {tray.name}"


def _leave(line: _BusLine, tray: TrayConfig, at_end: Mapping[int, float], ended: str) -> None:
    """Send the safe commands, whatever happened before: together, or one by one if that fails. ended: why the sweep has
    ended; empty if it was done or stopped by the user.

    Raises:
        UserError: some were not sent; it names these.
    """
    line.stop = threading.Event()
    failed: dict[int, str] = {}
    try:
        line.send(at_end)
    except NotReceivedError as error:
        failed = dict.fromkeys(at_end, str(error))
    except UserError:  # a device may have refused one fan and ignored those after it
        for fan, value in at_end.items():
            try:
                line.send({fan: value})
            except UserError as error:
                failed[fan] = str(error)
    if failed:
        by_hand = _in_words(tray, {fan: at_end[fan] for fan in failed})
        reasons = "; ".join(dict.fromkeys(failed.values()))
        kept = f"{FANS_KEEP}; send these by hand: {by_hand} ({reasons})"
        raise UserError("; ".join(filter(None, (kept, ended))))


def _in_words(tray: TrayConfig, commands: Mapping[int, float]) -> str:
    return ", ".join(f"{tray.label(fan)} {value:g}" for fan, value in commands.items())


class _BusLine:
    """The tray through its acquisition."""

    def __init__(self, bus: Bus, site: str, tray: TrayConfig, stop: threading.Event) -> None:
        self.stop = stop
        self._tray = tray
        self._arriving = RawSamples(bus, site, [tray.name])
        self._samples: list[Raw] = []
        self._sender = CommandSender(bus, site, tray.name, stop)

    def connect(self) -> np.ndarray:
        """Wait for acquisition and its first sample; returns the commands (fans,) of that."""
        self._sender.connect()
        waited_s = 0.0
        while not self._take():
            if waited_s > _FIRST_SAMPLE_S or self.wait(0.05):
                raise UserError(f"tray {self._tray.name}: no sample arrives: see acquisition in `fantwin status`")
            waited_s += 0.05
        return self._samples[-1].command[-1]

    def send(self, values: Mapping[int, float]) -> None:
        """Send commands, by fan.

        Raises:
            StoppedError: the user wants to stop.
            UserError: they were not sent.
        """
        self._sender.stop = self.stop
        self._sender.send(command_of(self._tray, dict(values), named="fan"))
        try:
            self._sender.confirm()
        except NotReceivedError as error:
            if self.stop.is_set():
                raise StoppedError from error
            raise
        self._take()
        self._samples = self._samples[-1:]  # the speed from which the step begins

    def observed(self) -> Observed:
        """The samples since the last command."""
        self._take()
        times = np.concatenate([sample.host_receive_t_ns for sample in self._samples])
        return Observed(
            (times - times[0]) / NS_PER_S,
            np.concatenate([sample.command for sample in self._samples]),
            np.concatenate([sample.speed_rad_s for sample in self._samples]),
        )

    def wait(self, seconds: float) -> bool:
        """Wait; returns whether the user wants to stop."""
        return self.stop.wait(seconds)

    def _take(self) -> bool:
        """Take what has arrived; returns whether there is any sample."""
        self._samples += [sample for sample in self._arriving.take() if sample.fans == self._tray.fans]
        return bool(self._samples)

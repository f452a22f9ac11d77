"""Commands to the fans of one tray, sent through its acquisition, which says what became of them."""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from fantwin.pipeline.acquisition.acquisition_watch import TrayAcquisition
from fantwin.pipeline.acquisition.device_commands import not_sent, reason_in
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import Config, TrayConfig
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.header import Header
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Command
from fantwin.schemas.topics import BY_NAME, tray_key
from fantwin.schemas.units import RAD_S_PER_UNIT

_T = TypeVar("_T")
_ANSWER_S = 5.0  # acquisition answers within a quarter of a second, on a busy host within one or two
_POLL_S = 0.01
LARGEST_SHARE = 2.0
"""a tray whose commands go further does not count them as shares of 1"""


def chosen_tray(config: Config, name: str | None) -> TrayConfig:
    """The tray that `--tray` names; the only one if it is not given.

    Raises:
        UsageError: there are several, or none of this name.
    """
    names = [each.name for each in config.trays]
    if name is None and len(names) > 1:
        raise UsageError(f"name the tray with --tray (trays: {', '.join(names)})")
    return config.tray(name or names[0])


def command_of(
    tray: TrayConfig, values: dict[int, float], *, is_set_point: bool = False, named: str = "--fan"
) -> Command:
    """A command without a header. values: by fan; the other fans stay as they are. named: how errors name a fan.

    Raises:
        UsageError: the tray has no such fan, or a value is outside its limits.
    """
    wanted, unchanged = np.full((2, tray.fans), np.nan)
    for fan, value in values.items():
        if not 0 <= fan < tray.fans:
            raise UsageError(f"{named} {fan}: tray {tray.name} has fans 0 to {tray.fans - 1}")
        require_within_limits(tray, value, f"{named} {fan}", is_set_point=is_set_point)
        wanted[fan] = value * RAD_S_PER_UNIT[tray.speed_unit] if is_set_point else value
    columns = (unchanged, wanted) if is_set_point else (wanted, unchanged)
    return Command(fans=tray.fans, t_ns=time.time_ns(), command=columns[0], set_point_rad_s=columns[1])


def require_within_limits(tray: TrayConfig, value: float, named: str, *, is_set_point: bool = False) -> None:
    """Refuse a command, or a set-point in the tray's unit, outside its limits. named: the option that gave it.

    Raises:
        UsageError: it is outside.
    """
    low, high = (-tray.speed_max, tray.speed_max) if is_set_point else (tray.command_min, tray.command_max)
    if not low <= value <= high:  # NaN is in no range
        what = f"set-point, {tray.speed_unit}," if is_set_point else "command"
        raise UsageError(f"{named} {value:g}: the {what} must be within {low:g} to {high:g} of tray {tray.name}")


def share_note(tray: TrayConfig, command: float) -> str:
    """A note where a command looks like a share of the range, and the tray's commands are none; else empty."""
    low, high = tray.command_min, tray.command_max
    if not (0.0 < command < 1.0 and high > LARGEST_SHARE):
        return ""
    share = f"{100 * command:g} % of this range is {low + command * (high - low):.4g}"
    return f"note: commands of tray {tray.name} go from {low:g} to {high:g}, and {command:g} was sent; {share}"


def require_commandable(tray: TrayConfig, instead: str) -> None:
    """Refuse a tray that takes no commands. instead: what to do instead, the end of the message; may be empty.

    Raises:
        UserError: it takes none.
    """
    if reason := tray.source.why_no_commands:
        raise UserError(f"tray {tray.name} takes no commands ({reason}){': ' * bool(instead)}{instead}")


class NotReceivedError(UserError):
    """No acquisition has received a command."""


class CommandSender:
    """Sends commands to one tray."""

    def __init__(self, bus: Bus, site: str, tray: str, stop: threading.Event) -> None:
        self._bus = bus
        self._acquisition = TrayAcquisition(bus, site, tray)
        self._tray = tray
        self.stop = stop
        self._producer = f"command-{tray}-{secrets.token_hex(2)}-{bus.id}"
        key = tray_key(site, tray, "command")
        self._publisher = bus.publisher(key, BY_NAME["command"], type_name(Command), self._producer)
        self._before: Health | None = None
        """the last health before the commands that are not confirmed"""

    def connect(self) -> None:
        """Wait for the tray's acquisition.

        Raises:
            UserError: there is none, or this command has no right to send.
        """
        self._bus.require_rights(self.stop)
        self._wait(self._acquisition.watch_health)
        self._before = self._wait(self._acquisition.health)

    def send(self, message: Command) -> None:
        """Publish a command."""
        header = Header(self._producer, self._publisher.published, self._tray)
        self._publisher.put(encode(replace(message, header=header)))

    def confirm(self) -> None:
        """Wait until acquisition has received all commands.

        Raises:
            NotReceivedError: it has not.
            UserError: it could not send one to the device that was not confirmed before.
        """
        before, self._before = self._before, self._wait(self._received)
        if reason := why_not_sent(self._tray, before, self._before):
            raise UserError(f"tray {self._tray}: the command failed: {reason}")

    def _received(self) -> Health | None:
        health, sent = self._acquisition.health(), self._publisher.published
        inputs = [each for each in health.inputs if each.producer == self._producer] if health else []
        return health if any(each.received >= sent for each in inputs) else None

    def _wait(self, find: Callable[[], _T | None]) -> _T:
        until_s = time.monotonic() + _ANSWER_S
        while (found := find()) is None:
            if time.monotonic() > until_s or self.stop.wait(_POLL_S):
                raise NotReceivedError(
                    f"no acquisition of tray {self._tray} received the command: is `fantwin up` running?"
                )
        return found


def why_not_sent(tray: str, before: Health | None, after: Health) -> str:
    """Why acquisition has not sent a command of a tray to its device; empty if it has sent all. before, after: its
    health messages before the commands in question and after them."""
    if before and after.header.producer != before.header.producer:
        before = None
    if _not_sent(after) <= (_not_sent(before) if before else 0):
        return ""
    known = before.notes if before else ()
    notes = [note for note in after.notes if note.tray == tray and note not in known]
    return "; ".join(filter(None, (reason_in(note.text) for note in notes))) or "acquisition does not say why"


def _not_sent(health: Health) -> int:
    return not_sent({counter.name: counter.value for counter in health.counters})

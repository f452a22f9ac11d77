"""Checks commands, sends them to the device of a tray, and counts those that were sent, refused and lost."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.sources.source import SampleSource, within
from fantwin.schemas.messages import Command
from fantwin.schemas.units import RAD_S_PER_UNIT

REFUSED, LOST, SENT = "refused_commands", "lost_commands", "sent_commands"
_NOT_SENT = {REFUSED: "refused", LOST: "not taken by the device"}
"""words of the notes, by counter of commands that were not sent"""
_NOTE = re.compile(rf"\d+ commands? (?:{'|'.join(_NOT_SENT.values())})(?:, the last one)?: (.+)")


def not_sent(counters: Mapping[str, int]) -> int:
    """Number of commands that an acquisition has not sent. counters: its own, by name."""
    return sum(counters.get(name, 0) for name in _NOT_SENT)


def reason_in(note: str) -> str:
    """Why the last command that a note counts was not sent; empty if it is no note on commands."""
    found = _NOTE.fullmatch(note)
    return found[1] if found else ""


class DeviceCommands:
    """Sends commands to one source."""

    def __init__(self, tray: TrayConfig, source: SampleSource) -> None:
        self._tray = tray
        self._source = source
        self.counts: Counter[str] = Counter()
        self._reasons: dict[str, str] = {}
        """reason why the last command was not sent, by counter"""

    def send(self, wanted: Command, down_reason: str | None) -> None:
        """Send a command; one that this tray cannot carry out is refused as a whole.

        down_reason: why the source is not connected; None: it is.
        """
        command = tuple(map(float, wanted.command))
        set_point = tuple(float(value) / RAD_S_PER_UNIT[self._tray.speed_unit] for value in wanted.set_point_rad_s)
        if reason := self._why_refused(command, set_point):
            self._add(REFUSED, reason)
        elif all(map(math.isnan, command + set_point)):
            pass
        elif reason := self._source.send(command, set_point):
            self._add(LOST, f"{self._source.name}: {down_reason}" if down_reason else reason)
        else:
            self.counts[SENT] += 1

    def notes(self) -> list[str]:
        """Lines on commands that were not sent, one for each counter, with the reason of the last one."""
        found: list[str] = []
        for counter, reason in self._reasons.items():
            count = self.counts[counter]
            commands = f"{count} command{'s' * (count > 1)} {_NOT_SENT[counter]}"
            found.append(f"{commands}: {reason}" if count == 1 else f"{commands}, the last one: {reason}")
        return found

    def _add(self, counter: str, reason: str) -> None:
        self.counts[counter] += 1
        self._reasons[counter] = reason

    def _why_refused(self, command: tuple[float, ...], set_point: tuple[float, ...]) -> str:
        tray = self._tray
        if reason := tray.source.why_no_commands:
            return f"the tray takes no commands ({reason})"
        for values in (command, set_point):
            if len(values) not in (0, tray.fans):
                return f"it is for {len(values)} fans, the tray has {tray.fans}"
        for what, values, low, high, unit in (
            ("command", command, tray.command_min, tray.command_max, ""),
            ("set-point", set_point, -tray.speed_max, tray.speed_max, f" {tray.speed_unit}"),
        ):
            for fan, value in enumerate(values):
                if not (math.isnan(value) or within(value, low, high)):
                    return f"the {what} of {tray.label(fan)} is {value:g}{unit}, outside {low:g} to {high:g}{unit}"
        return ""

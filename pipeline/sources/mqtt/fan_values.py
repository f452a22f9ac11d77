"""Single values of a tray's fans that arrive one by one, put together to readings of the tray."""

from __future__ import annotations

import math
from typing import Any

from fantwin.pipeline.sources.source import Reading


class FanValues:
    """The values of a tray's fans.

    A command is held until the next one; that of a fan that is switched off is 0. A reading is complete when each fan
    has a new speed; if a fan gives the next one before all others have theirs, the reading ends without these: they
    have none in it. So a fan that is silent does not keep the others.
    """

    def __init__(self, fans: int, *, has_switch: bool = False) -> None:
        """has_switch: whether it is said of each fan if it is on."""
        self._level: list[float | None] = [None] * fans
        self._is_on: list[bool | None] = [None if has_switch else True] * fans
        """None in either: nothing was heard"""
        self._speed: list[float | None] = [None] * fans
        """speeds of the reading that is not complete; None: no new one yet"""

    @property
    def lacks_commands(self) -> bool:
        """Return whether nothing was heard of the command of a fan: then there are no readings."""
        return None in self._commands()

    def set_command(self, fan: int, command: float) -> Reading | None:
        """The command of a fan from now on, NaN: not known; the reading that this ends, if speeds of before wait."""
        return self._set(self._level, fan, command)

    def set_switch(self, fan: int, is_on: bool) -> Reading | None:
        """Whether a fan is switched on from now on; the reading that this ends."""
        return self._set(self._is_on, fan, is_on)

    def set_speed(self, fan: int, speed: float) -> list[Reading]:
        """The next speed of a fan; the readings that it ends or completes."""
        commands = self._commands()
        readings = [self._end(commands)] if self._speed[fan] is not None else []
        self._speed[fan] = speed
        if None not in self._speed:
            readings.append(self._end(commands))
        return [reading for reading in readings if reading is not None]

    def _set(self, values: list[Any], fan: int, value: float | bool) -> Reading | None:
        before = self._commands()
        values[fan] = value
        now, was = self._commands()[fan], before[fan]
        if now == was or (now is not None and was is not None and math.isnan(now) and math.isnan(was)):
            return None
        return self._end(before) if any(speed is not None for speed in self._speed) else None

    def _commands(self) -> list[float | None]:
        """The command of each fan in force."""
        return [
            0.0 if is_on is False else level if is_on else None
            for level, is_on in zip(self._level, self._is_on, strict=True)
        ]

    def _end(self, commands: list[float | None]) -> Reading | None:
        speeds = tuple(math.nan if speed is None else speed for speed in self._speed)
        self._speed = [None] * len(self._speed)
        known = tuple(command for command in commands if command is not None)
        return Reading(known, speeds) if len(known) == len(commands) else None

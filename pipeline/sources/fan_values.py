"""Single numbers of fans that arrive one by one, put together to readings of a tray.

A command is held until the next one. A reading is complete when each fan has a new speed; if a fan gives the next one
before all others have theirs, the reading ends without these: they have none in it. So a fan that is silent does not
keep the others.
"""

from __future__ import annotations

import math

from fantwin.pipeline.sources.source import Reading


class FanValues:
    """The newest numbers of a tray's fans."""

    def __init__(self, fans: int) -> None:
        self._command = [math.nan] * fans
        self._speed: list[float | None] = [None] * fans
        """speeds of the reading that is not complete; None: no new one yet"""

    @property
    def lacks_commands(self) -> bool:
        """Return whether the command of a fan is not known yet: then there are no readings."""
        return any(map(math.isnan, self._command))

    def set_command(self, fan: int, command: float) -> Reading | None:
        """The command of a fan from now on; the reading that this ends, if speeds of before wait."""
        if command == self._command[fan]:
            return None
        ended = self._end() if any(speed is not None for speed in self._speed) else None
        self._command[fan] = command
        return ended

    def set_speed(self, fan: int, speed: float) -> list[Reading]:
        """The next speed of a fan; the readings that it ends or completes."""
        readings = [self._end()] if self._speed[fan] is not None else []
        self._speed[fan] = speed
        if all(speed is not None for speed in self._speed):
            readings.append(self._end())
        return [reading for reading in readings if reading is not None]

    def _end(self) -> Reading | None:
        speeds = tuple(math.nan if speed is None else speed for speed in self._speed)
        self._speed = [None] * len(self._speed)
        return None if self.lacks_commands else Reading(tuple(self._command), speeds)

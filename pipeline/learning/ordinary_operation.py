"""What the plant's own controller does with the fans, and whether it is enough for a twin to be trained on it.

A twin needs to see each fan settle at several commands, and change between them. The thresholds are those of a short
sweep: it holds ten levels for some seconds each.
"""

from __future__ import annotations

import numpy as np

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.schemas.health import FanLearning
from fantwin.schemas.messages import Raw
from fantwin.schemas.units import NS_PER_S

RANGES = 10
"""equal parts of the commands of a tray"""
NEEDED_RANGES, NEEDED_S = 4, 20.0
"""the command of each fan must have been in so many of these, for so long each"""
NEEDED_CHANGES = 10
"""of the command of each fan, each by more than the width of such a part"""
LONGEST_BETWEEN_SAMPLES_NS = 3 * NS_PER_S
"""a longer time is a gap, in which nothing is known"""


class OrdinaryOperation:
    """The commands of a tray's fans so far."""

    def __init__(self, tray: TrayConfig) -> None:
        self.names = tray.names
        self._range = f"{tray.command_min:g} to {tray.command_max:g}"
        self._low, self._width = tray.command_min, (tray.command_max - tray.command_min) / RANGES
        self._seconds = np.zeros((tray.fans, RANGES))
        self._changes = np.zeros(tray.fans, np.int64)
        self._changed_from = np.full(tray.fans, np.nan)
        self._lowest, self._highest = np.full(tray.fans, np.inf), np.full(tray.fans, -np.inf)
        self._last_t_ns: int | None = None
        takes_commands = not tray.source.why_no_commands
        self.how_to_move = (
            "`fantwin command --sweep` moves the fans"
            if takes_commands
            else "the fans' own controller must vary their commands"
        )
        """how the fans can be moved, for messages to people"""

    def take(self, raw: Raw) -> None:
        """Take samples, in the order in which they were received."""
        fan = np.arange(raw.fans)
        for t_ns, command in zip(raw.host_receive_t_ns.tolist(), raw.command, strict=True):
            since_ns = 0 if self._last_t_ns is None else t_ns - self._last_t_ns
            self._last_t_ns = t_ns
            known = np.isfinite(command)
            place = np.clip((np.where(known, command, self._low) - self._low) / self._width, 0, RANGES - 1).astype(int)
            if 0 < since_ns <= LONGEST_BETWEEN_SAMPLES_NS:
                self._seconds[fan, place] += np.where(known, since_ns / NS_PER_S, 0.0)
            has_changed = known & ~(np.abs(command - self._changed_from) <= self._width)
            self._changes += has_changed & np.isfinite(self._changed_from)
            self._changed_from = np.where(has_changed, command, self._changed_from)
            self._lowest = np.fmin(self._lowest, command)
            self._highest = np.fmax(self._highest, command)

    def missing(self) -> list[str]:
        """What each fan has not done yet, a few words for each that lacks something."""
        return [f"{self.names.label(fan)}: {each.missing}" for fan, each in enumerate(self.done()) if each.missing]

    def done(self) -> list[FanLearning]:
        """How much of what is needed each fan has done, and what it has not done yet."""
        visited = (self._seconds >= NEEDED_S).sum(axis=1).tolist()
        return [
            FanLearning(
                progress=min(of / NEEDED_RANGES, moved / NEEDED_CHANGES, 1.0), missing=self._missing(fan, of, moved)
            )
            for fan, (of, moved) in enumerate(zip(visited, self._changes.tolist(), strict=True))
        ]

    def _missing(self, fan: int, visited: int, changes: int) -> str:
        levels, moves = NEEDED_RANGES - visited, NEEDED_CHANGES - changes
        more = [f"{NEEDED_S:.0f} s at each of {levels} more level{'s' * (levels > 1)}"] if levels > 0 else []
        more += [f"{moves} more change{'s' * (moves > 1)} by a tenth of {self._range}"] if moves > 0 else []
        return f"{self._range_of(fan)} so far, still {' and '.join(more)}" if more else ""

    def held(self) -> list[str]:
        """Which fans never changed their command by more than a tenth of the range, a few words for each."""
        still = np.flatnonzero(self._changes == 0).tolist()
        return [f"{self.names.label(fan)}: {self._range_of(fan)}" for fan in still]

    def _range_of(self, fan: int) -> str:
        low, high = self._lowest[fan], self._highest[fan]
        if not np.isfinite(low):
            return "no command"
        return f"command {low:.3g}" if low == high else f"commands {low:.3g} to {high:.3g}"

"""The trace of the board's pins that the simulator writes (VCD): tacho edges, duties, and what is blocked."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fantwin.schemas.messages import Array

PULSES = 2


@dataclass(frozen=True)
class PinTrace:
    """What was on the pins, by fan. Times are seconds since the chip started."""

    falling_s: list[Array]
    """when a pulse of the tacho began"""
    duty_t_s: list[Array]
    duty: list[Array]
    """0 to 1, from the time beside it on"""
    blocked_s: list[Array]
    """when the rotor was blocked"""

    def speed_rad_s(self, fan: int, t_s: Array) -> Array:
        """The mean speed over the last whole revolution before each time; NaN before the first."""
        falling_s = self.falling_s[fan]
        last = np.searchsorted(falling_s, t_s, side="right") - 1
        speed = np.full(len(t_s), np.nan)
        whole = last >= PULSES
        speed[whole] = 2.0 * np.pi / (falling_s[last[whole]] - falling_s[last[whole] - PULSES])
        return speed

    def duty_at(self, fan: int, t_s: Array) -> Array:
        """The duty at each time."""
        return self.duty[fan][np.searchsorted(self.duty_t_s[fan], t_s, side="right") - 1]


def read_pin_trace(path: Path, fans: int) -> PinTrace:
    """Read the file of `simulator --vcd`."""
    names: dict[str, str] = {}
    seen: dict[str, list[tuple[float, int]]] = {}
    t_s = unit_s = 0.0
    for line in path.read_text().splitlines():
        words = line.split()
        if line.startswith("#"):
            t_s = int(line[1:]) * unit_s
        elif line.startswith("$timescale"):
            assert words[1] == "10ns"
            unit_s = 1e-8
        elif line.startswith("$var"):
            names[words[3]] = words[4]
            seen[words[4]] = []
        elif line.startswith("b") and "x" not in line:
            seen[names[words[1]]].append((t_s, int(words[0][1:], 2)))
        elif line and line[0] in "01":
            seen[names[line[1:].strip()]].append((t_s, int(line[0])))

    def changes(name: str, value: int) -> Array:
        return np.array([t for t, v in seen[name] if v == value])

    return PinTrace(
        [changes(f"tacho{fan}", 0) for fan in range(fans)],
        [np.array([t for t, _ in seen[f"duty{fan}"]]) for fan in range(fans)],
        [np.array([v / 1000.0 for _, v in seen[f"duty{fan}"]]) for fan in range(fans)],
        [changes(f"blocked{fan}", 1) for fan in range(fans)],
    )

"""Fans of a simple law, for tests of commands that excite them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fantwin.pipeline.learning.sweep_steps import Observed

PERIOD_S = 0.1


class FirstOrderFans:
    """Fans whose speed follows the command with a time constant; reported at 10 Hz with noise."""

    def __init__(self, time_constants_s: list[float], top_rad_s: float = 300.0, stop_after_s: float = np.inf) -> None:
        self.tau_s = np.array(time_constants_s)
        self.top_rad_s = np.full(len(time_constants_s), top_rad_s)
        self.command = np.full(len(time_constants_s), 0.4)
        self.speed = self.top_rad_s * self.command
        self.now_s, self.stop_after_s = 0.0, stop_after_s
        self.sent: list[tuple[float, dict[int, float]]] = []
        self.forced: float | None = None
        self._rng = np.random.default_rng(1)
        self._rows: list[tuple[float, np.ndarray, np.ndarray]] = []
        self._sample()

    def send(self, values: Mapping[int, float]) -> None:
        self.sent.append((self.now_s, dict(values)))
        for fan, value in values.items():
            self.command[fan] = value
        self._rows = self._rows[-1:]

    def observed(self) -> Observed:
        t_s, command, speed = zip(*self._rows, strict=True)
        return Observed(np.array(t_s) - t_s[0], np.array(command), np.array(speed))

    def wait(self, seconds: float) -> bool:
        for _ in range(round(seconds / PERIOD_S)):
            self.now_s += PERIOD_S
            self.speed += (self.top_rad_s * self.command - self.speed) * (1 - np.exp(-PERIOD_S / self.tau_s))
            self._sample()
        return self.now_s >= self.stop_after_s

    def _sample(self) -> None:
        command = self.command.copy() if self.forced is None else np.full_like(self.command, self.forced)
        self._rows.append((self.now_s, command, self.speed + self._rng.normal(0.0, 2.0, len(self.speed))))

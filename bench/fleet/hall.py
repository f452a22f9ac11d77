"""A data hall made beforehand: rough fans in large trays whose command moves every few seconds, some with a fault.

The run of a fan is periodic, so it can be sent for as long as one likes. Fans differ by where in it they are, and by
their noise. A fault is a loss of speed.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from bench.training.published_fan import NOISE_RAD_S, RATE_HZ, rough_fans
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Array, Raw
from fantwin.schemas.units import NS_PER_S

SITE, PRODUCER = "fleet", "feed-1"
PERIOD_S = 60.0
DISTINCT = 20
"""fans that are simulated; all others are one of them, later in the run"""
LEVELS, HELD_S = (30.0, 90.0), (4.0, 15.0)
SPEED_LOSS, FAULT_S = 0.15, 20.0
PERIOD_NS = NS_PER_S // round(RATE_HZ)


@dataclass(frozen=True)
class HallFault:
    """A fan that loses speed for a while; start_s: since the first sample."""

    tray: int
    fan: int
    start_s: float

    def covers(self, t_s: float) -> bool:
        """Whether the fan has it at a time since the first sample, s."""
        return self.start_s <= t_s < self.start_s + FAULT_S


class Hall:
    """All trays, and what each sends in each message."""

    def __init__(self, fans: int, fans_of_tray: int, block_s: float, seed: int = 1) -> None:
        """fans: of the hall. block_s: length of a message."""
        self.trays = -(-fans // fans_of_tray)
        self.fans_of_tray = -(-fans // self.trays)
        self.block = round(block_s * RATE_HZ)
        rng = np.random.default_rng([seed, 2])
        command, speed_rad_s = _periodic_runs(rng)
        later = rng.integers(0, len(command), self.fans_of_tray)
        rows = (np.arange(len(command))[:, np.newaxis] + later) % len(command)
        which = np.arange(self.fans_of_tray) % DISTINCT
        self._command = np.ascontiguousarray(command[rows, which])
        self._speed_rad_s = speed_rad_s[rows, which] + rng.normal(0.0, NOISE_RAD_S, rows.shape)

    @property
    def names(self) -> list[str]:
        """Of the trays."""
        return [f"tray{number}" for number in range(1, self.trays + 1)]

    @property
    def fans(self) -> int:
        """Of all trays."""
        return self.trays * self.fans_of_tray

    def faults(self, number: int, first_s: float, last_s: float, seed: int = 1) -> list[HallFault]:
        """So many, of different fans, that begin at equal distances from the first time to the last."""
        rng = np.random.default_rng([seed, 3])
        chosen = rng.choice(self.fans, number, replace=False).tolist()
        starts_s = np.linspace(first_s, last_s, number).tolist()
        places = [divmod(fan, self.fans_of_tray) for fan in chosen]
        return [HallFault(tray, fan, start_s) for (tray, fan), start_s in zip(places, starts_s, strict=True)]

    def messages(self, epoch_ns: int, faults: list[HallFault]) -> Iterator[list[Raw]]:
        """The messages of all trays, one of each at a time, without end."""
        period = len(self._command)
        number = 0
        while True:
            samples = number * self.block + np.arange(self.block)
            t_s = float(samples[0]) / RATE_HZ
            present = [fault for fault in faults if fault.covers(t_s)]
            yield [self._message(tray, number, samples, period, epoch_ns, present) for tray in range(self.trays)]
            number += 1

    def _message(
        self, tray: int, number: int, samples: Array, period: int, epoch_ns: int, present: list[HallFault]
    ) -> Raw:
        rows = (samples + tray * period // self.trays) % period
        speed_rad_s = self._speed_rad_s[rows]
        for fault in present:
            if fault.tray == tray:
                speed_rad_s[:, fault.fan] *= 1.0 - SPEED_LOSS
        return Raw(
            header=Header(PRODUCER, number, self.names[tray]),
            fans=self.fans_of_tray,
            host_receive_t_ns=epoch_ns + samples * PERIOD_NS,
            device_clock_us=(samples * (PERIOD_NS // 1000)).astype(np.uint32),
            device_sequence=samples.astype(np.uint32),
            command=self._command[rows],
            speed_rad_s=speed_rad_s,
        )


def _periodic_runs(rng: np.random.Generator) -> tuple[Array, Array]:
    """(n, DISTINCT) commands, and speeds without noise, whose end goes on to their beginning."""
    samples = round(PERIOD_S * RATE_HZ)
    command = np.empty((samples, DISTINCT))
    for fan in range(DISTINCT):
        holds = rng.integers(*(round(held_s * RATE_HZ) for held_s in HELD_S), size=samples)
        command[:, fan] = np.repeat(rng.uniform(*LEVELS, size=samples), holds)[:samples]
    return command, rough_fans(np.tile(command, (2, 1)))[samples:]

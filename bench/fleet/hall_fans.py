"""Fans of a hall of servers, simulated beforehand: what their controllers command and show at any time.

Two 4-pin fans of a server share a duty, in whole per cent. A controller sets it once a second by the temperature of its
processors, whose load jumps every 15 s to 10 min, and leaves it alone below a change of 2 %. It shows the mean speed
over a second, once a second, rounded to 10 rpm; when within a second is different for each. Fans differ by 3 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fantwin.schemas.messages import Array
from fantwin.simulation.four_pin import RPM, VARYING_PARAMETERS, FourPinDamage, FourPinFans, FourPinParameters
from fantwin.simulation.plant import varied

FANS = 2
"""fans of a server"""
STEP_S, SHOWN_S = 0.05, 1.0
STEP_RPM, FIRST_RPM = 10.0, 6_000.0
FAN = FourPinParameters(
    speed_max_rad_s=15_000.0 * RPM,
    speed_min_rad_s=2_500.0 * RPM,
    duty_min=0.15,
    duty_stop=0.02,
    kick_speed_rad_s=6_000.0 * RPM,
    up_s=0.9,
    down_s=1.4,
)
VARIATION = 0.03
CONTROLLED_C, WARMS_S = 68.0, 45.0
IDLE_C, LOAD_C = 40.0, 60.0
LEAST, LEAST_MOVE = 25.0, 2.0
"""per cent"""
LOAD_S = (15.0, 600.0)
CLOG_S = 180.0


class HallFault(NamedTuple):
    """A fan of a server that loses a share of its speed: at once, or growing within CLOG_S; 1: it cannot turn."""

    server: int
    fan: int
    start_s: float
    share: float
    grows: bool = False

    def loss(self, t_s: float) -> float:
        """The share that is lost at a time."""
        return self.share * min(1.0, max(0.0, t_s - self.start_s) / (CLOG_S if self.grows else STEP_S))


class HallFans:
    """Duty (n, servers), per cent, and shown speed (n, fans), rpm, each STEP_S."""

    def __init__(self, servers: int, seconds: float, seed: int, faults: Sequence[HallFault] = ()) -> None:
        """The fans are the same for every seed."""
        rng = np.random.default_rng([seed, 1])
        fans = FANS * servers
        plant = FourPinFans(varied(FAN, VARYING_PARAMETERS, fans, 1, VARIATION), np.random.default_rng([seed, 2]), FANS)
        plant.speed_rad_s = np.full(fans, FIRST_RPM * RPM)  # the hall has been running
        duty = integral = np.full(servers, 40.0)
        load_c, load = np.full(servers, 50.0), rng.random(servers)
        jumps_s, controls_s, shows_s = rng.uniform(5.0, 300.0, servers), rng.random(servers), rng.random(fans)
        shown, last = np.full(fans, FIRST_RPM), np.full((round(1.0 / STEP_S), fans), FIRST_RPM)
        steps = round(seconds / STEP_S)
        self.duty, self.rpm = np.zeros((steps, servers), np.float32), np.zeros((steps, fans), np.float32)
        for step in range(steps):
            t_s = step * STEP_S
            jumps = t_s >= jumps_s
            load = np.where(jumps, rng.random(servers), load)
            jumps_s = np.where(jumps, t_s + LOAD_S[0] * (LOAD_S[1] / LOAD_S[0]) ** rng.random(servers), jumps_s)
            load_c += STEP_S / WARMS_S * (IDLE_C + LOAD_C * load / (0.4 + duty / 100.0) - load_c)
            controls = t_s >= controls_s
            controls_s += controls
            off_c = load_c - CONTROLLED_C + rng.normal(0.0, 0.3, servers)
            integral = np.where(controls, np.clip(integral + 0.05 * off_c, LEAST, 100.0), integral)
            wanted = np.round(np.clip(integral + off_c, LEAST, 100.0))
            duty = np.where(controls & (np.abs(wanted - duty) >= LEAST_MOVE), wanted, duty)
            plant.damage = _damage(faults, fans, t_s)
            plant.advance(np.repeat(duty, FANS) / 100.0, STEP_S)
            last[step % len(last)] = plant.speed_rad_s / RPM
            shows = t_s >= shows_s
            shows_s += shows * SHOWN_S
            shown = np.where(shows, np.round(last.mean(axis=0) / STEP_RPM) * STEP_RPM, shown)
            self.duty[step], self.rpm[step] = duty, shown

    def at(self, server: int, t_s: float) -> list[tuple[float, float]]:
        """Duty and shown speed of each fan of a server at a time since the beginning; at most that of the end."""
        step = min(max(int(t_s / STEP_S), 0), len(self.duty) - 1)
        duty = float(self.duty[step, server])
        return [(duty, rpm) for rpm in self.rpm[step, FANS * server : FANS * (server + 1)].tolist()]


def _damage(faults: Sequence[HallFault], fans: int, t_s: float) -> FourPinDamage:
    factor: Array = np.ones(fans)
    for fault in faults:
        factor[FANS * fault.server + fault.fan] *= 1.0 - fault.loss(t_s)
    return FourPinDamage(speed_factor=factor, is_blocked=factor <= 0.0)

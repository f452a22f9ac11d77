"""The simulated fans of the campaigns: the same trays in many runs at once, a column for each fan of each run.

All columns are advanced together, so that a row of a thousand costs little more than one of eight; blocks are made when
they are asked for, and none is kept. Raw samples come out, tray by tray, as devices would send them.

Days differ: air density, and the aerodynamic drag with it, has another level in each run (standard deviation 1 %: 8 hPa
and 2 K) and goes up and down by 0.7 % over 24 h (2 K). Fans differ by 3 % in each of their parameters.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np

from bench.detection.knobs import Knobs
from fantwin.schemas.messages import Array, Raw
from fantwin.simulation.plant import Disturbance, FanParameters, advance, at_rest
from fantwin.simulation.tacho import NoisyTacho
from fantwin.simulation.tray import LOOP_GAIN, LOOP_INTEGRAL_GAIN_PER_S

RATE_HZ = 100.0
STEP_NS = 10_000_000
BLOCK = 512
START_NS = 1_700_000_000_000_000_000
TRAY_FANS = 50
DENSITY_BETWEEN_RUNS = 0.010
DENSITY_OVER_A_DAY = 0.007
DAY_S = 86_400.0


@dataclass(frozen=True)
class Faults:
    """At most one for each column, (c,) each. kind: its name, empty for none. size: see severities."""

    kind: Array
    size: Array
    start_s: Array
    stop_s: Array


class Plant:
    """The same fans in several runs, each on a different day."""

    def __init__(
        self,
        fans: FanParameters,
        runs: int,
        knobs: Knobs,
        seed: int,
        faults: Faults | None = None,
        *,
        days: bool = True,
    ) -> None:
        """Prepare.

        fans: parameters, (fans,) each, whole trays of TRAY_FANS. knobs, faults: of the columns, run by run. days:
        whether days differ; without, the air is that for which the parameters hold.
        """
        self._runs = runs
        self._fans = len(np.asarray(fans.J))
        self._columns = self._fans * runs
        self._parameters = tiled(fans, runs)
        self._knobs = knobs
        self._faults = faults
        self._trays = [slice(first, first + TRAY_FANS) for first in range(0, self._columns, TRAY_FANS)]
        noise, weather = np.random.default_rng(seed).spawn(2)
        self._noise = noise
        self._days = 1.0 if days else 0.0
        self._density = DENSITY_BETWEEN_RUNS * weather.normal(size=runs)
        self._phase = weather.uniform(0.0, 2.0 * np.pi, size=runs)
        self._tacho = NoisyTacho()
        self._reading = np.zeros(self._columns)
        self._integral = np.zeros(self._columns)

    def blocks(self, seconds: float) -> Iterator[list[Raw]]:
        """Raw samples of every tray of the first run, of the second, and so on; block by block."""
        state, rows = at_rest(self._columns), round(seconds * RATE_HZ)
        for first in range(0, rows, BLOCK):
            count = min(BLOCK, rows - first)
            speed, command = np.empty((count, self._columns)), np.empty((count, self._columns))
            density = self._drag_of_the_air(first / RATE_HZ)
            for row in range(count):
                t_s = (first + row) / RATE_HZ
                active = self._active(t_s)
                speed[row] = self._read(state.speed_rad_s, active)
                command[row] = self._decide(t_s, speed[row])
                disturbance = self._disturbance(t_s, density, active)
                state = advance(state, command[row], 1.0 / RATE_HZ, self._parameters, disturbance)
            t_ns = START_NS + STEP_NS * np.arange(first, first + count)
            yield [
                Raw(fans=TRAY_FANS, host_receive_t_ns=t_ns, command=command[:, tray], speed_rad_s=speed[:, tray])
                for tray in self._trays
            ]

    def _drag_of_the_air(self, t_s: float) -> Array:
        daily = DENSITY_OVER_A_DAY * np.sin(2.0 * np.pi * t_s / DAY_S + self._phase)
        return np.repeat(1.0 + self._days * (self._density + daily), self._fans)

    def _active(self, t_s: float) -> Array | None:
        if self._faults is None:
            return None
        return (self._faults.start_s <= t_s) & (t_s < self._faults.stop_s)

    def _read(self, speed_rad_s: Array, active: Array | None) -> Array:
        """The tacho readings; NaN where there is none."""
        faults = self._faults
        if faults is None or active is None:
            return self._tacho.read(speed_rad_s, self._noise)
        missing = self._noise.random(self._columns) < faults.size
        scaled = np.where(active & (faults.kind == "tacho-scaling"), faults.size, 1.0)
        fresh = self._tacho.read(speed_rad_s * scaled, self._noise)
        self._reading = np.where(active & (faults.kind == "tacho-stuck"), self._reading, fresh)
        return np.where(active & (faults.kind == "tacho-dropout") & missing, np.nan, self._reading)

    def _disturbance(self, t_s: float, density: Array, active: Array | None) -> Disturbance:
        faults = self._faults
        if faults is None or active is None or not active.any():
            return Disturbance(drag_factor=density)
        grown = (t_s - faults.start_s) / (faults.stop_s - faults.start_s)
        on_drag = active & ((faults.kind == "inlet") | (faults.kind == "blade"))
        brake = np.where(active & (faults.kind == "rotor"), faults.size, 0.0)
        brake = np.where(active & (faults.kind == "wear"), faults.size * grown, brake)
        return Disturbance(
            drag_factor=density * np.where(on_drag, faults.size, 1.0),
            brake_v=brake,
            supply_factor=np.where(active & (faults.kind == "supply"), faults.size, 1.0),
        )

    def _decide(self, t_s: float, reading_rad_s: Array) -> Array:
        """(c,) duty: of the profile, or of the device's own speed loop, as in simulation.tray."""
        wanted = self._knobs.at(t_s)
        looped = self._knobs.is_looped
        error_rad_s = np.where(looped, np.nan_to_num(wanted - reading_rad_s), 0.0)
        proportional = LOOP_GAIN * error_rad_s
        given = proportional + self._integral + LOOP_INTEGRAL_GAIN_PER_S / RATE_HZ * error_rad_s
        possible = np.clip(given, 0.0, 1.0)
        self._integral = possible - proportional  # what cannot be given is not remembered: no wind-up
        return np.where(looped, possible, wanted)


def tiled(fans: FanParameters, runs: int) -> FanParameters:
    """The parameters of the columns."""
    return FanParameters(**{f.name: np.tile(getattr(fans, f.name), runs) for f in fields(FanParameters)})

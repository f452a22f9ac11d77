"""Simulated racks of 4-pin fans with counting tachos under a thermostat, all racks at once, and their faults.

Each rack is a run of its own, with four fans; two of their tachos count over 1 s and two over 0.5 s. All racks are
advanced together, a column for each fan, in steps of 0.1 s (the fans' lags are exact within them, and the ends of
windows are taken where they fall); reports are then made at their own rate, so that the same seed gives the same fans,
commands and counts at each rate. Lines are lost, arrive late, and lack readings, as on a microcontroller's line.

Faulty racks have each kind of fault once: a day is six equal parts, a part has one fault of one fan, which begins while
the fan is on and lasts for a quarter of the part; the last part of a fault and the next one are hours apart.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from bench.detection.metrics import Event
from bench.detection.plant import START_NS
from fantwin.pipeline.learning.sweep_steps import LEVELS, SHORT_LEVELS, levels_of
from fantwin.schemas.messages import Array, Raw
from fantwin.schemas.tacho import Tacho
from fantwin.schemas.units import NS_PER_S
from fantwin.simulation.excitation import UPDATES_HZ, Thermostat
from fantwin.simulation.faults import CLOG_S, Fault, four_pin_damage
from fantwin.simulation.four_pin import FourPinFans, FourPinParameters, four_pin_tray
from fantwin.simulation.tacho import CountingTacho

TACHOS = tuple(Tacho(kind="count", window_s=window_s) for window_s in (1.0, 1.0, 0.5, 0.5))
"""of the fans of a rack"""
RACK_FANS = len(TACHOS)
RATES_HZ = (2.0, 10.0, 100.0)
DAY_S = 86_400.0
FANS_SEED = 11
DUTIES = (0.15, 1.0)
STEP_S = 0.1
BLOCK = 500
LOST_LINES = 0.003
MISSING_READINGS = 0.002
LATE_S = 0.004
"""lines arrive up to so much after they were measured"""

FAULT_KINDS = {
    "clog": "drag_up",
    "blocked": "blocked",
    "blade": "external_torque",
    "tacho-dropout": "sensor_dropout",
    "bearing": "friction_up",
    "no-power": "no_power",
}
"""and the cause that an alarm should name"""
SIZES = {"clog": 0.06, "blade": 0.10, "tacho-dropout": 0.35, "bearing": 0.03}
FAULT_BEGINS = (0.1, 0.5)
"""share of its part of the day after which a fault begins"""
FAULT_LASTS = 0.25
"""share of its part of the day"""
SETTLED_S, SHORT_S = 8.0, 2.0
"""how long a sweep holds its levels: until the fans have settled, and so that they never do"""
ON_BEFORE_S, ON_AFTER_S = 10.0, 60.0
"""the fan is on for so long around the beginning of its fault"""


AGED_EVERY_S = 600.0
"""how often the speeds change with ageing"""
Ageing: TypeAlias = Callable[[float], Array]
"""(columns,) factor on the speed of each fan at a time in seconds"""


class RackThermostat(Thermostat):
    """Its commands at many times at once."""

    def side_by_side(self, starts_s: Sequence[float], seconds: float) -> RackThermostat:
        """A thermostat of as many times the fans, which have the commands from each of these times on, for a time."""
        found = copy(self)
        numbers = np.arange(round(seconds * UPDATES_HZ))
        parts = [self._steps[(round(start_s * UPDATES_HZ) + numbers) % len(self._steps)] for start_s in starts_s]
        found._steps = np.concatenate(parts, axis=1)
        return found

    def is_on(self, times_s: Array, fan: int) -> NDArray[np.bool_]:
        """Whether a fan has a duty at times; same shape."""
        return self._steps[(times_s * UPDATES_HZ + 1e-6).astype(np.int64) % len(self._steps), fan] > 0


@dataclass(frozen=True)
class Racks:
    """Racks of fans, and the commands of their runs. Each field of parameters: (columns,), rack by rack."""

    parameters: FourPinParameters
    thermostat: RackThermostat
    seconds: float
    seed: int
    copies: int = 1
    """the racks are so many times the same ones, as at different times"""

    @property
    def columns(self) -> int:
        """How many fans there are."""
        return len(np.asarray(self.parameters.speed_max_rad_s))

    @property
    def count(self) -> int:
        """How many racks there are."""
        return self.columns // RACK_FANS


def racks(count: int, seconds: float, seed: int, fans_seed: int = FANS_SEED) -> Racks:
    """So many racks for a time. The same fans_seed gives the same fans, the same seed the same commands and chances."""
    columns = count * RACK_FANS
    thermostat = RackThermostat(columns, seed, *DUTIES, period_s=seconds)
    return Racks(four_pin_tray(columns, fans_seed), thermostat, seconds, seed)


def run_of(rack: int) -> str:
    """The name of the run of a rack, counted from 0."""
    return f"rack{rack + 1}"


def fault_schedule(of: Racks) -> list[Fault]:
    """Each kind once in each rack, in random order on fans in turn; a fault's `fan` is its column.

    Raises:
        ValueError: a fan is never on for long enough; a day leaves room, some minutes may not.
    """
    rng = np.random.default_rng([of.seed, 1])
    part_s = of.seconds / len(FAULT_KINDS)
    return [
        _fault(of, kind, rack * RACK_FANS + int(fan), part * part_s, part_s, rng)
        for rack in range(of.count)
        for part, (kind, fan) in enumerate(
            zip(
                rng.permutation(list(FAULT_KINDS)).tolist(),
                np.resize(rng.permutation(RACK_FANS), len(FAULT_KINDS)).tolist(),
                strict=True,
            )
        )
    ]


def events(faults: list[Fault]) -> list[Event]:
    """The truth about a schedule of racks of RACK_FANS."""
    return [
        Event(
            run_of(fault.fan // RACK_FANS),
            fault.fan % RACK_FANS,
            START_NS + round(fault.start_s * NS_PER_S),
            START_NS + round(fault.stop_s * NS_PER_S),
            fault.kind,
            FAULT_KINDS[fault.kind],
        )
        for fault in faults
    ]


def swept_duty(t_s: float) -> Array:
    """(RACK_FANS,) of a rack under `fantwin command --sweep`, from 0 to 1: its levels, held long and short in turn."""
    into_s = t_s % (len(LEVELS) * SETTLED_S + len(SHORT_LEVELS) * SHORT_S)
    held = int(into_s / SETTLED_S)
    levels, step = LEVELS, held
    if held >= len(LEVELS):
        levels, step = SHORT_LEVELS, int((into_s - len(LEVELS) * SETTLED_S) / SHORT_S)
    return np.array([levels_of(levels, fan)[step] for fan in range(RACK_FANS)])


def reports(
    of: Racks,
    rate_hz: float,
    faults: list[Fault] | None = None,
    *,
    is_swept: bool = False,
    ageing: Ageing | None = None,
) -> Iterator[list[Raw]]:
    """The samples of each rack, block by block, as its device sends them.

    rate_hz: one of RATES_HZ. is_swept: under `swept_duty` instead of the thermostat. ageing: slow changes that are no
    faults of the schedule.
    """
    simulation = RackSimulation(of, faults or [], ageing, is_swept=is_swept)
    chance = np.random.default_rng([of.seed, 3, round(rate_hz)])
    rows, sent = round(of.seconds * rate_hz), 0
    while sent < rows:
        count = min(BLOCK, rows - sent)
        number = np.arange(sent, sent + count)
        yield lines(*simulation.until(number / rate_hz), number / rate_hz, number, chance)
        sent += count


class RackSimulation:
    """Fans and tachos as time goes on."""

    def __init__(self, of: Racks, faults: list[Fault], ageing: Ageing | None, *, is_swept: bool) -> None:
        self._of = of
        self._ageing = ageing
        self._aged_until_s = 0.0
        self._is_swept = is_swept
        self._faults = faults
        self._fans = FourPinFans(of.parameters, np.random.default_rng([of.seed, 2]), RACK_FANS, of.copies)
        self._tacho = CountingTacho(TACHOS * (of.columns // RACK_FANS), 0.0, 0.0, np.random.default_rng([of.seed, 4]))
        self._step = 0
        self._active: list[Fault] = []
        self._next_change_s = 0.0
        self._grows_until_s = 0.0
        self._missing = np.empty(0)

    def until(self, times_s: Array) -> tuple[Array, Array, Array]:
        """(n, columns) duty, reading and share of missing readings at times, which follow the ones before.

        A duty is the one in force from that time on.
        """
        steps = np.floor(times_s / STEP_S + 1e-6).astype(np.int64)
        first, last = self._step, int(steps[-1])
        shape = (last - first + 1, self._of.columns)
        duty, before, after, shown_from_s, missing = (np.empty(shape) for _ in range(5))
        for row in range(shape[0]):
            start_s = self._step * STEP_S
            swept = self._is_swept
            duty[row] = np.resize(swept_duty(start_s), shape[1]) if swept else self._of.thermostat.command(start_s)
            self._set_faults(start_s)
            missing[row] = self._missing
            before[row] = self._tacho.reading_rad_s
            speed = self._fans.speed_rad_s
            self._fans.advance(duty[row], STEP_S)
            self._tacho.turn(start_s, speed, start_s + STEP_S, self._fans.speed_rad_s)
            after[row], shown_from_s[row] = self._tacho.reading_rad_s, self._tacho.shown_from_s
            self._step += 1
        at = steps - first
        reading = np.where(shown_from_s[at] <= times_s[:, np.newaxis], after[at], before[at])
        return duty[at], reading, missing[at]

    def _set_faults(self, t_s: float) -> None:
        """Let the faults act from t_s on, as they do then."""
        if t_s >= self._next_change_s:
            self._active = [fault for fault in self._faults if fault.active(t_s)]
            changes_s = [at_s for fault in self._faults for at_s in (fault.start_s, fault.stop_s) if at_s > t_s]
            self._next_change_s = min(changes_s, default=np.inf)
            self._grows_until_s = max(
                (f.start_s + CLOG_S + STEP_S for f in self._active if f.kind == "clog"), default=t_s
            )
            self._missing = np.full(self._of.columns, MISSING_READINGS)
            for fault in self._active:
                if fault.kind == "tacho-dropout":
                    self._missing[fault.fan] = fault.size_at(t_s)
        elif t_s > self._grows_until_s and (self._ageing is None or t_s < self._aged_until_s):
            return
        damage = four_pin_damage(self._active, self._of.columns, t_s)
        if self._ageing is not None:
            self._aged_until_s = t_s + AGED_EVERY_S
            damage = replace(damage, speed_factor=np.asarray(damage.speed_factor) * self._ageing(t_s))
        self._fans.damage = damage


def lines(
    duty: Array,
    reading: Array,
    missing: Array,
    times_s: Array,
    number: NDArray[np.int64],
    chance: np.random.Generator,
) -> list[Raw]:
    """The lines that arrive, for each rack. duty, reading, missing: (n, columns). times_s, number: (n,) of lines."""
    speed = np.where(chance.random(reading.shape) < missing, np.nan, reading)
    racks_count = reading.shape[1] // RACK_FANS
    arrives = chance.random((racks_count, len(number))) >= LOST_LINES
    late_s = chance.uniform(0.0, LATE_S, size=(racks_count, len(number)))
    clock_us = np.round(times_s * 1e6).astype(np.int64) % 2**32
    made = []
    for rack in range(racks_count):
        rows = np.flatnonzero(arrives[rack])
        fans = slice(rack * RACK_FANS, (rack + 1) * RACK_FANS)
        made.append(
            Raw(
                fans=RACK_FANS,
                host_receive_t_ns=START_NS + np.round((times_s + late_s[rack])[rows] * NS_PER_S).astype(np.int64),
                device_clock_us=clock_us[rows].astype(np.uint32),
                device_sequence=(number[rows] % 2**32).astype(np.uint32),
                command=duty[rows, fans],
                speed_rad_s=speed[rows, fans],
            )
        )
    return made


def _fault(of: Racks, kind: str, column: int, part_start_s: float, part_s: float, rng: np.random.Generator) -> Fault:
    """A fault within a part of the run that begins while the fan is on."""
    earliest_s, latest_s = (part_start_s + share * part_s for share in FAULT_BEGINS)
    candidates_s = np.arange(earliest_s, latest_s, 1.0)
    around_s = np.arange(-ON_BEFORE_S, ON_AFTER_S, 1.0)
    on = of.thermostat.is_on(candidates_s[:, np.newaxis] + around_s, column).all(axis=1)
    if not on.any():
        raise ValueError(
            f"fan {column} is not on for {ON_BEFORE_S + ON_AFTER_S:g} s from {earliest_s:g} to {latest_s:g} s"
        )
    start_s = float(np.round(rng.choice(candidates_s[on]) + rng.uniform(0.0, 1.0), 3))
    return Fault(kind, column, start_s, start_s + FAULT_LASTS * part_s, SIZES.get(kind))

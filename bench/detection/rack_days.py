"""The lines of racks over many days: all days are simulated at the same time, as so many times the same fans.

What a fan does depends on the minute before it, not on the day before. So each day is simulated by itself, from
WARM_UP_S before it on. At midnight only the phases of the tachos and the wandering of the speeds begin again, which
are a count and less. A month of twenty fans takes minutes instead of an hour.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import fields, replace

import numpy as np

from bench.detection.racks import BLOCK, DAY_S, Ageing, Racks, RackSimulation, lines
from fantwin.schemas.messages import Array, Raw
from fantwin.simulation.faults import Fault
from fantwin.simulation.four_pin import FourPinParameters

WARM_UP_S = 60.0
"""longer than the fans need to follow their commands, and their tachos to count"""
DUTY_STEPS = 255


def reports_by_days(
    of: Racks, rate_hz: float, faults: list[Fault], ageing: Ageing, day_done: Callable[[float], None]
) -> Iterator[list[Raw]]:
    """As racks.reports, of whole days. day_done: called with the share of the simulation that is done.

    The period of the air (FourPinParameters.air_period_s) must be a part of a day.
    """
    days = round(of.seconds / DAY_S)
    starts_s = DAY_S * np.arange(days) - WARM_UP_S
    per_day = round(DAY_S * rate_hz)
    simulation = RackSimulation(
        _side_by_side(of, starts_s), _of_days(of, faults, starts_s), _aged(ageing, starts_s), is_swept=False
    )
    duty = np.empty((per_day, days, of.columns), np.uint8)
    reading, missing = np.empty((2, per_day, days, of.columns), np.float32)
    for first in range(0, per_day, BLOCK):
        rows = slice(first, min(first + BLOCK, per_day))
        found = simulation.until(WARM_UP_S + np.arange(rows.start, rows.stop) / rate_hz)
        for stored, values in zip((duty, reading, missing), (found[0] * DUTY_STEPS, *found[1:]), strict=True):
            stored[rows] = (np.round(values) if stored is duty else values).reshape(-1, days, of.columns)
        day_done(rows.stop / per_day)
    chance = np.random.default_rng([of.seed, 3, round(rate_hz)])
    for day in range(days):
        for first in range(0, per_day, BLOCK):
            rows = slice(first, min(first + BLOCK, per_day))
            number = day * per_day + np.arange(rows.start, rows.stop)
            commands, readings = duty[rows, day] / DUTY_STEPS, reading[rows, day].astype(np.float64)
            yield lines(commands, readings, missing[rows, day], number / rate_hz, number, chance)


def _side_by_side(of: Racks, starts_s: Array) -> Racks:
    """The same racks once for each day, columns by day."""
    copies = len(starts_s)
    tiled = {each.name: np.tile(getattr(of.parameters, each.name), copies) for each in fields(FourPinParameters)}
    seconds = DAY_S + WARM_UP_S
    return replace(
        of,
        parameters=FourPinParameters(**tiled),
        thermostat=of.thermostat.side_by_side(starts_s.tolist(), seconds),
        seconds=seconds,
        copies=copies,
    )


def _of_days(of: Racks, faults: list[Fault], starts_s: Array) -> list[Fault]:
    """Each fault on the days that it lasts."""
    return [
        replace(
            fault,
            fan=day * of.columns + fault.fan,
            start_s=fault.start_s - float(start_s),
            stop_s=fault.stop_s - float(start_s),
        )
        for fault in faults
        for day, start_s in enumerate(starts_s)
        if fault.start_s < start_s + WARM_UP_S + DAY_S and fault.stop_s > start_s
    ]


def _aged(ageing: Ageing, starts_s: Array) -> Ageing:
    return lambda t_s: np.concatenate([ageing(max(0.0, float(start_s) + t_s)) for start_s in starts_s])

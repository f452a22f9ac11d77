"""Simulated faults with a known onset: five severities of each kind, in open loop and under a speed loop.

In a run, every fifth fan of a tray has one fault and the others are healthy: what most fans of a tray have in common is
the air, not a fault. Half of the fans are held at a level, half are moved all the time: only moving fans allow causes
to be distinguished. Faults begin some minutes after the start of the run, within half a minute after `fault_after_s`,
and stay; wear grows until the end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from bench.detection import severities
from bench.detection.knobs import Knob, Knobs
from bench.detection.metrics import Event
from bench.detection.plant import RATE_HZ, START_NS, TRAY_FANS, Faults, Plant, tiled
from bench.detection.severities import EFFECTS_SIGMA, KINDS, Kind
from bench.detection.simulated import Fleet, run_name
from fantwin.schemas.messages import Array

ONSET_WITHIN_S = 30.0
LASTS_S = 90.0
DUTIES = (0.35, 0.75)
SET_POINTS_RAD_S = (300.0, 650.0)
HAND_S = (1.0, 6.0)
FOREVER_S = (1e9, 1e9)
NEVER_S = 1e9
FAULTY_ONE_IN = 5


@dataclass(frozen=True)
class Cell:
    """The fault of a column. strength: the effect in sigma, or the size if the kind defines sizes."""

    kind: Kind
    strength: float
    is_looped: bool
    is_moved: bool


@dataclass(frozen=True)
class Campaign:
    """Runs with a fault in one of FAULTY_ONE_IN columns. cells: of the events."""

    plant: Plant
    seconds: float
    cells: list[Cell]
    events: list[Event]


def cells() -> list[Cell]:
    """All of them."""
    return [
        Cell(kind, strength, is_looped, is_moved)
        for kind in KINDS
        for strength in (kind.sizes or EFFECTS_SIGMA)
        for is_looped in (False, True)
        for is_moved in (False, True)
    ]


def campaign(fleet: Fleet, runs: int, fault_after_s: float, seed: int) -> Campaign:
    """Every cell about equally often, on random fans; as many faults as `runs` have fans."""
    rng = np.random.default_rng(seed)
    runs *= FAULTY_ONE_IN
    columns = fleet.count * runs
    every = cells()
    run, fan = np.divmod(np.arange(columns), fleet.count)
    is_faulty = run % FAULTY_ONE_IN == fan % FAULTY_ONE_IN
    place = rng.integers(len(every), size=columns)
    place[is_faulty] = rng.permutation(np.resize(np.arange(len(every)), np.count_nonzero(is_faulty)))
    shown = [every[one] for one in place.tolist()]
    knobs = Knobs([_knob(cell, rng) for cell in shown], seed + 1)
    start_s = np.round(fault_after_s + rng.uniform(0.0, ONSET_WITHIN_S, size=columns), 2)
    start_s[~is_faulty] = NEVER_S
    faults = Faults(
        kind=np.array([cell.kind.name for cell in shown]),
        size=_sizes(fleet, runs, shown, knobs),
        start_s=start_s,
        stop_s=start_s + LASTS_S,
    )
    trays = fleet.count // TRAY_FANS
    faulty = np.flatnonzero(is_faulty).tolist()
    events = [
        Event(
            run_name(column // TRAY_FANS, trays),
            column % TRAY_FANS,
            START_NS + round(start_s[column] * 1e9),
            START_NS + round((start_s[column] + LASTS_S) * 1e9),
            shown[column].kind.name,
            shown[column].kind.cause,
        )
        for column in faulty
    ]
    plant = Plant(fleet.fans, runs, knobs, seed + 2, faults)
    return Campaign(
        plant, fault_after_s + ONSET_WITHIN_S + LASTS_S + 1.0 / RATE_HZ, [shown[column] for column in faulty], events
    )


def _knob(cell: Cell, rng: np.random.Generator) -> Knob:
    low, high = SET_POINTS_RAD_S if cell.is_looped else DUTIES
    if cell.is_moved:
        return Knob(low, high, HAND_S, is_looped=cell.is_looped)
    level = rng.uniform(low, high)
    return Knob(level, level, FOREVER_S, is_looped=cell.is_looped)


def _sizes(fleet: Fleet, runs: int, shown: list[Cell], knobs: Knobs) -> Array:
    """(columns,) of each fault."""
    fans = tiled(fleet.fans, runs)
    sigma_rad_s, sigma_command = (np.tile(sigma, runs) for sigma in fleet.sigmas())
    strength = np.array([cell.strength for cell in shown])
    looped = knobs.is_looped
    speed_rad_s = np.where(looped, knobs.centre, 0.0)
    speed_rad_s = np.where(
        looped, speed_rad_s, severities.held_speed_rad_s(severities.given_v(knobs.centre, fans), fans)
    )
    change_rad_s = np.where(looped, 0.0, strength * sigma_rad_s)
    change_of_command = np.where(looped, strength * sigma_command, 0.0)
    found = strength.copy()  # of the kinds that have sizes of their own
    names = np.array([cell.kind.name for cell in shown])
    for kind in KINDS:
        if not kind.sizes:
            of_kind = severities.size(kind.name, speed_rad_s, fans, change_rad_s, change_of_command)
            found = np.where(names == kind.name, of_kind, found)
    return found

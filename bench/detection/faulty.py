"""Simulated faults with a known onset: five severities of each kind, in open loop and under a speed loop.

Each fan of each run has one fault. Half of the fans are held at a level, half are moved all the time: only moving fans
allow causes to be distinguished. Faults begin some minutes after the start of the run, within half a minute after
`commissioned_s`, and stay; wear grows until the end.
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
from schemas.messages import Array

ONSET_WITHIN_S = 30.0
LASTS_S = 90.0
DUTIES = (0.35, 0.75)
SET_POINTS_RAD_S = (300.0, 650.0)
HAND_S = (1.0, 6.0)
FOREVER_S = (1e9, 1e9)


@dataclass(frozen=True)
class Cell:
    """The fault of a column. strength: the effect in sigma, or the size if the kind defines sizes."""

    kind: Kind
    strength: float
    is_looped: bool
    is_moved: bool


@dataclass(frozen=True)
class Campaign:
    """Runs with a fault in every column."""

    plant: Plant
    seconds: float
    cells: list[Cell]
    """of the columns"""
    events: list[Event]
    """of the columns"""


def cells() -> list[Cell]:
    """All of them."""
    return [
        Cell(kind, strength, is_looped, is_moved)
        for kind in KINDS
        for strength in (kind.sizes or EFFECTS_SIGMA)
        for is_looped in (False, True)
        for is_moved in (False, True)
    ]


def campaign(fleet: Fleet, runs: int, commissioned_s: float, seed: int) -> Campaign:
    """Every cell about equally often, on random fans."""
    rng = np.random.default_rng(seed)
    columns = fleet.count * runs
    every = cells()
    shown = [every[place] for place in rng.permutation(np.resize(np.arange(len(every)), columns)).tolist()]
    knobs = Knobs([_knob(cell, rng) for cell in shown], seed + 1)
    start_s = np.round(commissioned_s + rng.uniform(0.0, ONSET_WITHIN_S, size=columns), 2)
    faults = Faults(
        kind=np.array([cell.kind.name for cell in shown]),
        size=_sizes(fleet, runs, shown, knobs),
        start_s=start_s,
        stop_s=start_s + LASTS_S,
    )
    trays = fleet.count // TRAY_FANS
    events = [
        Event(
            run_name(column // TRAY_FANS, trays),
            column % TRAY_FANS,
            START_NS + round(first_s * 1e9),
            START_NS + round((first_s + LASTS_S) * 1e9),
            cell.kind.name,
            cell.kind.cause,
        )
        for column, (cell, first_s) in enumerate(zip(shown, start_s.tolist(), strict=True))
    ]
    plant = Plant(fleet.fans, runs, knobs, seed + 2, faults)
    return Campaign(plant, commissioned_s + ONSET_WITHIN_S + LASTS_S + 1.0 / RATE_HZ, shown, events)


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

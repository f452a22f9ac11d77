"""Faults of the simulated tray, on a schedule.

Each acts on one fan from `start_s` until `stop_s`, and has no effect afterwards. The meaning of `size` by kind:

| kind | fans | what it is | size | default |
|---|---|---|---|---|
| inlet | dc | covered inlet | factor on the drag C_D | 1.6 |
| rotor | dc | disturbed rotor | braking torque, V | 1.0 |
| wear | dc | worn bearing | sliding friction added at stop, V; grows linearly from 0 at start | 0.8 |
| supply | dc | supply sag | factor on the supply voltage | 0.85 |
| clog | 4-pin | clogging | share of the speed lost; grows linearly from 0 within 180 s | 0.06 |
| blade | 4-pin | something touches a blade | share of the speed lost | 0.10 |
| bearing | 4-pin | worn bearing | share of the speed lost; runs up slower, coasts shorter | 0.03 |
| blocked | 4-pin | the rotor cannot turn | (none) | |
| no-power | 4-pin | the supply is gone | (none) | |
| tacho-stuck | all | tacho repeats its last reading | (none) | |
| tacho-dropout | all | tacho gives no reading (NaN): a loose wire | share of missing readings, 0 to 1 | 1.0 |
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fantwin.simulation.errors import SimulationError, nearest
from fantwin.simulation.four_pin import FourPinDamage
from fantwin.simulation.plant import Array, Disturbance

CLOG_S = 180.0
"""the time in which clogging reaches its size"""
BEARING_UP_FACTOR, BEARING_DOWN_FACTOR = 1.8, 0.75
"""of a worn bearing, on the time constants of a rise and of a fall"""


@dataclass(frozen=True)
class _Kind:
    default_size: float | None  # None: this kind has no size
    smallest: float = 0.0
    largest: float = math.inf
    fans: tuple[str, ...] = ("dc", "4-pin")


KINDS: dict[str, _Kind] = {
    "inlet": _Kind(1.6, smallest=0.01, fans=("dc",)),
    "rotor": _Kind(1.0, fans=("dc",)),
    "wear": _Kind(0.8, fans=("dc",)),
    "supply": _Kind(0.85, fans=("dc",)),
    "clog": _Kind(0.06, largest=1.0, fans=("4-pin",)),
    "blade": _Kind(0.10, largest=1.0, fans=("4-pin",)),
    "bearing": _Kind(0.03, largest=1.0, fans=("4-pin",)),
    "blocked": _Kind(None, fans=("4-pin",)),
    "no-power": _Kind(None, fans=("4-pin",)),
    "tacho-stuck": _Kind(None),
    "tacho-dropout": _Kind(1.0, largest=1.0),
}
KEYS = ("fan", "start", "stop", "size")


@dataclass(frozen=True)
class Fault:
    """One fault: `fan` counted from 0, times in seconds since the tray began; stop_s may be infinite."""

    kind: str
    fan: int
    start_s: float = 0.0
    stop_s: float = math.inf
    size: float | None = None

    def active(self, t_s: float) -> bool:
        """Whether the fault acts at t_s."""
        return self.start_s <= t_s < self.stop_s

    def size_at(self, t_s: float) -> float:
        """Its size at t_s while it is active, 0 without one; that of wear and of clogging grows linearly."""
        if self.size is None:
            return 0.0
        since_s = t_s - self.start_s
        if self.kind == "wear":
            return self.size * (since_s / (self.stop_s - self.start_s))
        return self.size * min(1.0, since_s / CLOG_S) if self.kind == "clog" else self.size


def parse_fault(text: str) -> Fault:
    """A fault as written on the command line: `KIND:fan=N[,start=S][,stop=S][,size=X]`.

    Raises:
        SimulationError: one line that says which part is wrong, with the most similar known word.
    """
    kind, _, settings = text.partition(":")
    if kind not in KINDS:
        raise SimulationError(f"fault {text!r}: unknown kind {kind!r}; {nearest(kind, KINDS)}")
    values: dict[str, float] = {}
    for setting in filter(None, settings.split(",")):
        key, _, number = setting.partition("=")
        if key not in KEYS:
            raise SimulationError(f"fault {text!r}: unknown key {key!r}; {nearest(key, KEYS)}")
        if key in values:
            raise SimulationError(f"fault {text!r}: {key} is given twice")
        try:
            values[key] = float(number)
        except ValueError as error:
            raise SimulationError(f"fault {text!r}: {key} = {number!r} is not a number") from error
        if not math.isfinite(values[key]):
            raise SimulationError(f"fault {text!r}: {key} = {number} must be finite")
    if "fan" not in values:
        raise SimulationError(f"fault {text!r}: fan is missing; fans count from 0, for example {kind}:fan=0")
    if values["fan"] != int(values["fan"]) or values["fan"] < 0:
        raise SimulationError(f"fault {text!r}: fan must be a whole number from 0 on")
    fault = Fault(
        kind,
        int(values["fan"]),
        values.get("start", 0.0),
        values.get("stop", math.inf),
        values.get("size", KINDS[kind].default_size),
    )
    _check(fault, f"fault {text!r}")
    return fault


def _check(fault: Fault, where: str) -> None:
    kind = KINDS[fault.kind]
    if fault.start_s < 0.0:
        raise SimulationError(f"{where}: start must not be negative")
    if fault.stop_s <= fault.start_s:
        raise SimulationError(f"{where}: stop must come after start")
    if fault.size is None:
        return
    if kind.default_size is None:
        raise SimulationError(f"{where}: {fault.kind} has no size; leave it out")
    if not kind.smallest <= fault.size <= kind.largest:
        upto = f" to {kind.largest:g}" if math.isfinite(kind.largest) else " on"
        raise SimulationError(f"{where}: size = {fault.size:g}; give one from {kind.smallest:g}{upto}")


def check_schedule(faults: Iterable[Fault], fans: int, duration_s: float, fan_kind: str = "dc") -> None:
    """Check that these faults fit a tray of `fans` fans of a kind that runs for `duration_s`.

    Raises:
        SimulationError: such fans have no such fault, a fan does not exist, wear has no end, or a fault starts after
            the end.
    """
    for fault in faults:
        if fan_kind not in KINDS[fault.kind].fans:
            own = ", ".join(name for name, kind in KINDS.items() if fan_kind in kind.fans)
            raise SimulationError(f"{fault.kind} fault: {fan_kind} fans have no such fault; they have {own}")
        if fault.fan >= fans:
            raise SimulationError(
                f"{fault.kind} fault: fan {fault.fan} does not exist; the tray has fans 0 to {fans - 1}"
            )
        if fault.start_s >= duration_s:
            raise SimulationError(
                f"{fault.kind} fault: start = {fault.start_s:g} s is after the end at {duration_s:g} s"
            )
        if fault.kind == "wear" and math.isinf(fault.stop_s):
            raise SimulationError("wear fault: stop is missing; give stop=S, the time at which it reaches its size")


def _active(faults: Iterable[Fault], t_s: float) -> Iterator[tuple[Fault, float]]:
    """The faults that act at t_s, and their sizes; 0 of one that has none."""
    return ((fault, fault.size_at(t_s)) for fault in faults if fault.active(t_s))


def disturbance(faults: Iterable[Fault], fans: int, t_s: float) -> Disturbance:
    """The disturbance of the fans at t_s. Several faults of one fan combine: factors multiply, torques add."""
    drag, brake, supply = np.ones(fans), np.zeros(fans), np.ones(fans)
    for fault, size in _active(faults, t_s):
        if fault.kind == "inlet":
            drag[fault.fan] *= size
        elif fault.kind in ("rotor", "wear"):
            brake[fault.fan] += size
        elif fault.kind == "supply":
            supply[fault.fan] *= size
    return Disturbance(drag, brake, supply)


def four_pin_damage(faults: Iterable[Fault], fans: int, t_s: float) -> FourPinDamage:
    """The damage of 4-pin fans at t_s. Several faults of one fan combine: factors multiply."""
    speed, up, down = np.ones(fans), np.ones(fans), np.ones(fans)
    blocked, unpowered = np.zeros(fans, np.bool_), np.zeros(fans, np.bool_)
    for fault, size in _active(faults, t_s):
        if fault.kind in ("clog", "blade", "bearing"):
            speed[fault.fan] *= 1.0 - size
        if fault.kind == "bearing":
            up[fault.fan] *= BEARING_UP_FACTOR
            down[fault.fan] *= BEARING_DOWN_FACTOR
        blocked[fault.fan] |= fault.kind == "blocked"
        unpowered[fault.fan] |= fault.kind == "no-power"
    return FourPinDamage(speed, up, down, blocked, unpowered)


def tacho_faults(faults: Iterable[Fault], fans: int, t_s: float) -> tuple[NDArray[np.bool_], Array]:
    """Which tachos are stuck at t_s (fans,), and the share of missing readings (fans,)."""
    stuck, dropout = np.zeros(fans, np.bool_), np.zeros(fans)
    for fault, size in _active(faults, t_s):
        stuck[fault.fan] |= fault.kind == "tacho-stuck"
        if fault.kind == "tacho-dropout":
            dropout[fault.fan] = max(dropout[fault.fan], size)
    return stuck, dropout

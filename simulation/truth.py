"""The ground truth of a simulated run: which fault acted on which fan and when, to evaluate alarms.

A JSON file beside the run. It is written at the start (`complete` false, times unknown) and replaced at the end. The
times of a fault, ns since the epoch, are those of the first samples with it and without it. A fault still active at
the end ends with the run; the times of one that never began are null.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from fantwin.schemas.units import NS_PER_S
from fantwin.simulation.tray import SimulatedTray

AS_SET = ("fans", "fan", "rate_hz", "profile", "seed", "fans_seed", "fan_variation", "lost", "jitter_us")


def truth(tray: SimulatedTray, start_ns: int | None, *, complete: bool, counts: Mapping[str, int]) -> dict[str, Any]:
    """The ground truth so far. start_ns: epoch time of t_s = 0, None before the start.

    counts: `samples_sent`, `samples_dropped`, `samples_unsent` and any other counters.
    """
    settings = tray.settings
    return {
        "complete": complete,
        "start_ns": start_ns,
        "end_ns": _at(start_ns, tray.t_s) if complete else None,
        **counts,
        "faults": [_fault(tray, number, start_ns, complete) for number in range(len(settings.faults))],
        **{name: getattr(settings, name) for name in AS_SET},
        "clock": asdict(settings.clock),
        "tacho": settings.tacho.as_record(),
        "surroundings": asdict(settings.surroundings),
        "parameters": [
            {name: float(values[fan]) for name, values in asdict(tray.parameters).items()}
            for fan in range(settings.fans)
        ],
    }


def _fault(tray: SimulatedTray, number: int, start_ns: int | None, complete: bool) -> dict[str, Any]:
    fault = tray.settings.faults[number]
    began_s, ended_s = tray.happened(number)
    if complete and began_s is not None and ended_s is None:
        ended_s = tray.t_s
    return {
        "kind": fault.kind,
        "fan": fault.fan,
        "start_ns": _at(start_ns, began_s),
        "stop_ns": _at(start_ns, ended_s),
        "size": fault.size,
    }


def _at(start_ns: int | None, t_s: float | None) -> int | None:
    return None if start_ns is None or t_s is None else start_ns + round(t_s * NS_PER_S)

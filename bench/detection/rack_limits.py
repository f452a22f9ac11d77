"""What a tacho can show at all: the shortest time in which anybody who reads it could tell that a fault is there.

This reader knows the fan perfectly, the readings that it would have given without the fault, and the fault. He does
not know the phases of the first and the last pulse, nor how the speed wanders. He adds up by how much the newest
counts, as many as tell most, differ from the healthy ones; the variance of the sum is resolution^2 / 6 and, for each
count, that of the wandering. He can tell once the sum is a deviation that the counts of a healthy fan exceed once a
day. (Wandering that outlasts a count makes him slower.) Of missing readings each adds its log likelihood ratio; he
can tell once the fault is more probable by as many times as there are counts in a day.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from bench.detection.metrics import Event
from bench.detection.racks import DAY_S, MISSING_READINGS, SIZES, TACHOS
from fantwin.pipeline.recordings.reading import read_recording
from fantwin.schemas.messages import Array, Raw
from fantwin.schemas.tacho import Tacho
from fantwin.schemas.units import NS_PER_S
from fantwin.simulation.four_pin import FourPinParameters

WANDER = float(FourPinParameters().wander)
MOVED = 0.1
"""of the duty: a command that has changed by so much has moved"""


def information_limit_s(
    t_s: Array, healthy_rad_s: Array, faulty_rad_s: Array, tacho: Tacho, lost_share: float = 0.0
) -> float:
    """Seconds after the beginning of a fault until a reader can tell; NaN if it ends before.

    t_s: (n,) of the reports since the beginning. healthy_rad_s, faulty_rad_s: (n,) readings without and with the fault,
    NaN where missing. lost_share: the fault is that so many readings are missing.
    """
    counts_a_day = DAY_S / (tacho.held_s or float(np.median(np.diff(t_s))))
    if lost_share:
        is_missing = np.isnan(faulty_rad_s)
        for_missing, for_reading = (
            math.log(lost_share / MISSING_READINGS),
            math.log((1.0 - lost_share) / (1.0 - MISSING_READINGS)),
        )
        evidence = np.cumsum(np.where(is_missing, for_missing, for_reading))
        enough = math.log(counts_a_day)
    else:
        is_new = _is_new_count(t_s, healthy_rad_s, faulty_rad_s, tacho.held_s)
        differences = np.where(is_new, faulty_rad_s - healthy_rad_s, 0.0)
        wandering = np.where(is_new, np.square(WANDER * healthy_rad_s), 0.0)
        evidence = _best_sums(np.nan_to_num(differences), np.nan_to_num(wandering), tacho.resolution_rad_s**2 / 6.0)
        enough = float(norm.isf(0.5 / counts_a_day)) ** 2
    reached = np.flatnonzero(evidence >= enough)
    return float(t_s[reached[0]]) if len(reached) else math.nan


def _best_sums(differences: Array, wandering: Array, of_phases: float) -> Array:
    """(n,) the square of the sum of the newest differences over its variance, for as many as make it largest."""
    sums, variances = np.cumsum(differences), np.cumsum(wandering)
    before, variance_before = sums - differences, variances - wandering
    return np.array(
        [
            np.max(np.square(sums[row] - before[: row + 1]) / (of_phases + variances[row] - variance_before[: row + 1]))
            for row in range(len(sums))
        ]
    )


def _is_new_count(t_s: Array, healthy: Array, faulty: Array, held_s: float) -> NDArray[np.bool_]:
    """(n,) whether a report shows a count that the one before it did not; equal counts follow one another by held_s."""
    is_new = np.zeros(len(t_s), np.bool_)
    newest_s, shown = -math.inf, (math.nan, math.nan)
    for row, pair in enumerate(zip(healthy.tolist(), faulty.tolist(), strict=True)):
        if math.isnan(pair[0]) or math.isnan(pair[1]):
            continue
        if pair != shown or t_s[row] - newest_s >= held_s - 1e-9:
            is_new[row], newest_s, shown = True, t_s[row], pair
    return is_new


@dataclass(frozen=True)
class Facts:
    """About one fault. limit_s: of its tacho, NaN where it cannot show the fault. moved_after_s: when the command of
    the fan had first moved by MOVED, NaN if it never did."""

    limit_s: float
    moved_after_s: float


def facts_of_rack(healthy: Path, faulty: Path, events: Sequence[Event]) -> list[Facts]:
    """About each event of a rack. healthy, faulty: recordings of the same test without and with faults."""
    first_ns, last_ns = min(one.start_ns for one in events), max(one.end_ns for one in events)
    kept: list[tuple[Array, Array, Array, Array]] = []
    for without, shown in zip(reports_of(healthy), reports_of(faulty), strict=True):
        times_ns = shown.host_receive_t_ns
        assert np.array_equal(times_ns, without.host_receive_t_ns)  # the same lines are lost
        if times_ns[-1] >= first_ns and times_ns[0] <= last_ns:
            kept.append((times_ns, shown.command, without.speed_rad_s, shown.speed_rad_s))
    t_ns, command, expected, reading = (np.concatenate(column) for column in zip(*kept, strict=True))
    return [_facts(event, t_ns, command, expected, reading) for event in events]


def _facts(event: Event, t_ns: Array, command: Array, expected: Array, reading: Array) -> Facts:
    rows = slice(*np.searchsorted(t_ns, (event.start_ns, event.end_ns)).tolist())
    t_s = (t_ns[rows] - event.start_ns) / NS_PER_S
    lost_share = SIZES[event.kind] if event.kind == "tacho-dropout" else 0.0
    duty = command[rows, event.fan]
    moved = np.flatnonzero(np.abs(duty - duty[0]) >= MOVED)
    limit_s = information_limit_s(
        t_s, expected[rows, event.fan], reading[rows, event.fan], TACHOS[event.fan], lost_share
    )
    return Facts(limit_s, float(t_s[moved[0]]) if len(moved) else math.nan)


def reports_of(path: Path) -> Iterator[Raw]:
    """The reports in the recording of a rack."""
    for envelope in read_recording(path, ("raw",)):
        assert isinstance(envelope.message, Raw)
        yield envelope.message

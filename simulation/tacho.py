"""Simulated tachos: what each reading shows of the speed, for the measurements that `schemas.tacho` defines.

A tacho is given the course of the speeds, piece by piece, and asked for its readings at the times of samples. Edges
come at equal angles, `pulses` a revolution; each fan has a phase of its own. A tacho has no direction.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from fantwin.schemas.tacho import INSTANTANEOUS, Tacho, tacho_of_each_fan
from fantwin.simulation.errors import SimulationError
from fantwin.simulation.plant import Array

COUNT_PIECE_S, PERIOD_PIECE_S, DELAY_PIECE_S = 0.05, 0.01, 0.01
"""longest pieces of the course of the speeds: within them the angle, or the delay, is approximate"""
SLOWEST_REVOLUTION_S = 2.0
"""a tacho of kind "period" reads 0 where the last revolution took longer, or has not ended for so long"""


@dataclass(frozen=True)
class NoisyTacho:
    """Measures speed at once: white noise, then rounding to `step_rad_s`; no direction, and 0 below `floor_rad_s`."""

    noise_rad_s: float = 4.0
    step_rad_s: float = 0.5
    floor_rad_s: float = 2.0

    def read(self, speed_rad_s: Array, rng: np.random.Generator) -> Array:
        """(fans,) reading in rad/s of the speed (fans,)."""
        magnitude = np.abs(speed_rad_s)
        noisy = magnitude + self.noise_rad_s * rng.normal(size=magnitude.shape)
        stepped = np.round(noisy / self.step_rad_s) * self.step_rad_s if self.step_rad_s > 0.0 else noisy
        return np.where(magnitude < self.floor_rad_s, 0.0, np.maximum(stepped, 0.0))


@dataclass(frozen=True)
class TachoSettings:
    """How the speed of each fan of a tray is measured, and what goes wrong in it."""

    measurement: tuple[Tacho, ...] = INSTANTANEOUS
    """one for all fans, or one for each; only those that count may differ"""
    noise: NoisyTacho = NoisyTacho()
    """of readings of kind "instantaneous"; those of pulses are exact up to their resolution"""
    missing_edges: float = 0.0
    """share of edges that are not seen"""
    double_edges: float = 0.0
    """share of edges that are seen twice"""
    missing_readings: float = 0.0
    """share of readings that are missing: NaN"""

    def as_record(self) -> dict[str, Any]:
        """The settings as one table of plain values, for the ground truth."""
        return asdict(self.noise) | {
            "measurement": [tacho.model_dump() for tacho in self.measurement],
            "missing_edges": self.missing_edges,
            "double_edges": self.double_edges,
            "missing_readings": self.missing_readings,
        }


class SimulatedTacho(Protocol):
    """The tachos of all fans of a tray."""

    longest_piece_s: float
    """longest piece that `turn` may be given"""

    def turn(self, start_s: float, before_rad_s: Array, end_s: float, after_rad_s: Array) -> None:
        """Speeds went from before to after, (fans,) each, about linearly; pieces follow one another without a gap."""
        ...

    def read(self) -> Array:
        """(fans,) readings at the end of the last piece, rad/s."""
        ...


def simulated_tacho(settings: TachoSettings, fans: int, rng: np.random.Generator) -> SimulatedTacho:
    """The tachos of a tray of fans with these settings.

    Raises:
        SimulationError: such tachos cannot be simulated.
    """
    try:
        tachos = tacho_of_each_fan(settings.measurement, fans)
    except ValueError as error:
        raise SimulationError(str(error)) from error
    tacho = tachos[0]
    if any(other.kind != tacho.kind or other.delay_s != tacho.delay_s for other in tachos):
        raise SimulationError("the tachos of a simulated tray are of one kind and equally late")
    simulated: SimulatedTacho
    if tacho.kind == "instantaneous":
        simulated = InstantaneousTacho(settings.noise, fans, rng)
    elif tacho.kind == "count":
        simulated = CountingTacho(tachos, settings.missing_edges, settings.double_edges, rng)
    elif tacho.kind == "average":
        simulated = AveragingTacho(tachos, rng)
    elif any(other.pulses != tacho.pulses for other in tachos):
        raise SimulationError("simulated tachos of kind period have equally many pulses")
    else:
        simulated = PeriodTacho(tacho.pulses, fans, settings.missing_edges, settings.double_edges, rng)
    return DelayedTacho(simulated, tacho.delay_s) if tacho.delay_s > 0.0 else simulated


class InstantaneousTacho:
    """Shows the speed at the time of the sample, with noise."""

    longest_piece_s = math.inf

    def __init__(self, noise: NoisyTacho, fans: int, rng: np.random.Generator) -> None:
        self._noise, self._rng = noise, rng
        self._speed_rad_s = np.zeros(fans)

    def turn(self, start_s: float, before_rad_s: Array, end_s: float, after_rad_s: Array) -> None:
        """Take the speeds at the end."""
        self._speed_rad_s = after_rad_s

    def read(self) -> Array:
        """(fans,) readings; each call draws other noise."""
        return self._noise.read(self._speed_rad_s, self._rng)


class CountingTacho:
    """Shows the edges of the last complete window as a speed, until the next count is complete."""

    longest_piece_s = COUNT_PIECE_S

    def __init__(
        self, tachos: Sequence[Tacho], missing_edges: float, double_edges: float, rng: np.random.Generator
    ) -> None:
        """Fans that stand. tachos: of kind "count", one per fan; windows of several counts hold a whole number of them.

        Raises:
            SimulationError: a window is not a multiple of the time between counts.
        """
        fans = len(tachos)
        self._rng = rng
        self._shares = (missing_edges, double_edges)
        self._update_s = np.array([tacho.held_s for tacho in tachos])
        self._rad_s_per_edge = np.array([tacho.resolution_rad_s for tacho in tachos])
        self._edges_per_rad = np.array([tacho.pulses for tacho in tachos]) / (2.0 * np.pi)
        self._counts = np.array([_counts_in_window(tacho) for tacho in tachos])
        self._turned = rng.random(fans)  # in distances between edges: an edge comes at each whole number
        self._edges = np.zeros(fans)
        self._end_s = self._update_s * rng.random(fans)
        # Edges up to the end of each of the last counts, in a ring for each fan.
        self._totals = np.zeros((int(self._counts.max()) + 1, fans))
        self._finished = np.zeros(fans, np.int64)
        self.reading_rad_s = np.zeros(fans)
        self.shown_from_s = np.zeros(fans)
        """(fans,) since when each reading is shown"""

    def turn(self, start_s: float, before_rad_s: Array, end_s: float, after_rad_s: Array) -> None:
        """Count the edges of a piece, and show the counts that end in it."""
        per_rad, duration_s = self._edges_per_rad, end_s - start_s
        while (due := np.flatnonzero(self._end_s <= end_s)).size:
            into_s = self._end_s[due] - start_s
            share = into_s / duration_s if duration_s > 0.0 else 0.0
            before, after = np.abs(before_rad_s[due]), np.abs(after_rad_s[due])
            angle_rad = (before + 0.5 * (after - before) * share) * into_s
            self._finish(due, np.floor(self._turned[due] + per_rad[due] * angle_rad))
        self._turned = self._turned + 0.5 * (np.abs(before_rad_s) + np.abs(after_rad_s)) * duration_s * per_rad

    def read(self) -> Array:
        """(fans,) the last complete counts."""
        return self.reading_rad_s.copy()

    def _finish(self, fans: NDArray[np.int64], edges: Array) -> None:
        """The counts of some fans end; edges: how many have come since the start."""
        seen = self._seen(edges - self._edges[fans])
        self._edges[fans] = edges
        slots, finished = self._counts[fans] + 1, self._finished[fans]
        total = self._totals[finished % slots, fans] + seen
        self._finished[fans] = finished = finished + 1
        self._totals[finished % slots, fans] = total
        window_began = self._totals[(finished + 1) % slots, fans]
        self.reading_rad_s[fans] = (total - window_began) * self._rad_s_per_edge[fans]
        self.shown_from_s[fans] = self._end_s[fans]
        self._end_s[fans] += self._update_s[fans]

    def _seen(self, edges: Array) -> Array:
        missing, double = self._shares
        if missing == double == 0.0:
            return edges
        whole = edges.astype(np.int64)
        return edges + self._rng.binomial(whole, double) - self._rng.binomial(whole, missing)


class AveragingTacho:
    """Shows the mean speed over the last complete window, in whole steps, until the next one is complete."""

    longest_piece_s = COUNT_PIECE_S

    def __init__(self, tachos: Sequence[Tacho], rng: np.random.Generator) -> None:
        """Fans that stand. tachos: of kind "average", one per fan."""
        fans = len(tachos)
        self._window_s = np.array([tacho.window_s for tacho in tachos])
        self._update_s = np.array([tacho.held_s for tacho in tachos])
        self._step_rad_s = np.array([tacho.step_rad_s for tacho in tachos])
        self._end_s = self._update_s * rng.random(fans)
        self._course: deque[tuple[float, Array]] = deque([(0.0, np.zeros(fans))])  # time, and angles turned
        self._reading_rad_s = np.zeros(fans)

    def turn(self, start_s: float, before_rad_s: Array, end_s: float, after_rad_s: Array) -> None:
        """Follow the angles, and show the averages that end in the piece."""
        angle_rad = 0.5 * (np.abs(before_rad_s) + np.abs(after_rad_s)) * (end_s - start_s)
        self._course.append((end_s, self._course[-1][1] + angle_rad))
        while len(self._course) > 2 and self._course[1][0] < end_s - self._window_s.max() - COUNT_PIECE_S:
            self._course.popleft()
        while (due := np.flatnonzero(self._end_s <= end_s)).size:
            times_s = np.array([t_s for t_s, _ in self._course])
            for fan in due.tolist():
                turned_rad = np.array([turned[fan] for _, turned in self._course])
                window_s, window_end_s = self._window_s[fan], self._end_s[fan]
                began_rad, ended_rad = np.interp([window_end_s - window_s, window_end_s], times_s, turned_rad)
                self._reading_rad_s[fan] = (ended_rad - began_rad) / window_s
            self._end_s[due] += self._update_s[due]

    def read(self) -> Array:
        """(fans,) the last averages."""
        step, reading = self._step_rad_s, self._reading_rad_s
        return np.where(step > 0.0, np.rint(reading / np.where(step > 0.0, step, 1.0)) * step, reading)


class PeriodTacho:
    """Shows the speed of the last whole revolution between two edges, until the next edge."""

    longest_piece_s = PERIOD_PIECE_S

    def __init__(
        self, pulses: int, fans: int, missing_edges: float, double_edges: float, rng: np.random.Generator
    ) -> None:
        self._rng = rng
        self._pulses = pulses
        self._missing, self._double = (1.0 - (1.0 - share) ** pulses for share in (missing_edges, double_edges))
        turned = rng.random(fans)
        self._course: deque[tuple[float, Array]] = deque([(0.0, turned)])  # time, and distances between edges turned
        self._last_edge = np.floor(turned)
        self._factor = np.ones(fans)

    def turn(self, start_s: float, before_rad_s: Array, end_s: float, after_rad_s: Array) -> None:
        """Remember the angles of the last `SLOWEST_REVOLUTION_S`."""
        angle_rad = 0.5 * (np.abs(before_rad_s) + np.abs(after_rad_s)) * (end_s - start_s)
        self._course.append((end_s, self._course[-1][1] + angle_rad * self._pulses / (2.0 * np.pi)))
        while len(self._course) > 2 and self._course[1][0] < end_s - SLOWEST_REVOLUTION_S:
            self._course.popleft()

    def read(self) -> Array:
        """(fans,) speeds of the last revolutions; 0 where there was none of late."""
        times_s = np.array([t_s for t_s, _ in self._course])
        turned = np.array([turned for _, turned in self._course])
        edge = np.floor(turned[-1])
        first = edge - self._pulses
        self._judge_edges(edge)
        reading = np.zeros(len(edge))
        for fan in np.flatnonzero(first >= turned[0]).tolist():
            began_s, ended_s = np.interp([first[fan], edge[fan]], turned[:, fan], times_s)
            reading[fan] = 2.0 * np.pi / (ended_s - began_s)
        return reading * self._factor

    def _judge_edges(self, edge: Array) -> None:
        """Where there are edges since the last reading, draw whether one of the revolution is missing or double."""
        pulses = self._pulses
        missing, double = (self._rng.random(len(edge)) < share for share in (self._missing, self._double))
        too_fast = pulses / (pulses - 1.0) if pulses > 1 else 2.0
        factor = np.where(missing, pulses / (pulses + 1.0), np.where(double, too_fast, 1.0))
        self._factor = np.where(edge > self._last_edge, factor, self._factor)
        self._last_edge = edge


class DelayedTacho:
    """Shows the readings of another tacho after a delay."""

    def __init__(self, tacho: SimulatedTacho, delay_s: float) -> None:
        self._tacho, self._delay_s = tacho, delay_s
        self.longest_piece_s = min(DELAY_PIECE_S, tacho.longest_piece_s)
        self._readings: deque[tuple[float, Array]] = deque([(-math.inf, tacho.read())])

    def turn(self, start_s: float, before_rad_s: Array, end_s: float, after_rad_s: Array) -> None:
        """Measure, and keep what is not shown yet."""
        self._tacho.turn(start_s, before_rad_s, end_s, after_rad_s)
        self._readings.append((end_s, self._tacho.read()))
        while len(self._readings) > 1 and self._readings[1][0] <= end_s - self._delay_s:
            self._readings.popleft()

    def read(self) -> Array:
        """(fans,) readings of `delay_s` ago."""
        return self._readings[0][1]


def _counts_in_window(tacho: Tacho) -> int:
    counts = tacho.window_s / tacho.held_s
    if abs(counts - round(counts)) > 1e-6:
        raise SimulationError(
            f"a window of {tacho.window_s:g} s is not a whole number of updates of {tacho.held_s:g} s; "
            f"give {tacho.window_s / round(counts):g} s between updates"
        )
    return round(counts)

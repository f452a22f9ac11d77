"""The free run of a twin: from one initial speed and the commands alone, never corrected by a measurement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fantwin.pipeline.prediction.conditions import Ratios
from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.column_state import NEVER_NS, ColumnState
from fantwin.scoring.expected_reading import ExpectedReading

START_SAMPLES = 5
"""a free run starts from the mean of so many readings: one alone has its tacho's noise; a static twin starts at once"""
MOST_STEPS = 1000
"""steps of the twin in a sample: 10 s of a twin that was trained at 100 Hz"""
DIVERGED = 10.0
"""multiple of the top speed of training beyond which no rotor is: physics that were fitted with a negative drag run
away at commands above those of training"""


@dataclass(frozen=True)
class FreeRunInputs:
    """Inputs of the free runs over a block of n samples. All arrays (n, fans), except `missing`, (n,)."""

    command: Array
    """the last known command, at the twin's reference conditions"""
    held: Array
    """the same as it was given"""
    unknown: Array
    """the command of this sample is not known"""
    overdue: Array
    """the free run has to end: a command has been held for longer than allowed, or it stops the fan"""
    stopped: Array
    """the command stops the fan"""
    usable: Array
    """the sample has a reading and a command, so that it counts towards a start"""
    missing: Array
    """number of grid samples missing before this one"""
    ratios: Ratios | None = None
    """ratios for a twin that needs the conditions; `command` is converted by them"""

    def next_event(self, after: int, running: Array) -> int:
        """The first row after `after` where a free run may start or stop, samples are missing or the density of the air
        changes; n if there is none."""
        if after + 1 == len(self.missing):
            return after + 1
        rest = slice(after + 1, None)
        may_change = (self.overdue[rest] & running) | (self.usable[rest] & ~running)
        at_all = may_change.any(axis=1) | (self.missing[rest] > 0)
        if self.ratios is not None:
            at_all |= (np.diff(self.ratios.density[after:], axis=0) != 0.0).any(axis=1)
        rows = np.flatnonzero(at_all)
        return after + 1 + int(rows[0]) if len(rows) else len(self.missing)


class FreeRun(ColumnState):
    """The free runs of all fans: which are running, since when, and their state. All arrays are (fans,)."""

    def __init__(self, twin: TwinFile) -> None:
        self._twin = twin
        fans, self._curve = twin.fans, twin.card.steady_curve(twin.parameters)
        self._knows_density = twin.card.conditions is not None
        self._density = np.ones(fans)
        """density of the air, relative to the twin's reference"""
        self.running = np.zeros(fans, np.bool_)
        self.started_t_ns = np.zeros(fans, np.int64)
        self.held_command = np.full(fans, twin.card.command_range[0])
        self._known_t_ns = np.zeros(fans, np.int64)  # when the command was last known
        self._out_of_range_t_ns = np.full(fans, NEVER_NS)
        self._readings = np.zeros(fans, np.int64)  # counted towards a start
        self._sum_rad_s = np.zeros(fans)
        self._state = twin.initial_state(np.zeros(fans), self.held_command)
        self._moved_rad_s = np.zeros(fans)
        """half range of the newest reading of a static twin"""
        self.set_period(NS_PER_S)

    def set_period(self, period_ns: int) -> None:
        """End all free runs; the next ones are on a grid of this period."""
        self.stop(np.ones_like(self.running))
        self._period_s = period_ns / NS_PER_S
        self._steps = 1 if self._curve else max(1, round(min(self._period_s * self._twin.card.rate_hz, MOST_STEPS)))
        """steps of the twin in a sample, each about as long as in training: on a slower grid, for example at 1 Hz, a
        single step could be unstable"""
        self._reading = ExpectedReading(self._twin.tachos, self._period_s)

    @property
    def states(self) -> list[ColumnState]:
        """All that is kept of each fan."""
        return [self, *self._reading.states]

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {
            "running": self.running,
            "started_t_ns": self.started_t_ns,
            "held_command": self.held_command,
            "known_t_ns": self._known_t_ns,
            "out_of_range_t_ns": self._out_of_range_t_ns,
            "readings": self._readings,
            "sum_rad_s": self._sum_rad_s,
            "state": self._state.T,
            "density": self._density,
            "moved_rad_s": self._moved_rad_s,
        }

    def hold(self, t_ns: Array, command: Array, known: Array) -> tuple[Array, Array]:
        """Hold the last known command where one is unknown. t_ns: (n,); command, known: (n, fans).

        Returns the commands (n, fans), and when the command of the sample before was known, (n, fans) ns.
        """
        known_t_ns = np.broadcast_to(t_ns[:, np.newaxis], command.shape)
        if not known.all():
            rows = np.maximum.accumulate(np.where(known, np.arange(len(t_ns))[:, np.newaxis], -1))
            known_t_ns = np.where(rows < 0, self._known_t_ns, t_ns[rows])
            command = np.where(rows < 0, self.held_command, np.take_along_axis(command, rows, axis=0))
        before_t_ns = np.concatenate((self._known_t_ns[np.newaxis], known_t_ns[:-1]))
        self.held_command, self._known_t_ns = command[-1].copy(), known_t_ns[-1].copy()
        return command, before_t_ns

    def last_out_of_range(self, t_ns: Array, beyond: Array) -> Array:
        """Time when the command was last out of range, (n, fans) ns: from then on the free run has to settle."""
        last = np.where(beyond, t_ns[:, np.newaxis], NEVER_NS)
        last = np.maximum(np.maximum.accumulate(last, axis=0), self._out_of_range_t_ns)
        self._out_of_range_t_ns = last[-1].copy()
        return last

    def set_density(self, ratio: Array) -> None:
        """Set the density of the air, (fans,) relative to the twin's reference, from now on; speeds do not jump.

        The state is that at the reference: speeds and commands times the ratio.
        """
        self._state *= (ratio / self._density)[:, np.newaxis]
        self._density = ratio.copy()

    def stop(self, fans: Array) -> None:
        """End the free run of some fans; the next one starts from measured speeds again."""
        self.running &= ~fans
        self.forget_readings(fans)

    def add_readings(self, usable: Array, speed_rad_s: Array) -> Array:
        """Add the readings of one sample. Returns the fans (fans,) that now have enough for a start."""
        usable = usable & ~self.running
        self._readings[usable] += 1
        self._sum_rad_s[usable] += speed_rad_s[usable]
        return usable & (self._readings >= (1 if self._curve else START_SAMPLES))

    def forget_readings(self, fans: Array) -> None:
        """Discard the readings of some fans that count towards a start."""
        self._readings[fans] = 0
        self._sum_rad_s[fans] = 0.0

    def start(self, fans: Array, t_ns: int, command: Array) -> None:
        """Begin the free run of some fans at this sample. command: (fans,), as that of `advance`."""
        speed = np.where(fans, self._sum_rad_s / np.maximum(self._readings, 1), 0.0)
        initial = self._twin.initial_state(speed * self._density, command)
        self._state = np.where(fans[:, np.newaxis], initial, self._state)
        self._reading.start(fans, speed)
        self.started_t_ns[fans] = t_ns
        self.running |= fans
        self.forget_readings(fans)

    def _run(self, command: Array) -> tuple[Array, Array]:
        """(n, fans) the speeds when each of these commands begins, and the state after the last: each is held."""
        steps = self._steps
        step_s = np.full(len(command) * steps, self._period_s / steps)
        held = command if steps == 1 else np.repeat(command, steps, axis=0)
        speed_rad_s, state = self._twin.advance(self._state, held, step_s)
        return speed_rad_s[::steps], state

    def advance(self, command: Array) -> tuple[Array, Array, Array]:
        """Run over a block, or over its first part. command: (n, fans), n >= 1, at the twin's reference conditions.

        Returns the middle of the readings that the tachos may show and half of their range, (m, fans) rad/s, NaN where
        no free run is active, and which fans (fans,) diverged at the last of these samples. The run is cut at a
        divergence so that the result does not depend on the size of the block.
        """
        rows = len(command)
        if not self.running.any():
            nothing = np.full(command.shape, np.nan)
            return nothing, nothing, np.zeros_like(self.running)
        while True:
            speed_rad_s, state = self._run(command[:rows])
            is_possible = np.abs(speed_rad_s) <= DIVERGED * self._twin.card.top_speed_rad_s
            diverged = self.running & ~(is_possible.all(axis=0) & np.isfinite(state).all(axis=1))
            if rows == 1 or not diverged.any():
                break
            rows //= 2
        half_range_of_static = self._of_static(command[:rows])
        self._state = np.where((self.running & ~diverged)[:, np.newaxis], state, self._state)
        if self._knows_density:
            speed_rad_s = speed_rad_s / self._density
        reading, half_range = self._reading.update(np.where(self.running & is_possible, speed_rad_s, np.nan))
        self.stop(diverged)
        return reading, half_range + half_range_of_static, diverged

    def _of_static(self, command: Array) -> Array | float:
        """Half of the range of readings after changes of the command, of which a static twin does not know when they
        were, (n, fans)."""
        if self._curve is None:
            return 0.0
        steps_s = np.full(len(command), self._period_s)
        found = self._curve.half_range_rad_s(np.vstack((self._state[:, 1], command)), steps_s, self._moved_rad_s)
        if self._knows_density:
            found = found / self._density
        self._moved_rad_s = np.where(self.running, found[-1], 0.0)
        return found

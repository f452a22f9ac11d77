"""Twin integrator: runs the healthy twin beside the fans, on the same commands.

Reads: topic `grid` (command, measured speed rad/s, uniform time).
Writes: topic `prediction` (measured and predicted speed rad/s, sigma rad/s), and `twin` (the model card) at start.
Timing: a prediction for every grid message, at once, block for block; one run of the graph a message, for all fans.

The prediction is a *free run*: it starts from the mean of the first measured speeds and is never corrected by a
measurement again. It needs commands only, so a fan without a reading does not disturb it. While the line is silent the
last command is held for `hold_limit_s`; then the commands are unknown, the free run ends, and a new one begins when
the line returns. Samples in the first `warm_up_s` of a free run are not valid (WARMING_UP), nor are those in the first
`warm_up_s` after a command that was out of the twin's range or too small to turn the rotor (OUT_OF_RANGE).

Beside it goes the *torque balance*: the command given, less the command that a healthy fan needs for what was measured.
It needs no free run, and so is there a third of a second after the first sample (scoring.detectors.torque_balance).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from pydantic import Field

from pipeline.runtime.stage import Context, Core, Parts, Stage, StageConfig, StageError
from pipeline.runtime.twin_file import TwinFile, twin_of
from schemas.blocks import chosen
from schemas.messages import Array, Grid, InvalidReason, ModelCard, Prediction
from schemas.units import NS_PER_S
from scoring.detectors.torque_balance import BalanceModel, TorqueBalance

RANGE_MARGIN = 0.05  # of the range's width: so far beyond the commands it was made from a twin is still believed
LONGEST_BRIDGE = 1 << 16  # grid samples; more than half a second at 100 kHz takes longer to run than to start anew
HIGHEST_SPEED = 1.5  # of the top speed it was made from: the balance is believed up to there
RATE_TOLERANCE = 0.01  # a card gives the rate as it was measured


class TwinIntegratorConfig(StageConfig):
    """Section `[twin_integrator]`. The twin itself is named by the tray."""

    start_samples: int = Field(default=5, ge=1, description="measured speeds whose mean a free run starts from")
    warm_up_s: float = Field(default=3.0, ge=0, description="how long a free run is not judged after its start")
    hold_limit_s: float = Field(default=0.5, ge=0, description="how long the last command is held on a silent line")


@dataclass(frozen=True)
class Inputs:
    """What free runs are given over a block. All (n, fans) but `missing`, (n,)."""

    command: Array
    """the last known one"""
    unknown: Array
    """whether the command of this sample is not known"""
    overdue: Array
    """whether a command has been held for longer than allowed"""
    reads: Array
    """whether the sample counts towards a start"""
    missing: Array
    """how many grid samples are missing before this one"""

    def next_event(self, after: int, running: Array) -> int:
        """The first row after one at which a free run may start or stop, or samples are missing; n if there is none."""
        if after + 1 == len(self.missing):
            return after + 1
        rest = slice(after + 1, None)
        may_change = (self.overdue[rest] & running) | (self.reads[rest] & ~running)
        rows = np.flatnonzero(may_change.any(axis=1) | (self.missing[rest] > 0))
        return after + 1 + int(rows[0]) if len(rows) else len(self.missing)


class FreeRun:
    """The free run of each fan: when it starts and stops, and the state it carries. All arrays by fan."""

    def __init__(self, twin: TwinFile, config: TwinIntegratorConfig) -> None:
        self._twin = twin
        self._start_samples = config.start_samples
        fans = twin.fans
        self.running = np.zeros(fans, np.bool_)
        self.started_t_ns = np.zeros(fans, np.int64)
        self.held_command = np.full(fans, twin.command_range[0])
        self._known_t_ns = np.zeros(fans, np.int64)  # when the command was last known
        self._out_of_range_t_ns = np.full(fans, np.iinfo(np.int64).min // 2)
        self._readings = np.zeros(fans, np.int64)  # towards a start
        self._sum_rad_s = np.zeros(fans)
        self._state = twin.initial_state(np.zeros(fans), self.held_command)

    def hold(self, t_ns: Array, command: Array, known: Array) -> tuple[Array, Array]:
        """Hold the last known command where one is unknown. t_ns: (n,); command, known: (n, fans).

        Returns the commands (n, fans), and when the one before each was known (n, fans).
        """
        known_t_ns = np.broadcast_to(t_ns[:, np.newaxis], command.shape)
        if not known.all():
            rows = np.maximum.accumulate(np.where(known, np.arange(len(t_ns))[:, np.newaxis], -1))
            known_t_ns = np.where(rows < 0, self._known_t_ns, t_ns[rows])
            command = np.where(rows < 0, self.held_command, np.take_along_axis(command, rows, axis=0))
        before_t_ns = np.concatenate((self._known_t_ns[np.newaxis], known_t_ns[:-1]))
        self.held_command, self._known_t_ns = command[-1], known_t_ns[-1]
        return command, before_t_ns

    def last_out_of_range(self, t_ns: Array, beyond: Array) -> Array:
        """When the command of each sample's fan was last out of range, (n, fans) ns: the free run must settle since."""
        last = np.where(beyond, t_ns[:, np.newaxis], np.iinfo(np.int64).min // 2)
        last = np.maximum(np.maximum.accumulate(last, axis=0), self._out_of_range_t_ns)
        self._out_of_range_t_ns = last[-1].copy()
        return last

    def stop(self, fans: Array) -> None:
        """End the free run of some fans; the next one starts anew from measured speeds."""
        self.running &= ~fans
        self.forget_readings(fans)

    def note(self, reads: Array, speed_rad_s: Array) -> Array:
        """Take the readings of one sample. Returns which fans have now those that a start needs."""
        reads = reads & ~self.running
        self._readings[reads] += 1
        self._sum_rad_s[reads] += speed_rad_s[reads]
        return reads & (self._readings >= self._start_samples)

    def forget_readings(self, fans: Array) -> None:
        """Some fans need all the readings again."""
        self._readings[fans] = 0
        self._sum_rad_s[fans] = 0.0

    def start(self, fans: Array, t_ns: int, command: Array) -> None:
        """Begin the free run of some fans at this sample."""
        speed = np.where(fans, self._sum_rad_s / np.maximum(self._readings, 1), 0.0)
        initial = self._twin.initial_state(speed, command)
        self._state = np.where(fans[:, np.newaxis], initial, self._state)
        self.started_t_ns[fans] = t_ns
        self.running |= fans
        self.forget_readings(fans)

    def advance(self, command: Array, step_s: float) -> tuple[Array, Array]:
        """Run over a block, or a first part of it. command: (n, fans), of at least one sample.

        Returns speeds (m, fans), NaN where none runs, and who diverged at the last of them: for what a fan does then
        must not depend on what else is in the block.
        """
        rows = len(command)
        if not self.running.any():
            return np.full(command.shape, np.nan), np.zeros_like(self.running)
        while True:
            speed_rad_s, state = self._twin.advance(self._state, command[:rows], np.full(rows, step_s))
            finite = np.isfinite(speed_rad_s)
            diverged = self.running & ~(finite.all(axis=0) & np.isfinite(state).all(axis=1))
            if rows == 1 or not diverged.any():
                break
            rows //= 2
        self._state = np.where((self.running & ~diverged)[:, np.newaxis], state, self._state)
        predicted = np.where(self.running & finite, speed_rad_s, np.nan)
        self.stop(diverged)
        return predicted, diverged


class TwinIntegratorCore(Core):
    """One tray's twin."""

    def __init__(self, twin: TwinFile, config: TwinIntegratorConfig, started_t_ns: int) -> None:
        self._twin = twin
        self._warm_up_ns = round(config.warm_up_s * NS_PER_S)
        self._hold_limit_ns = round(config.hold_limit_s * NS_PER_S)
        low, high = twin.command_range
        margin = RANGE_MARGIN * (high - low)
        self._lowest_command, self._highest_command = low - margin, high + margin
        self._off_below = twin.off_below
        self._run = FreeRun(twin, config)
        self._balance = _balance_of(twin)
        self._card = [
            ModelCard(
                t_ns=started_t_ns,
                twin=twin.name,
                kind=twin.kind,
                sha256=twin.sha256,
                sigma_rad_s=twin.sigma_rad_s,
                card_json=twin.card_json,
            )
        ]
        self._last_t_ns: int | None = None
        self._step_ns = 0
        self._line_is_silent = False  # the last sample said so
        self._problem = ""
        self._counts: Counter[str] = Counter()

    def step(self, item: Grid) -> list[ModelCard | Prediction]:
        """Predict the speeds of a block."""
        messages: list[ModelCard | Prediction] = [*self.tick(0)]
        if item.fans != self._twin.fans:
            self._counts["lost_wrong_fan_count"] += len(item.t_ns)
            self._problem = f"grid of {item.fans} fans, [[tray]] says fans = {self._twin.fans}: correct one of them"
            return messages
        self._problem = ""
        grid = self._only_new(item)
        if not len(grid.t_ns):
            return messages
        if grid.period_ns != self._step_ns:
            self._run.stop(np.ones_like(self._run.running))
            self._balance.reset()
            self._step_ns = grid.period_ns
        if self._twin.is_discrete and abs(grid.period_ns * self._twin.rate_hz / NS_PER_S - 1) > RATE_TOLERANCE:
            self._problem = (
                f"twin {self._twin.name} holds at {self._twin.rate_hz:g} Hz only, the grid has "
                f"{NS_PER_S / grid.period_ns:g} Hz: set [resampler] rate_hz = {self._twin.rate_hz:g}"
            )
            messages.append(self._without_twin(grid))
        else:
            messages.append(self._predict(grid))
        self._last_t_ns = int(grid.t_ns[-1])
        return messages

    def tick(self, now_ns: int) -> list[ModelCard]:
        """Say once which twin is in force."""
        card, self._card = self._card, []
        return card

    def counters(self) -> Mapping[str, int]:
        """docs/explanation/deciding.md says what each counts."""
        return dict(self._counts)

    def problem(self) -> str:
        """A twin that does not fit what it is given."""
        return self._problem

    def _only_new(self, grid: Grid) -> Grid:
        """Without the samples that are not newer than those before them."""
        before = np.concatenate(([np.iinfo(np.int64).min if self._last_t_ns is None else self._last_t_ns], grid.t_ns))
        new = grid.t_ns > np.maximum.accumulate(before)[:-1]
        if new.all():
            return grid
        self._counts["repeated"] += int((~new).sum())
        return chosen(grid, new)

    def _predict(self, grid: Grid) -> Prediction:
        run = self._run
        held_before = run.held_command
        inputs = self._inputs(grid)
        predicted = np.empty(grid.command.shape)
        running, started_t_ns = np.empty(predicted.shape, np.bool_), np.empty(predicted.shape, np.int64)
        row = 0
        while row < len(predicted):
            self._meet(row, grid, inputs, held_before if row == 0 else inputs.command[row - 1])
            end = inputs.next_event(row, run.running)
            running[row:end], started_t_ns[row:end] = run.running, run.started_t_ns
            speed_rad_s = self._advance(inputs.command[row:end])
            end = row + len(speed_rad_s)
            predicted[row:end] = speed_rad_s
            if end > row + 1:
                run.forget_readings(np.any(inputs.unknown[row + 1 : end], axis=0))
            row = end
        in_range = (grid.command >= self._lowest_command) & (grid.command <= self._highest_command)
        in_range &= grid.command >= self._off_below
        beyond = np.isfinite(grid.command) & ~in_range  # where it is unknown the free run has the last known
        since_t_ns = np.maximum(started_t_ns, self._run.last_out_of_range(grid.t_ns, beyond))
        settled = running & ((grid.t_ns[:, np.newaxis] - since_t_ns >= self._warm_up_ns) | ~in_range)
        in_range &= np.isfinite(predicted) | ~running
        self._counts["not_predicted_out_of_range"] += int((settled & ~in_range).sum())
        invalid_reason = np.where(settled, InvalidReason.OUT_OF_RANGE, InvalidReason.WARMING_UP)
        invalid_reason = np.where(settled & in_range, InvalidReason.NONE, invalid_reason)
        invalid_reason = np.where(grid.valid, invalid_reason, grid.invalid_reason).astype(np.uint8)
        return self._prediction(grid, predicted, invalid_reason)

    def _inputs(self, grid: Grid) -> Inputs:
        silent = (grid.invalid_reason == int(InvalidReason.GAP)) | (grid.invalid_reason == int(InvalidReason.STALE))
        known = ~silent & np.isfinite(grid.command)
        command, known_before_t_ns = self._run.hold(grid.t_ns, grid.command, known)
        return Inputs(
            command=command,
            unknown=~known,
            overdue=grid.t_ns[:, np.newaxis] - known_before_t_ns - grid.period_ns > self._hold_limit_ns,
            reads=known & grid.valid & np.isfinite(grid.speed_rad_s),
            missing=self._missing(grid.t_ns, np.all(silent, axis=1)),
        )

    def _missing(self, t_ns: Array, line_is_silent: Array) -> Array:
        """How many grid samples are missing before each, (n,); counts those that no gap of the line explains."""
        period_ns = self._step_ns
        last_t_ns = t_ns[0] - period_ns if self._last_t_ns is None else self._last_t_ns
        since_ns = t_ns - np.concatenate(([last_t_ns], t_ns[:-1]))
        missing = np.zeros(len(t_ns), np.int64)
        for row in np.flatnonzero(since_ns > self._longest_step_ns).tolist():
            missing[row] = round(int(since_ns[row]) / period_ns) - 1
            if not (line_is_silent[row - 1] if row else self._line_is_silent):
                self._counts["lost_grid_samples"] += int(missing[row])
        self._line_is_silent = bool(line_is_silent[-1])
        return missing

    def _meet(self, row: int, grid: Grid, inputs: Inputs, held_command: Array) -> None:
        """Stop and start free runs where this sample asks for it. held_command: (fans,), before it."""
        run, missing = self._run, int(inputs.missing[row])
        cut = run.running & inputs.overdue[row]
        if missing or cut.any():
            run.stop(cut | (missing > LONGEST_BRIDGE))
            while missing > 0 and run.running.any():
                missing -= len(self._advance(np.tile(held_command, (missing, 1))))
        run.forget_readings(inputs.unknown[row])
        starting = run.note(inputs.reads[row], grid.speed_rad_s[row])
        if starting.any():
            run.start(starting, int(grid.t_ns[row]), inputs.command[row])
            self._counts["free_runs"] += int(starting.sum())

    def _advance(self, command: Array) -> Array:
        speed_rad_s, diverged = self._run.advance(command, self._step_ns / NS_PER_S)
        self._counts["diverged"] += int(diverged.sum())
        return speed_rad_s

    def _without_twin(self, grid: Grid) -> Prediction:
        invalid_reason = np.where(grid.valid, InvalidReason.NO_TWIN, grid.invalid_reason).astype(np.uint8)
        return self._prediction(grid, np.full(grid.command.shape, np.nan), invalid_reason)

    def _torque_balance(self, grid: Grid) -> Array:
        """(n, fans) in command units. Where samples are missing it begins anew."""
        known = grid.valid & np.isfinite(grid.speed_rad_s) & np.isfinite(grid.command)
        if self._last_t_ns is not None and grid.t_ns[0] - self._last_t_ns > self._longest_step_ns:
            self._balance.reset()
        cuts = (np.flatnonzero(np.diff(grid.t_ns) > self._longest_step_ns) + 1).tolist()
        parts = []
        for first, last in pairwise((0, *cuts, len(grid.t_ns))):
            if first:
                self._balance.reset()
            rows = slice(first, last)
            parts.append(
                self._balance.update(self._step_ns / NS_PER_S, grid.command[rows], grid.speed_rad_s[rows], known[rows])
            )
        return parts[0] if len(parts) == 1 else np.concatenate(parts)

    @property
    def _longest_step_ns(self) -> int:
        return self._step_ns + (self._step_ns - 1) // 2  # from one and a half steps on samples are missing

    def _prediction(self, grid: Grid, predicted_speed_rad_s: Array, invalid_reason: Array) -> Prediction:
        return Prediction(
            fans=grid.fans,
            period_ns=grid.period_ns,
            t_ns=grid.t_ns,
            command=grid.command,
            measured_speed_rad_s=grid.speed_rad_s,
            predicted_speed_rad_s=predicted_speed_rad_s,
            sigma_rad_s=self._twin.sigma_rad_s,
            valid=invalid_reason == InvalidReason.NONE,
            invalid_reason=invalid_reason,
            twin=self._twin.name,
            torque_balance_command=self._torque_balance(grid),
            torque_balance_sigma_command=self._twin.balance.sigma_command,
        )


def _balance_of(twin: TwinFile) -> TorqueBalance:
    balance = twin.balance
    return TorqueBalance(
        BalanceModel(
            inertia=balance.inertia,
            viscous=balance.viscous,
            drag=balance.drag,
            friction=balance.friction,
            lag_s=balance.lag_s,
            filter_rate_per_s=balance.filter_rate_per_s,
            lowest_speed_rad_s=balance.lowest_speed_rad_s,
            highest_speed_rad_s=HIGHEST_SPEED * twin.top_speed_rad_s,
            off_below=twin.off_below,
        )
    )


def build(context: Context) -> Parts:
    """The core of one tray and its twin.

    Raises:
        StageError: the tray names no twin, or one that cannot be used.
    """
    return Parts(TwinIntegratorCore(twin_of(context), context.config, context.started_t_ns))


def check(context: Context) -> list[str]:
    """What keeps the twin from being loaded."""
    try:
        twin_of(context)
    except StageError as error:
        return [str(error)]
    return []


STAGE = Stage(
    name="twin_integrator",
    about="the healthy twin beside the fans",
    reads=("grid",),
    writes=("prediction", "twin"),
    config=TwinIntegratorConfig,
    build=build,
    check=check,
)

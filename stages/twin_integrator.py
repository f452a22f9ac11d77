"""Twin integrator: runs the healthy twin on the same commands as the fans.

Reads: topic `grid` (command, measured speed rad/s, uniform time), and `new_twin` where the configuration names no twin
(pipeline.runtime.learned_integrator).
Writes: topic `prediction` (measured and predicted speed rad/s, sigma rad/s), and `twin` (the model card) at start and
when a new twin takes over.
Timing: one prediction message for every grid message, immediately and of the same size; the graph runs once per message
for all fans. Where a new twin names a sample within a message as its first, there is one for each twin.

The prediction is a *free run*: it starts from the mean of the first measured speeds and is never corrected by a
measurement again. It needs commands only, so a missing reading does not disturb it. While no samples arrive, the last
command is held for `hold_limit_s`; then the free run ends, and a new one starts when samples arrive again. Samples are
not valid in the first `warm_up_s` of a free run (WARMING_UP), nor in the first `warm_up_s` after a command that was out
of the twin's range or too small to turn the rotor (OUT_OF_RANGE).

Where the card says how fans stop and start (schemas.standstill), nothing is predicted for a fan that its command stops
(STOPPED). Its free run ends, and the next one starts from measured speeds once it turns; until that has settled,
samples are not valid (STARTING).

The *torque balance* is computed as well: the command given minus the command that a healthy fan needs for the
measured motion. It needs no free run and is available a third of a second after the first sample
(scoring.torque_balance).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import scipy.signal  # noqa: F401  the torque balance loads it on first use: not while the first block waits
from pydantic import Field

from pipeline.runtime.decision_rules import CURRENT_RULES, DecisionRules
from pipeline.runtime.free_run import FreeRun, FreeRunInputs
from pipeline.runtime.learned_integrator import LearnedTwinIntegrator
from pipeline.runtime.old_samples import OldSamples
from pipeline.runtime.stage import BuiltStage, Context, Core, Stage, StageConfig, StageError
from pipeline.runtime.starting_fans import StartingFans
from pipeline.runtime.twin_file import TwinFile, load_twin
from schemas.blocks import select
from schemas.messages import Array, Grid, InvalidReason, ModelCard, NewTwin, Prediction
from schemas.standstill import Standstill
from schemas.units import NS_PER_S
from scoring.expected_reading import AveragedCommand
from scoring.torque_balance import BalanceModel, TorqueBalance

LONGEST_BRIDGE = (
    1 << 16
)  # grid samples; above half a second at 100 kHz a new start is faster than running through the loss
LARGEST_MOVE_S = 0.01  # times the width of the training range: a move of the command times the gap in which it was held
HIGHEST_SPEED = 1.5  # times the top training speed: the balance is used up to there
RATE_TOLERANCE = 0.01  # a card holds the measured rate


class TwinIntegratorConfig(StageConfig):
    """Section `[twin_integrator]`. The tray names the twin."""

    start_samples: int = Field(default=5, ge=1, description="a free run starts from the mean of this many speeds")
    warm_up_s: float = Field(default=3.0, ge=0, description="a free run is not valid for this long after its start")
    hold_limit_s: float = Field(default=0.5, ge=0, description="how long the last command is held without samples")


class TwinIntegratorCore(Core):
    """The twin of one tray."""

    def __init__(
        self,
        twin: TwinFile,
        config: TwinIntegratorConfig,
        started_t_ns: int,
        *,
        decision_rules: DecisionRules = CURRENT_RULES,
        content: bytes = b"",
    ) -> None:
        """content: of the file of a learned twin, published with its card."""
        self._twin = twin
        self._knows_breaks = decision_rules >= DecisionRules.BREAKS
        self._producer = ""  # of the newest grid
        reach_s = max(tacho.reach_s for tacho in twin.tachos)
        self._warm_up_ns = round((config.warm_up_s + reach_s) * NS_PER_S)
        self._hold_limit_ns = round(config.hold_limit_s * NS_PER_S)
        low, high = twin.card.command_range
        self._largest_move = LARGEST_MOVE_S * (high - low)
        self._lowest_command, self._highest_command = twin.usable_commands
        self._standstill = twin.card.standstill
        self._off_below = twin.off_below if self._standstill is None else _off_below(twin, self._standstill)
        self._run = FreeRun(twin, config.start_samples)
        self._starting: StartingFans | None = None
        if self._standstill is not None:
            self._starting = StartingFans(twin.fans, self._standstill, self._warm_up_ns, reach_s)
        self._balance = _balance_of(twin, self._off_below)
        self._drive = twin.card.drive
        self._averages = any(tacho.window_s > 0.0 for tacho in twin.tachos)
        self._averaged_command = AveragedCommand(twin.tachos, 1.0)
        self._card = [
            ModelCard(
                t_ns=started_t_ns,
                twin=twin.card.name,
                kind=twin.card.kind,
                sha256=twin.sha256,
                sigma_rad_s=twin.sigma_rad_s,
                card_json=twin.card_json,
                content=content,
            )
        ]
        self._last_t_ns: int | None = None
        self._period_ns = 0
        self._in_announced_gap = False  # the last sample had the reason GAP or STALE for all fans
        self._problem = ""
        self._old_samples = OldSamples()
        self._counts: Counter[str] = Counter()

    def step(self, item: Grid | NewTwin) -> list[ModelCard | Prediction]:
        """Predict the speeds of a block. The twin is that of the configuration: no other one takes over."""
        if isinstance(item, NewTwin):
            return []
        messages: list[ModelCard | Prediction] = [*self.tick(0)]
        if item.fans != self._twin.fans:
            self._counts["lost_wrong_fan_count"] += len(item.t_ns)
            self._problem = f"grid of {item.fans} fans, [[tray]] says fans = {self._twin.fans}: correct one of them"
            return messages
        self._problem = ""
        grid = self._only_new(item)
        if not len(grid.t_ns):
            if len(item.t_ns) and self._last_t_ns is not None:
                self._old_samples.add(item.t_ns, item.period_ns, self._last_t_ns)
            return messages
        self._old_samples.clear()
        if grid.period_ns != self._period_ns:
            self._run.set_period(grid.period_ns)
            self._averaged_command = AveragedCommand(self._twin.tachos, grid.period_ns / NS_PER_S)
            self._balance.reset()
        elif self._is_of_another_session(grid):
            self._run.stop(np.ones_like(self._run.running))
            self._balance.reset()
        self._period_ns, self._producer = grid.period_ns, grid.header.producer
        card = self._twin.card
        if card.fixed_rate and abs(grid.period_ns * card.rate_hz / NS_PER_S - 1) > RATE_TOLERANCE:
            self._problem = (
                f"twin {card.name} is valid at {card.rate_hz:g} Hz only, the grid has "
                f"{NS_PER_S / grid.period_ns:g} Hz: set [resampler] rate_hz = {card.rate_hz:g}"
            )
            messages.append(self._without_twin(grid))
        else:
            messages.append(self._predict(grid))
        self._last_t_ns = int(grid.t_ns[-1])
        return messages

    def tick(self, now_ns: int) -> list[ModelCard]:
        """Publish the model card once."""
        card, self._card = self._card, []
        return card

    def counters(self) -> Mapping[str, int]:
        """docs/explanation/deciding.md explains each counter."""
        return dict(self._counts)

    def problem(self) -> str:
        """A twin that does not fit the grid it receives, or a grid whose times have gone back."""
        return self._problem or self._old_samples.problem("grid samples", "twin_integrator and scorer")

    def _only_new(self, grid: Grid) -> Grid:
        """The block without the samples that are not newer than those before them."""
        before = np.concatenate(([np.iinfo(np.int64).min if self._last_t_ns is None else self._last_t_ns], grid.t_ns))
        new = grid.t_ns > np.maximum.accumulate(before)[:-1]
        if new.all():
            return grid
        self._counts["repeated"] += int((~new).sum())
        return select(grid, new)

    def _is_of_another_session(self, grid: Grid) -> bool:
        """Whether another session of the resampler continues the grid.

        Each derives times from the clock of the device again. By tens of milliseconds they may differ, as if the speed
        had jumped.
        """
        return self._knows_breaks and self._last_t_ns is not None and grid.header.producer != self._producer

    def _predict(self, grid: Grid) -> Prediction:
        run = self._run
        held_before = run.held_command
        inputs = self._inputs(grid)
        predicted, reading_range = np.empty(grid.command.shape), np.empty(grid.command.shape)
        running, started_t_ns = np.empty(predicted.shape, np.bool_), np.empty(predicted.shape, np.int64)
        row = 0
        while row < len(predicted):
            self._start_and_stop(row, grid, inputs, held_before if row == 0 else inputs.command[row - 1])
            end = inputs.next_event(row, run.running)
            running[row:end], started_t_ns[row:end] = run.running, run.started_t_ns
            reading_rad_s, half_range_rad_s = self._advance(inputs.command[row:end])
            end = row + len(reading_rad_s)
            predicted[row:end], reading_range[row:end] = reading_rad_s, half_range_rad_s
            if end > row + 1:
                run.forget_readings(np.any(inputs.unknown[row + 1 : end], axis=0))
            row = end
        in_range = (grid.command >= self._lowest_command) & (grid.command <= self._highest_command)
        in_range &= grid.command >= self._off_below
        beyond = np.isfinite(grid.command) & ~in_range  # where it is unknown, the free run uses the last known command
        since_t_ns = np.maximum(started_t_ns, self._run.last_out_of_range(grid.t_ns, beyond))
        warm = running & (grid.t_ns[:, np.newaxis] - since_t_ns >= self._warm_up_ns)
        if self._starting is not None:
            warm &= self._starting.has_started_up(grid.t_ns, inputs.stopped)
        settled = warm | (running & ~in_range)
        in_range &= np.isfinite(predicted) | ~running
        self._counts["not_predicted_out_of_range"] += int((settled & ~in_range).sum())
        invalid_reason = np.where(settled, int(InvalidReason.OUT_OF_RANGE), int(InvalidReason.WARMING_UP))
        invalid_reason = np.where(settled & in_range, int(InvalidReason.NONE), invalid_reason)
        judged = grid.valid
        if self._starting is not None:
            starting = self._starting.is_starting(inputs.stopped, warm)
            invalid_reason = np.where(starting, int(InvalidReason.STARTING), invalid_reason)
            invalid_reason = np.where(inputs.stopped, int(InvalidReason.STOPPED), invalid_reason)
            judged = judged | ((inputs.stopped | starting) & (grid.invalid_reason == int(InvalidReason.NO_SPEED)))
        invalid_reason = np.where(judged, invalid_reason, grid.invalid_reason).astype(np.uint8)
        return self._prediction(grid, predicted, reading_range, invalid_reason)

    def _inputs(self, grid: Grid) -> FreeRunInputs:
        held_before = self._run.held_command
        silent = (grid.invalid_reason == int(InvalidReason.GAP)) | (grid.invalid_reason == int(InvalidReason.STALE))
        known = ~silent & np.isfinite(grid.command)
        command, known_before_t_ns = self._run.hold(grid.t_ns, grid.command, known)
        gap_ns = grid.t_ns[:, np.newaxis] - known_before_t_ns - grid.period_ns
        overdue = gap_ns > self._hold_limit_ns
        if self._knows_breaks:
            moved = np.diff(command, axis=0, prepend=held_before[np.newaxis])
            overdue |= known & (np.abs(moved) * gap_ns > self._largest_move * NS_PER_S)
            overdue |= grid.invalid_reason == int(InvalidReason.CLOCK_RESTARTED)
        usable = known & grid.valid & np.isfinite(grid.speed_rad_s)
        stopped = np.zeros(usable.shape, np.bool_)
        if self._standstill is not None:
            stopped = known & self._standstill.stops(grid.command, grid.speed_rad_s)
            overdue |= stopped
            usable &= ~stopped & (self._standstill.turns(grid.speed_rad_s) | ~self._standstill.drives(grid.command))
        return FreeRunInputs(
            command=command,
            unknown=~known,
            overdue=overdue,
            stopped=stopped,
            usable=usable,
            missing=self._missing(grid.t_ns, np.all(silent, axis=1)),
        )

    def _missing(self, t_ns: Array, in_gap: Array) -> Array:
        """Number of grid samples missing before each, (n,); counts those that the resampler announced as no gap."""
        period_ns = self._period_ns
        last_t_ns = t_ns[0] - period_ns if self._last_t_ns is None else self._last_t_ns
        since_ns = t_ns - np.concatenate(([last_t_ns], t_ns[:-1]))
        missing = np.zeros(len(t_ns), np.int64)
        for row in np.flatnonzero(since_ns > self._longest_step_ns).tolist():
            missing[row] = round(int(since_ns[row]) / period_ns) - 1
            if not (in_gap[row - 1] if row else self._in_announced_gap):
                self._counts["missing_grid_samples"] += int(missing[row])
        self._in_announced_gap = bool(in_gap[-1])
        return missing

    def _start_and_stop(self, row: int, grid: Grid, inputs: FreeRunInputs, held_command: Array) -> None:
        """Stop and start free runs at this sample. held_command: (fans,), the command before it."""
        run, missing = self._run, int(inputs.missing[row])
        overdue = run.running & inputs.overdue[row]
        if missing or overdue.any():
            run.stop(overdue | (missing > LONGEST_BRIDGE))
            while missing > 0 and run.running.any():
                missing -= len(self._advance(np.tile(held_command, (missing, 1)))[0])
        run.forget_readings(inputs.unknown[row])
        starting = run.add_readings(inputs.usable[row], grid.speed_rad_s[row])
        if starting.any():
            run.start(starting, int(grid.t_ns[row]), inputs.command[row])
            self._counts["free_runs"] += int(starting.sum())

    def _advance(self, command: Array) -> tuple[Array, Array]:
        reading_rad_s, half_range_rad_s, diverged = self._run.advance(command)
        self._counts["diverged"] += int(diverged.sum())
        return reading_rad_s, half_range_rad_s

    def _without_twin(self, grid: Grid) -> Prediction:
        invalid_reason = np.where(grid.valid, int(InvalidReason.NO_TWIN), grid.invalid_reason).astype(np.uint8)
        nothing = np.full(grid.command.shape, np.nan)
        return self._prediction(grid, nothing, nothing, invalid_reason)

    def _torque_balance(self, grid: Grid) -> tuple[Array, Array]:
        """The command averaged as the readings are, and the torque balance. Both (n, fans) in command units.

        A command on the plateau of a drive counts as that at its end.

        They start again after missing samples.
        """
        restarted = (grid.invalid_reason == int(InvalidReason.CLOCK_RESTARTED)).any(axis=1)
        last_t_ns = grid.t_ns[0] if self._last_t_ns is None else self._last_t_ns
        breaks = (np.diff(grid.t_ns, prepend=last_t_ns) > self._longest_step_ns) | restarted
        known = grid.valid & np.isfinite(grid.speed_rad_s) & np.isfinite(grid.command)
        command = grid.command if self._drive is None else self._drive.raised(grid.command)
        averaged, balance = np.empty(grid.command.shape), np.empty(grid.command.shape)
        starts = [0, *(np.flatnonzero(breaks[1:]) + 1).tolist(), len(breaks)]
        for first, last in pairwise(starts):
            if breaks[first]:
                self._balance.reset()
                self._averaged_command.reset()
            rows = slice(first, last)
            averaged[rows] = self._averaged_command.update(command[rows]) if self._averages else command[rows]
            balance[rows] = self._balance.update(
                self._period_ns / NS_PER_S,
                averaged[rows],
                grid.speed_rad_s[rows],
                known[rows] & np.isfinite(averaged[rows]),
            )
        return averaged, balance

    @property
    def _longest_step_ns(self) -> int:
        return self._period_ns + (self._period_ns - 1) // 2  # above one and a half periods samples are missing

    def _prediction(self, grid: Grid, predicted: Array, reading_range: Array, invalid_reason: Array) -> Prediction:
        averaged_command, balance = self._torque_balance(grid)
        nothing = np.zeros(0)
        return Prediction(
            fans=grid.fans,
            period_ns=grid.period_ns,
            t_ns=grid.t_ns,
            command=grid.command,
            measured_speed_rad_s=grid.speed_rad_s,
            predicted_speed_rad_s=predicted,
            sigma_rad_s=self._twin.sigma_rad_s,
            valid=invalid_reason == int(InvalidReason.NONE),
            invalid_reason=invalid_reason,
            twin=self._twin.card.name,
            torque_balance_command=balance,
            torque_balance_sigma_command=self._twin.balance.sigma_command,
            reading_range_rad_s=reading_range if self._averages else nothing,
            averaged_command=averaged_command if self._averages or self._drive is not None else nothing,
            reading_missing=grid.reading_missing,
        )


def _off_below(twin: TwinFile, standstill: Standstill) -> Array:
    """(fans,) as TrayTwin.off_below, where the friction of a fan is not above a command that turns it."""
    return np.minimum(twin.off_below, standstill.turning_command)


def _balance_of(twin: TwinFile, off_below: Array) -> TorqueBalance:
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
            highest_speed_rad_s=HIGHEST_SPEED * twin.card.top_speed_rad_s,
            off_below=off_below,
        )
    )


def build(context: Context) -> BuiltStage:
    """The core of one tray and its twin; without one in the configuration, of the twins that are learned.

    Raises:
        StageError: the twin cannot be used.
    """
    config, rules = context.config, context.decision_rules
    if context.tray.twin is None:

        def core_of(twin: TwinFile, first_t_ns: int, content: bytes) -> TwinIntegratorCore:
            return TwinIntegratorCore(twin, config, first_t_ns, decision_rules=rules, content=content)

        return BuiltStage(LearnedTwinIntegrator(context.tray, core_of))
    return BuiltStage(TwinIntegratorCore(load_twin(context), config, context.started_t_ns, decision_rules=rules))


def check(context: Context) -> list[str]:
    """What would keep the twin from being loaded."""
    if context.tray.twin is None:
        return []
    try:
        load_twin(context)
    except StageError as error:
        return [str(error)]
    return []


STAGE = Stage(
    name="twin_integrator",
    about="the healthy twin on the same commands as the fans",
    reads=("grid", "new_twin"),
    writes=("prediction", "twin"),
    config=TwinIntegratorConfig,
    build=build,
    check=check,
)

"""Prediction of the fans of a tray: a block of the grid in, the free runs and the torque balance of its fans out.

What a stage adds, samples that come again and the card of the twin, is in stages.twin_integrator.
"""

from __future__ import annotations

from collections.abc import Hashable
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
from pydantic import Field

from fantwin.pipeline.prediction.conditions import ConditionTracker, Ratios
from fantwin.pipeline.prediction.free_run import FreeRun, FreeRunInputs
from fantwin.pipeline.prediction.starting_fans import StartingFans
from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.pipeline.runtime.stage import StageConfig
from fantwin.schemas.blocks import present_columns
from fantwin.schemas.channels import measured_columns
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.messages import Array, Grid, Prediction
from fantwin.schemas.standstill import Standstill
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.column_state import ColumnState
from fantwin.scoring.expected_reading import AveragedCommand
from fantwin.scoring.torque_balance import BalanceModel, TorqueBalance

HOLD_LIMIT_NS = NS_PER_S // 2
"""the last command is held for so long without samples: later it may have changed unseen"""
LONGEST_BRIDGE = 1 << 16
"""grid samples; above HOLD_LIMIT_NS at 100 kHz a new start is faster than running through the loss"""
LARGEST_MOVE_S = 0.01  # times the width of the training range: a move of the command times the gap in which it was held
REASON = SimpleNamespace(**{each.name: np.uint8(each) for each in InvalidReason})
"""as blocks have them: an enum would make their arrays eight times as large"""
OUT_OF_RANGE_COUNT = "not_predicted_out_of_range"
HIGHEST_SPEED = 1.5  # times the top training speed: the balance is used up to there


class TwinIntegratorConfig(StageConfig):
    """Section `[twin_integrator]`. The tray names the twin."""

    warm_up_s: float = Field(default=3.0, ge=0, description="a free run is not valid for this long after its start")


class FanCounts(ColumnState):
    """Counters of each fan."""

    def __init__(self, fans: int) -> None:
        self._columns = {name: np.zeros(fans, np.int64) for name in ("free_runs", "diverged", OUT_OF_RANGE_COUNT)}

    def add(self, name: str, counted: Array) -> None:
        """Count those, (..., fans) of bool."""
        self._columns[name] += np.count_nonzero(counted.reshape(-1, counted.shape[-1]), axis=0)

    def totals(self) -> dict[str, int]:
        """Sums over all fans."""
        return {name: int(column.sum()) for name, column in self._columns.items()}

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return self._columns


class TrayIntegrator:
    """The free runs and the torque balance of one tray's fans."""

    def __init__(self, twin: TwinFile, config: TwinIntegratorConfig, names: FanNames = NO_NAMES) -> None:
        self.twin, self.config = twin, config
        reach_s = max(tacho.reach_s for tacho in twin.tachos)
        self._warm_up_ns = round((config.warm_up_s + reach_s) * NS_PER_S)
        low, high = twin.card.command_range
        self._largest_move = LARGEST_MOVE_S * (high - low)
        self._lowest_command, self._highest_command = twin.usable_commands
        self._standstill = twin.card.standstill
        self._off_below = twin.off_below if self._standstill is None else _off_below(twin, self._standstill)
        self._run = FreeRun(twin)
        self._starting: StartingFans | None = None
        if self._standstill is not None:
            self._starting = StartingFans(twin.fans, self._standstill, self._warm_up_ns, reach_s)
        self._balance = _balance_of(twin, self._off_below)
        conditions = twin.card.conditions
        self._conditions = ConditionTracker(conditions, twin.fans, names) if conditions else None
        self.missing_columns = ""
        """those that the twin needs and the last block did not have"""
        self._averages = any(tacho.window_s > 0.0 for tacho in twin.tachos)
        self._averaged_command = AveragedCommand(twin.tachos, 1.0)
        self._last_t_ns: int | None = None
        self._period_ns = 0
        self._in_announced_gap = False  # the last sample had the reason GAP or STALE for all fans
        self._missing_grid_samples = 0
        self._counts = FanCounts(twin.fans)

    def begin(self, period_ns: int, *, is_of_another_session: bool) -> None:
        """A block of this period comes next. Where another session of the resampler continues the grid, free runs and
        balances begin again."""
        if period_ns != self._period_ns:
            self._run.set_period(period_ns)
            self._averaged_command = AveragedCommand(self.twin.tachos, period_ns / NS_PER_S)
            self._balance.reset()
        elif is_of_another_session:
            self._run.stop(np.ones_like(self._run.running))
            self._balance.reset()
        self._period_ns = period_ns

    def joint_key(self, grid: Grid) -> Hashable:
        """Blocks of trays with equal keys can be predicted in one pass (pipeline.prediction.joint_tray_integrator).
        None: this one alone, because samples are missing, or the clock has restarted."""
        steps = np.diff(grid.t_ns, prepend=self._last_t_ns or 0)
        if (steps != grid.period_ns).any() or (grid.invalid_reason == REASON.CLOCK_RESTARTED).any():
            return None
        return self.twin.sha256, self.twin.fans, grid.period_ns, len(grid.t_ns), *present_columns(grid)

    def continue_from(self, of_tray: TrayIntegrator) -> None:
        """Continue the grid of another integrator; its states are copied into this one afterwards."""
        self.begin(of_tray._period_ns, is_of_another_session=False)
        self._last_t_ns = of_tray._last_t_ns

    def skip(self, grid: Grid) -> None:
        """Skip a block that a joint integrator has predicted; the states here are already those after it."""
        self._in_announced_gap, self._last_t_ns = bool(_is_silent(grid)[-1].all()), int(grid.t_ns[-1])
        if self._conditions is not None:
            self.missing_columns = self._conditions.missing(grid)

    @property
    def states(self) -> list[ColumnState]:
        """All that is kept of each fan."""
        starting = (self._starting,) if self._starting is not None else ()
        conditions = (self._conditions,) if self._conditions is not None else ()
        own = [self._balance, *self._averaged_command.states, self._counts]
        return [*self._run.states, *starting, *conditions, *own]

    def counters(self) -> dict[str, int]:
        """docs/explanation/prediction.md explains each counter. Those that are 0 are left out, except samples out of
        range."""
        counts = {**self._counts.totals(), "missing_grid_samples": self._missing_grid_samples}
        return {name: count for name, count in counts.items() if count or name == OUT_OF_RANGE_COUNT}

    def predict(self, grid: Grid) -> Prediction:
        """The prediction of a block of new samples."""
        run = self._run
        held = run.held_command
        ratios = self._ratios(grid)
        inputs = self._inputs(grid, ratios)
        predicted, reading_range = np.empty(grid.command.shape), np.empty(grid.command.shape)
        running, started_t_ns = np.empty(predicted.shape, np.bool_), np.empty(predicted.shape, np.int64)
        row = 0
        while row < len(predicted):
            if ratios is not None:
                run.set_density(ratios.density[row])
            held_before = held if row == 0 else inputs.held[row - 1]
            self._start_and_stop(row, grid, inputs, held_before)
            end = inputs.next_event(row, run.running)
            running[row:end], started_t_ns[row:end] = run.running, run.started_t_ns
            reading_rad_s, half_range_rad_s = self._advance(inputs.command[row:end])
            end = row + len(reading_rad_s)
            predicted[row:end], reading_range[row:end] = reading_rad_s, half_range_rad_s
            if end > row + 1:
                run.forget_readings(np.any(inputs.unknown[row + 1 : end], axis=0))
            row = end
        acting = grid.command if ratios is None else grid.command * ratios.command
        in_range = self._is_in_range(acting)
        beyond = np.isfinite(acting) & ~in_range  # where it is unknown, the free run uses the last known command
        if ratios is not None and self._conditions is not None:
            of_conditions = beyond & ratios.known & self._is_in_range(grid.command)
            self._conditions.note_beyond(grid.t_ns, ratios.torque, of_conditions)
            beyond |= ~ratios.known
        since_t_ns = np.maximum(started_t_ns, self._run.last_out_of_range(grid.t_ns, beyond))
        warm = running & (grid.t_ns[:, np.newaxis] - since_t_ns >= self._warm_up_ns)
        if self._starting is not None:
            warm &= self._starting.has_started_up(grid.t_ns, inputs.stopped)
        settled = warm | (running & ~in_range)
        in_range &= np.isfinite(predicted) | ~running
        self._counts.add(OUT_OF_RANGE_COUNT, settled & ~in_range)
        invalid_reason = np.where(settled, REASON.OUT_OF_RANGE, REASON.WARMING_UP)
        invalid_reason = np.where(settled & in_range, REASON.NONE, invalid_reason)
        if ratios is not None:
            invalid_reason = np.where(ratios.known, invalid_reason, REASON.CONDITIONS_UNKNOWN)
        judged = grid.valid
        if self._starting is not None:
            starting = self._starting.is_starting(inputs.stopped, warm)
            invalid_reason = np.where(starting, REASON.STARTING, invalid_reason)
            invalid_reason = np.where(inputs.stopped, REASON.STOPPED, invalid_reason)
            judged = judged | ((inputs.stopped | starting) & (grid.invalid_reason == REASON.NO_SPEED))
        invalid_reason = np.where(judged, invalid_reason, grid.invalid_reason).astype(np.uint8)
        # what gives neither a command nor a speed is not read; that is no fault of a tacho
        is_unread = ~np.isfinite(grid.command) & (invalid_reason == REASON.NO_SPEED)
        invalid_reason[is_unread] = REASON.OUT_OF_RANGE
        return self._prediction(grid, predicted, reading_range, invalid_reason, ratios)

    def problem(self) -> str:
        """Cause, other than their commands, that takes fans out of the twin's range now; empty for none."""
        if self._conditions is None or self._last_t_ns is None:
            return ""
        return self._conditions.problem(self._last_t_ns)

    def without_twin(self, grid: Grid) -> Prediction:
        """Prediction for a block for which the twin is not valid."""
        invalid_reason = np.where(grid.valid, REASON.NO_TWIN, grid.invalid_reason).astype(np.uint8)
        nothing = np.full(grid.command.shape, np.nan)
        return self._prediction(grid, nothing, nothing, invalid_reason, self._ratios(grid))

    def _is_in_range(self, command: Array) -> Array:
        in_range = (command >= self._lowest_command) & (command <= self._highest_command)
        return in_range & (command >= self._off_below)

    def _ratios(self, grid: Grid) -> Ratios | None:
        if self._conditions is None:
            return None
        self.missing_columns = self._conditions.missing(grid)
        return self._conditions.update(grid)

    def _inputs(self, grid: Grid, ratios: Ratios | None) -> FreeRunInputs:
        held_before = self._run.held_command
        silent = _is_silent(grid)
        known = ~silent & np.isfinite(grid.command)
        command, known_before_t_ns = self._run.hold(grid.t_ns, grid.command, known)
        gap_ns = grid.t_ns[:, np.newaxis] - known_before_t_ns - grid.period_ns
        overdue = gap_ns > HOLD_LIMIT_NS
        moved = np.diff(command, axis=0, prepend=held_before[np.newaxis])
        overdue |= known & (np.abs(moved) * gap_ns > self._largest_move * NS_PER_S)
        overdue |= grid.invalid_reason == REASON.CLOCK_RESTARTED
        usable = known & grid.valid & np.isfinite(grid.speed_rad_s)
        stopped = np.zeros(usable.shape, np.bool_)
        if self._standstill is not None:
            stopped = known & self._standstill.stops(grid.command, grid.speed_rad_s)
            overdue |= stopped
            usable &= ~stopped & (self._standstill.turns(grid.speed_rad_s) | ~self._standstill.drives(grid.command))
        if ratios is not None:
            usable &= ratios.known
        return FreeRunInputs(
            command=command if ratios is None else command * ratios.command,
            held=command,
            unknown=~known,
            overdue=overdue,
            stopped=stopped,
            usable=usable,
            missing=self._missing(grid.t_ns, np.all(silent, axis=1)),
            ratios=ratios,
        )

    def _missing(self, t_ns: Array, in_gap: Array) -> Array:
        """Number of grid samples missing before each, (n,). Counts those that were not announced as a gap."""
        period_ns = self._period_ns
        last_t_ns = t_ns[0] - period_ns if self._last_t_ns is None else self._last_t_ns
        since_ns = t_ns - np.concatenate(([last_t_ns], t_ns[:-1]))
        missing = np.zeros(len(t_ns), np.int64)
        for row in np.flatnonzero(since_ns > self._longest_step_ns).tolist():
            missing[row] = round(int(since_ns[row]) / period_ns) - 1
            if not (in_gap[row - 1] if row else self._in_announced_gap):
                self._missing_grid_samples += int(missing[row])
        self._in_announced_gap = bool(in_gap[-1])
        return missing

    def _start_and_stop(self, row: int, grid: Grid, inputs: FreeRunInputs, held_command: Array) -> None:
        """Stop and start free runs at this sample. held_command: (fans,), the command before it."""
        run, missing = self._run, int(inputs.missing[row])
        overdue = run.running & inputs.overdue[row]
        if missing or overdue.any():
            run.stop(overdue | (missing > LONGEST_BRIDGE))
            held = held_command if inputs.ratios is None else held_command * inputs.ratios.command[row]
            while missing > 0 and run.running.any():
                missing -= len(self._advance(np.tile(held, (missing, 1)))[0])
        run.forget_readings(inputs.unknown[row])
        starting = run.add_readings(inputs.usable[row], grid.speed_rad_s[row])
        if starting.any():
            run.start(starting, int(grid.t_ns[row]), inputs.command[row])
            self._counts.add("free_runs", starting)

    def _advance(self, command: Array) -> tuple[Array, Array]:
        reading_rad_s, half_range_rad_s, diverged = self._run.advance(command)
        self._counts.add("diverged", diverged)
        return reading_rad_s, half_range_rad_s

    def _torque_balance(self, grid: Grid, ratios: Ratios | None) -> tuple[Array, Array]:
        """The command averaged as the readings are, and the torque balance. Both (n, fans) in command units, at the
        twin's reference conditions.

        A command on the plateau of a drive counts as that at its end.

        They start again after missing samples.
        """
        restarted = (grid.invalid_reason == REASON.CLOCK_RESTARTED).any(axis=1)
        last_t_ns = grid.t_ns[0] if self._last_t_ns is None else self._last_t_ns
        breaks = (np.diff(grid.t_ns, prepend=last_t_ns) > self._longest_step_ns) | restarted
        known = grid.valid & np.isfinite(grid.speed_rad_s) & np.isfinite(grid.command)
        command = grid.command if self.twin.drive is None else self.twin.drive.raised(grid.command)
        speed_rad_s = grid.speed_rad_s
        if ratios is not None:
            command, speed_rad_s = command * ratios.command, speed_rad_s * ratios.density
            known &= ratios.known
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
                speed_rad_s[rows],
                known[rows] & np.isfinite(averaged[rows]),
            )
        return averaged, balance

    @property
    def _needs_temperature(self) -> bool:
        return self._conditions is not None and self._conditions.reference.temperature_c is not None

    @property
    def _longest_step_ns(self) -> int:
        return self._period_ns + (self._period_ns - 1) // 2  # above one and a half periods samples are missing

    def _prediction(
        self, grid: Grid, predicted: Array, reading_range: Array, invalid_reason: Array, ratios: Ratios | None
    ) -> Prediction:
        averaged_command, balance = self._torque_balance(grid, ratios)
        converts = self._averages or self.twin.drive is not None or ratios is not None
        self._last_t_ns = int(grid.t_ns[-1])
        nothing = np.zeros(0)
        return Prediction(
            fans=grid.fans,
            period_ns=grid.period_ns,
            t_ns=grid.t_ns,
            command=grid.command,
            measured_speed_rad_s=grid.speed_rad_s,
            predicted_speed_rad_s=predicted,
            sigma_rad_s=self.twin.sigma_rad_s,
            valid=invalid_reason == REASON.NONE,
            invalid_reason=invalid_reason,
            twin=self.twin.card.name,
            torque_balance_command=balance,
            torque_balance_sigma_command=self.twin.balance.sigma_command,
            reading_range_rad_s=reading_range if self._averages or self.twin.card.is_static else nothing,
            averaged_command=averaged_command if converts else nothing,
            reading_missing=grid.reading_missing,
            reading_repeated=grid.reading_repeated,
            air_density_ratio=ratios.density if ratios is not None and self._needs_temperature else nothing,
            **measured_columns(grid),
        )


def _is_silent(grid: Grid) -> Array:
    """Return where the line was silent, (n, fans)."""
    return (grid.invalid_reason == REASON.GAP) | (grid.invalid_reason == REASON.STALE)


def _off_below(twin: TwinFile, standstill: Standstill) -> Array:
    """TrayTwin.off_below (fans,), where the friction of a fan is not above a command that turns it."""
    return np.minimum(twin.off_below, standstill.turning_command)


def _balance_of(twin: TwinFile, off_below: Array) -> TorqueBalance:
    coefficients = {name: value for name, value in vars(twin.balance).items() if name != "sigma_command"}
    highest_rad_s = HIGHEST_SPEED * twin.card.top_speed_rad_s
    return TorqueBalance(BalanceModel(**coefficients, highest_speed_rad_s=highest_rad_s, off_below=off_below))

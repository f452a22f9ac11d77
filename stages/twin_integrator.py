"""Twin integrator: runs the healthy twin beside the fans, on the same commands.

Reads: topic `grid` (command, measured speed rad/s, uniform time).
Writes: topic `prediction` (measured and predicted speed rad/s, sigma rad/s), and `twin` (the model card) at start.
Timing: a prediction for every grid message, at once, block for block; one run of the graph a message, for all fans.

The prediction is a *free run*: it starts from the mean of the first measured speeds and is never corrected by a
measurement again. It needs commands only, so a fan without a reading does not disturb it. While the line is silent the
last command is held for `hold_limit_s`; then the commands are unknown, the free run ends, and a new one begins when
the line returns. Samples in the first `warm_up_s` of a free run are not valid (WARMING_UP).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

import numpy as np
from pydantic import Field

from pipeline.stage import Context, Core, Parts, Stage, StageConfig, StageError
from pipeline.twin_file import TwinFile
from schemas.messages import Array, Grid, ModelCard, Prediction, WhyNot

NS_PER_S = 1_000_000_000
RANGE_MARGIN = 0.05  # of the range's width: so far beyond the commands it was made from a twin is still believed
LONGEST_BRIDGE = 1 << 16  # grid samples; more than half a second at 100 kHz takes longer to run than to start anew
RATE_TOLERANCE = 0.01  # a card gives the rate as it was measured


class TwinIntegratorConfig(StageConfig):
    """Section `[twin_integrator]`. The twin itself is named by the tray."""

    start_samples: int = Field(default=5, ge=1, description="measured speeds whose mean a free run starts from")
    warm_up_s: float = Field(default=3.0, ge=0, description="how long a free run is not judged after its start")
    hold_limit_s: float = Field(default=0.5, ge=0, description="how long the last command is held on a silent line")


class FreeRun:
    """The free run of each fan: when it starts and stops, and the state it carries. All arrays by fan."""

    def __init__(self, twin: TwinFile, config: TwinIntegratorConfig) -> None:
        self._twin = twin
        self._start_samples = config.start_samples
        self._hold_limit_ns = round(config.hold_limit_s * NS_PER_S)
        fans = twin.fans
        self.running = np.zeros(fans, np.bool_)
        self.started_t_ns = np.zeros(fans, np.int64)
        self.held_command = np.full(fans, twin.command_range[0])
        self._known_t_ns = np.zeros(fans, np.int64)  # when the command was last known
        self._readings = np.zeros(fans, np.int64)  # towards a start
        self._sum_rad_s = np.zeros(fans)
        self._state = twin.initial_state(np.zeros(fans), self.held_command)

    def cut(self, t_ns: int, step_ns: int) -> Array:
        """Whose command, at this sample, has been held in place of an unknown one for longer than allowed."""
        return self.running & (t_ns - self._known_t_ns - step_ns > self._hold_limit_ns)

    def stop(self, fans: Array) -> None:
        """End the free run of some fans; the next one starts anew from measured speeds."""
        self.running &= ~fans
        self._forget_readings(fans)

    def note(self, t_ns: int, command: Array, known: Array, speed_rad_s: Array) -> Array:
        """Take a sample. Returns which fans have now the readings that a start needs."""
        self._known_t_ns[known] = t_ns
        self.held_command = np.where(known, command, self.held_command)
        self._forget_readings(~known)
        reads = known & ~self.running & np.isfinite(speed_rad_s)
        self._readings[reads] += 1
        self._sum_rad_s[reads] += speed_rad_s[reads]
        return reads & (self._readings >= self._start_samples)

    def start(self, fans: Array, t_ns: int) -> None:
        """Begin the free run of some fans at this sample."""
        speed = np.where(fans, self._sum_rad_s / np.maximum(self._readings, 1), 0.0)
        initial = self._twin.initial_state(speed, self.held_command)
        self._state = np.where(fans[:, np.newaxis], initial, self._state)
        self.started_t_ns[fans] = t_ns
        self.running |= fans
        self._forget_readings(fans)

    def advance(self, command: Array, step_s: Array) -> tuple[Array, Array]:
        """Run over a block. command: (n, fans). Returns speeds (n, fans), NaN where none runs, and who diverged."""
        if not len(command) or not self.running.any():
            return np.full(command.shape, np.nan), np.zeros_like(self.running)
        speed_rad_s, state = self._twin.advance(self._state, command, step_s)
        diverged = self.running & ~(np.isfinite(speed_rad_s).all(axis=0) & np.isfinite(state).all(axis=1))
        self._state = np.where((self.running & ~diverged)[:, np.newaxis], state, self._state)
        predicted = np.where(self.running & np.isfinite(speed_rad_s), speed_rad_s, np.nan)
        self.stop(diverged)
        return predicted, diverged

    def _forget_readings(self, fans: Array) -> None:
        self._readings[fans] = 0
        self._sum_rad_s[fans] = 0.0


class TwinIntegratorCore(Core):
    """One tray's twin."""

    def __init__(self, twin: TwinFile, config: TwinIntegratorConfig, started_t_ns: int) -> None:
        self._twin = twin
        self._warm_up_ns = round(config.warm_up_s * NS_PER_S)
        low, high = twin.command_range
        margin = RANGE_MARGIN * (high - low)
        self._lowest_command, self._highest_command = low - margin, high + margin
        self._run = FreeRun(twin, config)
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
        if grid.step_ns != self._step_ns:
            self._run.stop(np.ones_like(self._run.running))
            self._step_ns = grid.step_ns
        if self._twin.is_discrete and abs(grid.step_ns * self._twin.rate_hz / NS_PER_S - 1) > RATE_TOLERANCE:
            self._problem = (
                f"twin {self._twin.name} holds at {self._twin.rate_hz:g} Hz only, the grid has "
                f"{NS_PER_S / grid.step_ns:g} Hz: set [resampler] rate_hz = {self._twin.rate_hz:g}"
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
        """docs/deciding.md says what each counts."""
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
        return Grid(
            fans=grid.fans,
            step_ns=grid.step_ns,
            t_ns=grid.t_ns[new],
            command=grid.command[new],
            speed_rad_s=grid.speed_rad_s[new],
            valid=grid.valid[new],
            why_not=grid.why_not[new],
        )

    def _predict(self, grid: Grid) -> Prediction:
        run = self._run
        shape = grid.command.shape
        silent = np.isin(grid.why_not, (WhyNot.GAP, WhyNot.STALE))
        known = ~silent & np.isfinite(grid.command)
        speed = np.where(grid.valid, grid.speed_rad_s, np.nan)
        used, predicted = np.empty(shape), np.empty(shape)
        running, started_t_ns = np.empty(shape, np.bool_), np.empty(shape, np.int64)
        done = 0
        for k, t_ns in enumerate(grid.t_ns.tolist()):
            missing = self._missing_before(t_ns)
            cut = run.cut(t_ns, grid.step_ns)
            if missing or cut.any():
                predicted[done:k] = self._advance(used[done:k])
                done = k
                run.stop(cut | (missing > LONGEST_BRIDGE))
                self._advance(np.tile(run.held_command, (missing if run.running.any() else 0, 1)))
            starting = run.note(t_ns, grid.command[k], known[k], speed[k])
            if starting.any():
                predicted[done:k] = self._advance(used[done:k])
                done = k
                run.start(starting, t_ns)
                self._counts["free_runs"] += int(starting.sum())
            used[k] = run.held_command
            running[k] = run.running
            started_t_ns[k] = run.started_t_ns
            self._last_t_ns = t_ns
            self._line_is_silent = bool(silent[k].all())
        predicted[done:] = self._advance(used[done:])
        settled = running & (grid.t_ns[:, np.newaxis] - started_t_ns >= self._warm_up_ns)
        in_range = (grid.command >= self._lowest_command) & (grid.command <= self._highest_command)
        in_range &= np.isfinite(predicted) | ~running
        self._counts["out_of_range"] += int((settled & ~in_range).sum())
        why_not = np.where(settled, WhyNot.OUT_OF_RANGE, WhyNot.WARMING_UP)
        why_not = np.where(settled & in_range, WhyNot.NONE, why_not)
        why_not = np.where(grid.valid, why_not, grid.why_not).astype(np.uint8)
        return self._prediction(grid, predicted, why_not)

    def _missing_before(self, t_ns: int) -> int:
        """How many grid samples are missing before this one; counts those that no gap of the line explains."""
        if self._last_t_ns is None:
            return 0
        missing = round((t_ns - self._last_t_ns) / self._step_ns) - 1
        if missing > 0 and not self._line_is_silent:
            self._counts["lost_grid_samples"] += missing
        return max(missing, 0)

    def _advance(self, command: Array) -> Array:
        speed_rad_s, diverged = self._run.advance(command, np.full(len(command), self._step_ns / NS_PER_S))
        self._counts["diverged"] += int(diverged.sum())
        return speed_rad_s

    def _without_twin(self, grid: Grid) -> Prediction:
        why_not = np.where(grid.valid, WhyNot.NO_TWIN, grid.why_not).astype(np.uint8)
        return self._prediction(grid, np.full(grid.command.shape, np.nan), why_not)

    def _prediction(self, grid: Grid, predicted_speed_rad_s: Array, why_not: Array) -> Prediction:
        return Prediction(
            fans=grid.fans,
            step_ns=grid.step_ns,
            t_ns=grid.t_ns,
            command=grid.command,
            measured_speed_rad_s=grid.speed_rad_s,
            predicted_speed_rad_s=predicted_speed_rad_s,
            sigma_rad_s=self._twin.sigma_rad_s,
            valid=why_not == WhyNot.NONE,
            why_not=why_not,
            twin=self._twin.name,
        )


def build(context: Context) -> Parts:
    """The core of one tray and its twin.

    Raises:
        StageError: the tray names no twin, or one that cannot be used.
    """
    return Parts(TwinIntegratorCore(_twin(context), context.config, context.started_t_ns))


def check(context: Context) -> list[str]:
    """What keeps the twin from being loaded."""
    try:
        _twin(context)
    except StageError as error:
        return [str(error)]
    return []


def _twin(context: Context) -> TwinFile:
    tray = context.tray
    if tray.twin is None:
        raise StageError(f'tray {tray.name} has no twin: set [[tray]] twin = "FILE.onnx"')
    return TwinFile.load(context.resolve(tray.twin), tray.fans)


STAGE = Stage(
    name="twin_integrator",
    about="the healthy twin beside the fans",
    reads=("grid",),
    writes=("prediction", "twin"),
    config=TwinIntegratorConfig,
    build=build,
    check=check,
)

"""Twins with a known equation of motion, the cores that integrate them, and the grids that they are fed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fantwin.pipeline.prediction.twin_file import TwinFile
from fantwin.schemas.blocks import cut, join
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.messages import Grid, Prediction
from fantwin.schemas.tacho import tacho_of_each_fan
from fantwin.stages.twin_integrator import TwinIntegratorConfig, TwinIntegratorCore
from fantwin.twin.models import physics
from fantwin.twin.models.integration import step_through
from fantwin.twin.models.lag import effective_command
from fantwin.twin.models.physical import PhysicalModel
from fantwin.twin.models.physics import LAG
from tests.support.made_messages import filled
from tests.support.twin_files import PARAMETERS, made_up_card, still_balance

EPOCH_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
NAN = float("nan")
Floats = NDArray[np.float64]


def run_freely(state: Floats, command: Floats, period_s: Floats) -> tuple[Floats, Floats]:
    """The lag and the equation of motion themselves, sample by sample in NumPy."""
    parameters = np.tile(PARAMETERS, (command.shape[1], 1))
    acting, lagged = effective_command(command, period_s[:, np.newaxis], parameters[:, LAG], state[:, 1])
    speed, last = step_through(lambda w, u: physics.acceleration(w, u, parameters), state[:, 0], acting, period_s)
    return speed, np.column_stack((last, lagged))


def physical_twin(fans: int = 1, fixed_rate: bool = False, **changes: Any) -> TwinFile:
    def advance(state: Floats, command: Floats, period_s: Floats) -> tuple[Floats, Floats]:
        assert np.isfinite(state).all()
        assert np.isfinite(command).all()
        return run_freely(state, command, period_s)

    made_up = replace(made_up_card(PhysicalModel(), fans), speed_range_rad_s=(0.0, 1e9))
    card = replace(made_up, name="fake", fixed_rate=fixed_rate, **changes)
    return TwinFile(
        card=card,
        card_json="{}",
        sha256="0",
        sigma_rad_s=np.full(fans, 3.0),
        balance=still_balance(fans),
        tachos=tacho_of_each_fan(card.tacho, fans),
        drive=card.drive,
        advance_with=lambda _parameters: advance,
        parameters=np.zeros((fans, 0)),
    )


def twin_with_friction(friction: float, fans: int = 1) -> TwinFile:
    """Commands below it do not turn the rotor; the balance has no lag."""
    twin = physical_twin(fans)
    balance = replace(twin.balance, friction=np.full(fans, friction), lag_s=np.zeros(fans))
    return replace(twin, balance=balance)


def unstable_twin(fans: int, runs_away_to_rad_s: float) -> TwinFile:
    """The speed of a fan is this from the sample after its command exceeds 85."""

    def advance(state: Floats, command: Floats, period_s: Floats) -> tuple[Floats, Floats]:
        assert np.isfinite(state).all()
        speed, now = np.empty_like(command), state[:, 0]
        for k, wanted in enumerate(command):
            speed[k], now = now, np.where(wanted > 85, runs_away_to_rad_s, 0.9 * now + wanted)
        return speed, np.column_stack((now, command[-1]))

    return replace(physical_twin(fans), advance_with=lambda _: advance)


def core_of(twin: TwinFile | None = None, warm_up_s: float = 0.0) -> TwinIntegratorCore:
    return TwinIntegratorCore(twin or physical_twin(), TwinIntegratorConfig(warm_up_s=warm_up_s), EPOCH_NS)


def grid_of(command: Floats, speed: Floats | None = None, *, first: int = 0, period_ns: int = STEP_NS) -> Grid:
    """command, speed: (n, fans) or (n,). Without a speed the fans stand."""
    command = command.reshape(len(command), -1)
    speed = np.zeros_like(command) if speed is None else speed.reshape(len(command), -1)
    valid = np.isfinite(speed)
    t_ns = EPOCH_NS + (first + np.arange(len(command))) * period_ns
    columns = {"command": command, "speed_rad_s": speed, "valid": valid}
    columns["invalid_reason"] = np.where(valid, InvalidReason.NONE, InvalidReason.NO_SPEED)
    return filled(Grid, *command.shape, period_ns=period_ns, t_ns=t_ns, **columns)


def silent(samples: int, first: int, command: float, why: InvalidReason = InvalidReason.GAP) -> Grid:
    """The grid of the resampler while the link is silent: the command held, no speed."""
    grid = grid_of(np.full(samples, command), np.full(samples, NAN), first=first)
    grid.invalid_reason[:] = why
    return grid


def split(grid: Grid, size: int) -> list[Grid]:
    samples = len(grid.t_ns)
    return [cut(grid, k, min(k + size, samples)) for k in range(0, samples, size)]


def feed(core: TwinIntegratorCore, grids: Iterable[Grid]) -> Prediction:
    """All predictions of the grids, as one."""
    found = [m for grid in grids for m in core.step(grid) if isinstance(m, Prediction)]
    return join(found)


def stairs(samples: int, fans: int = 1, seed: int = 2) -> Floats:
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(10, 90, (samples // 50 + 1, fans)), 50, axis=0)[:samples]

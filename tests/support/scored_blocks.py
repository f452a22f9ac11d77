"""Synthetic predictions, scorer cores, and what the cores emit for them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fantwin.pipeline.tray_scoring.healthy_twin import HealthyTwin
from fantwin.pipeline.tray_scoring.scorer_config import ScorerConfig
from fantwin.pipeline.tray_scoring.scorer_core import ScorerCore
from fantwin.pipeline.tray_scoring.snapshot_store import SnapshotStore
from fantwin.schemas.enums import Action, InvalidReason
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Prediction, Request, Score, ScorerSnapshot
from fantwin.schemas.standstill import Standstill
from fantwin.schemas.tacho import INSTANTANEOUS, Tacho, tacho_of_each_fan
from fantwin.schemas.units import SpeedUnit
from fantwin.scoring.diagnosis.ranked_causes import Advice, SteadyFan
from fantwin.scoring.model.operation import Fans

EPOCH_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
SIGMA = 4.0
SIGMA_COMMAND = 0.5
TWIN_SPEED, TOP_SPEED = 300.0, 400.0
NEEDED = 50.0
"""command at which the synthetic fan runs at TWIN_SPEED"""
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


FRICTION, VISCOUS = 5.0, 0.05
DRAG = (NEEDED - FRICTION - VISCOUS * TWIN_SPEED) / TWIN_SPEED**2


def model_fans(count: int, *, balance_filter_per_s: float, **given: Any) -> Fans:
    """Fans whose command, of 0 to 100, is a torque, with exact tachos but for what is given, of each or of all."""
    zeros = dict.fromkeys(("friction", "pulse_rad_s", "held_s", "timing_s"), 0.0)
    flags = dict.fromkeys(("has_own_drive", "may_have_plateau", "prefers_balance"), False)
    each = {**zeros, **flags, "lowest_command": np.nan, "adjoins": True, "may_be_ahead": True, **given}
    columns = {name: np.broadcast_to(value, count).copy() for name, value in each.items()}
    return Fans(commands=100.0, balance_filter_per_s=balance_filter_per_s, **columns)


def twin_of(
    fans: int = 1,
    *,
    sha256: str = "twin",
    tachos: Sequence[Tacho] = INSTANTANEOUS,
    standstill: Standstill | None = None,
    **more: Any,
) -> HealthyTwin:
    """Fans that need NEEDED for TWIN_SPEED, with a time constant of 0.6 s."""
    of_each = tacho_of_each_fan(tachos, fans)

    of_model = model_fans(
        fans,
        top_rad_s=TOP_SPEED,
        inertia=0.1,
        viscous=VISCOUS,
        drag=DRAG,
        friction=FRICTION,
        noise_rad_s=SIGMA,
        pulse_rad_s=[tacho.resolution_rad_s if tacho.kind == "count" else 0.0 for tacho in of_each],
        held_s=[tacho.held_s for tacho in of_each],
        adjoins=[tacho.window_s == tacho.held_s for tacho in of_each],
        timing_s=0.02,
        coasts_s=2.0,
        balance_noise=SIGMA_COMMAND,
        balance_filter_per_s=3.0,
    )
    steady = [SteadyFan(VISCOUS, DRAG, FRICTION, TOP_SPEED)] * fans
    advice = Advice("%", 10.0, 100.0)
    return HealthyTwin(sha256, of_model, steady, of_each, advice, standstill, is_calibrated=True, **more)


def core_of(
    fans: int = 1,
    unit: SpeedUnit = "rad/s",
    *,
    snapshot_store: SnapshotStore | None = None,
    is_replayed: bool = False,
    is_learned: bool = False,
    started_t_ns: int | None = None,
    config: Mapping[str, Any] | None = None,
    names: FanNames = NO_NAMES,
    **twin: Any,
) -> ScorerCore:
    """A scorer of `twin_of` these."""
    settings = ScorerConfig.model_validate(config or {})
    return ScorerCore(
        fans,
        unit,
        settings,
        twin_of(fans, **twin),
        snapshot_store,
        started_t_ns=started_t_ns,
        is_learned=is_learned,
        is_replayed=lambda: is_replayed,
        names=names,
    )


def noise_of(samples: int, fans: int = 1, seed: int = 1) -> Floats:
    """(samples, fans) healthy residuals."""
    return np.random.default_rng(seed).normal(0.0, SIGMA, (samples, fans))


def prediction_of(
    residual: Floats,
    valid: Bools | None = None,
    *,
    balance: Floats | float = 0.0,
    first: int = 0,
    period_ns: int = STEP_NS,
    producer: str = "integrator-1",
) -> Prediction:
    """Predictions of a twin that predicts TWIN_SPEED. residual, valid, balance: (n, fans) or (n,)."""
    residual = np.asarray(residual, float).reshape(len(residual), -1)
    valid = np.ones(residual.shape, np.bool_) if valid is None else valid.reshape(residual.shape)
    extra = np.broadcast_to(
        np.asarray(balance, float).reshape(-1, 1) if np.ndim(balance) == 1 else balance, residual.shape
    )
    return Prediction(
        header=Header(producer, 0, "tray1"),
        fans=residual.shape[1],
        period_ns=period_ns,
        t_ns=EPOCH_NS + (first + np.arange(len(residual))) * period_ns,
        command=NEEDED + extra,
        measured_speed_rad_s=np.where(valid, TWIN_SPEED + residual, np.nan),
        predicted_speed_rad_s=np.full(residual.shape, TWIN_SPEED),
        sigma_rad_s=np.full(residual.shape[1], SIGMA),
        valid=valid,
        invalid_reason=np.where(valid, InvalidReason.NONE, InvalidReason.GAP).astype(np.uint8),
        twin="t",
        torque_balance_command=np.where(valid, extra, np.nan),
        torque_balance_sigma_command=np.full(residual.shape[1], SIGMA_COMMAND),
    )


def learned(fans: int = 1, *, seconds: float = 30.0, **of_core: Any) -> ScorerCore:
    """A core of `core_of` whose fans were healthy up to EPOCH_NS."""
    if of_core.keys() <= {"unit"}:
        return deepcopy(_learned_once(fans, seconds, **of_core))
    return _after_healthy(core_of(fans, **of_core), fans, seconds)


@cache
def _learned_once(fans: int, seconds: float, **of_core: Any) -> ScorerCore:
    """It is copied: to learn takes longer than most tests."""
    return _after_healthy(core_of(fans, **of_core), fans, seconds)


def _after_healthy(core: ScorerCore, fans: int, seconds: float) -> ScorerCore:
    samples = round(seconds * 100)
    core.step(prediction_of(noise_of(samples, fans, 9), first=-samples))
    return core


def request_of(
    action: Action, fan: int = 0, *, producer: str = "operator-1", sequence: int = 0, **more: Any
) -> Request:
    return Request(
        header=Header(producer, sequence, "tray1"), t_ns=EPOCH_NS, action=action, fan=fan, operator_name="Ann", **more
    )


def feed(core: ScorerCore, items: Iterable[Prediction | Request]) -> tuple[list[Score], list[Alarm]]:
    """The scores and alarms that a core emits for predictions and requests."""
    messages = [message for item in items for message in core.step(item)]
    return [m for m in messages if isinstance(m, Score)], [m for m in messages if isinstance(m, Alarm)]


def snapshot_of(core: ScorerCore) -> ScorerSnapshot:
    """The snapshot that it saves at the end."""
    (snapshot,) = (each for each in core.close() if isinstance(each, ScorerSnapshot))
    return snapshot


SECOND = 100
"""samples"""
STEP = -0.1 * TWIN_SPEED
TIME_CONSTANT_S = 0.4


def with_step(seconds: float, at_s: float, fans: int = 1, fan: int = 0, size: float = STEP, seed: int = 1) -> Floats:
    """Residuals of healthy fans of which one is slower by a step, to which its rotor goes soon."""
    residual = noise_of(round(seconds * SECOND), fans, seed)
    since_s = np.arange(len(residual)) / SECOND - at_s
    residual[:, fan] += size * -np.expm1(-since_s.clip(0.0) / TIME_CONSTANT_S)
    return residual

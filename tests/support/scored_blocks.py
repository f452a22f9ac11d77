"""Synthetic predictions, scorer cores, and what the cores emit for them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipeline.runtime.healthy_twin import HealthyTwin, ScorerConfig, limits_in_force
from pipeline.runtime.snapshot_store import SnapshotStore
from schemas.enums import Action, InvalidReason
from schemas.header import Header
from schemas.messages import Alarm, Prediction, Request, Score, ScorerSnapshot
from schemas.tacho import INSTANTANEOUS, Tacho
from schemas.units import SpeedUnit
from scoring.diagnosis.regression_window import HealthyBalance
from stages.scorer import ScorerCore

EPOCH_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
SIGMA = 4.0
SIGMA_COMMAND = 0.5
TWIN_SPEED = 300.0
NEEDED = 50.0
"""command at which the synthetic fan runs at TWIN_SPEED"""
CALIBRATION: dict[str, Any] = {
    "speed": {},
    "balance": {},
    "detectors": {
        "speed_smoothed": {"limit": 4.0},
        "speed_drift": {"limit": 6.0, "period_s": 0.01},
        "speed_variance_growth": {"limit": 3.0},
        "balance_smoothed": {"limit": 4.0},
        "balance_drift": {"limit": 6.0, "period_s": 0.01},
        "balance_variance_growth": {"limit": 3.0},
        "sensor": {"stuck_s": 2.0, "missing_share": 0.5},
    },
    "timing": {"smoothing_s": 0.1, "baseline_s": 0.5, "adaptation_s": 30.0, "on_delay_s": 0.05},
}
NO_BASELINES = {
    name: {"baseline": {"commissioning_limit_sigmas": 0.0, "adaptation_limit_sigmas": 0.0}}
    for name in ("speed", "balance")
}
LIVELY = CALIBRATION | NO_BASELINES
"""limits with which no part of a test's residual becomes a baseline"""
Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


def balance_of_a_fan() -> HealthyBalance:
    """A fan that needs NEEDED for TWIN_SPEED."""
    return HealthyBalance(
        inertia=0.1,
        viscous=0.05,
        drag=(NEEDED - 5.0 - 0.05 * TWIN_SPEED) / TWIN_SPEED**2,
        friction=5.0,
        lag_s=0.0,
        covariance=np.diag(np.square([0.001, 0.001, 1e-6, 0.1])),
        filter_rate_per_s=3.0,
        sigma_command=SIGMA_COMMAND,
        autocorrelation_time_s=0.02,
        lowest_speed_rad_s=20.0,
    )


def core_of(
    fans: int = 1,
    unit: SpeedUnit = "rad/s",
    *,
    calibration: Mapping[str, Any] | None = None,
    sha256: str = "twin",
    snapshot_store: SnapshotStore | None = None,
    tachos: tuple[Tacho, ...] = INSTANTANEOUS,
    is_replayed: bool = False,
    started_t_ns: int | None = None,
    **config: Any,
) -> ScorerCore:
    """Without a calibration: limits on the speed residual alone, 2 SIGMA."""
    settings = ScorerConfig.model_validate(config)
    limits = limits_in_force(settings, calibration)
    twin = HealthyTwin(sha256, limits, [balance_of_a_fan()] * fans, "%", tachos=tachos)
    return ScorerCore(
        fans, unit, settings, twin, snapshot_store, started_t_ns=started_t_ns, is_replayed=lambda: is_replayed
    )


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


def commissioned(core: ScorerCore, fans: int = 1, seconds: float = 11.0) -> ScorerCore:
    """A core whose fans were healthy up to EPOCH_NS, longer than commissioning needs."""
    samples = round(seconds * 100) + 1
    wobble = 1e-9 * (np.arange(samples) % 7 - 3.0)[:, np.newaxis]  # a tacho that repeats itself is stuck
    core.step(prediction_of(np.tile(wobble, (1, fans)).astype(np.float64), first=-samples))
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
    (snapshot,) = core.close()
    return snapshot

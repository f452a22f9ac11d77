"""What a twin finds, for people: the drops of a steady speed that raise an alarm within a time.

The scorer itself is asked, without noise: fans run steadily, then each drops by another share of its speed.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fantwin.pipeline.learning.versions import Drop
from fantwin.pipeline.prediction.tray_twin import TrayTwin, load_tray_twin
from fantwin.pipeline.replay.offline.calibration_of_twin import calibration_in
from fantwin.pipeline.replay.offline.healthy_runs import Limit
from fantwin.pipeline.tray_scoring.healthy_twin import modelled_fans
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.messages import Array, Prediction
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.calibration.calibration import Calibration
from fantwin.scoring.model.bins import Bins, bin_ns_of
from fantwin.scoring.model.operation import Fans

SPEEDS = (0.25, 0.5, 0.75, 1.0)
"""shares of the top speed of training"""
DROPS = np.geomspace(0.002, 1.0, 11)
"""shares of the speed"""
WITHIN_S = (1.0, 10.0, 60.0)
_TIMES = ("within_1_s", "within_10_s", "within_60_s")
STEADY_S = 60.0
"""time before the drop; a fan that has run for longer is known better"""


def drops_found(path: Path, rad_s_per_unit: float) -> list[Drop]:
    """The drops at some speeds up to the top speed of training, of the fan whose readings vary most; none without a
    calibration.

    Raises:
        UserError: the twin or its calibration cannot be read.
    """
    twin = load_tray_twin(path)
    calibration = calibration_in(path, twin)
    if calibration is None:
        return []
    speeds = [share * twin.card.top_speed_rad_s / rad_s_per_unit for share in SPEEDS]
    return [
        Drop.model_validate(
            {"speed": speed}
            | {name: share * speed if np.isfinite(share) else None for name, share in zip(_TIMES, shares, strict=True)}
        )
        for speed, shares in zip(speeds, smallest_drops(twin, calibration).tolist(), strict=True)
    ]


def smallest_drops(twin: TrayTwin, calibration: Calibration) -> Array:
    """(SPEEDS, WITHIN_S) shares of the speed; infinite where not even standstill is found in that time."""
    each = modelled_fans(twin)
    fan = int(np.argmax(np.hypot(each.noise_rad_s, each.pulse_rad_s)))
    count = len(SPEEDS) * len(DROPS)
    fans = each.of(np.full(count, fan))
    period_ns = round(NS_PER_S / twin.card.rate_hz)
    bin_ns = bin_ns_of(period_ns, float(fans.held_s.min()))
    limit = Limit(calibration.priors, 86400.0 / calibration.false_alarms_per_day).free()
    decision = limit.decision(fans, bin_ns, period_ns)
    bins = Bins(bin_ns, fans.top_rad_s, fans.reads_balance, None)
    speed_rad_s, drop = np.repeat(SPEEDS, len(DROPS)) * fans.top_rad_s, np.tile(DROPS, len(SPEEDS))
    scores: list[Array] = []
    for one in bins.take(dropping(twin, fans, speed_rad_s, drop)):
        decision.take(one)
        if one.t_ns > STEADY_S * NS_PER_S:
            scores.append(decision.score * limit.factor / calibration.limit_factor)
    ends = [max(1, round(seconds * NS_PER_S / bin_ns)) for seconds in WITHIN_S]
    highest = np.stack([np.max(scores[:end], axis=0).reshape(len(SPEEDS), -1) for end in ends], axis=1)
    return np.array([[_crossing(at_speed) for at_speed in within] for within in highest])


def _crossing(score: Array) -> float:
    """The drop whose score is 1. score: of each of DROPS."""
    above = np.flatnonzero(score >= 1.0)
    if not len(above):
        return np.inf
    to = max(int(above[0]), 1)
    share = np.interp(1.0, score[to - 1 : to + 1], (0.0, 1.0))
    return float(DROPS[to - 1] * (DROPS[to] / DROPS[to - 1]) ** share)


def dropping(twin: TrayTwin, fans: Fans, speed_rad_s: Array, drop: Array) -> Prediction:
    """Fans whose readings are exact, and which drop by these shares of their speed after STEADY_S."""
    t_s = np.arange(round((STEADY_S + WITHIN_S[-1]) * twin.card.rate_hz)) / twin.card.rate_hz
    low, high = twin.card.command_range
    shape = len(t_s), len(speed_rad_s)
    after = (t_s >= STEADY_S)[:, np.newaxis]
    return Prediction(
        fans=shape[1],
        period_ns=round(NS_PER_S / twin.card.rate_hz),
        t_ns=np.round(t_s * NS_PER_S).astype(np.int64),
        command=np.broadcast_to(low + (high - low) * speed_rad_s / fans.top_rad_s, shape),
        measured_speed_rad_s=speed_rad_s * (1.0 - drop * after),
        predicted_speed_rad_s=np.broadcast_to(speed_rad_s, shape),
        sigma_rad_s=fans.noise_rad_s,
        valid=np.ones(shape, np.bool_),
        invalid_reason=np.full(shape, InvalidReason.NONE, np.uint8),
        torque_balance_command=np.full(shape, np.nan),
        torque_balance_sigma_command=fans.balance_noise,
        reading_range_rad_s=np.broadcast_to(0.5 * fans.pulse_rad_s, shape),
    )

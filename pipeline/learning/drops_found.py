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
from fantwin.pipeline.tray_scoring.healthy_twin import known_of
from fantwin.schemas.enums import InvalidReason
from fantwin.schemas.messages import Array, Prediction
from fantwin.schemas.units import NS_PER_S, RAD_S_PER_UNIT, period_in_words
from fantwin.scoring.model.bins import Bins, bin_ns_of
from fantwin.scoring.model.operation import Fans
from fantwin.scoring.model.wrong_readings import FEWEST

SPEEDS = (0.25, 0.5, 0.75, 1.0)
"""shares of the top speed of training"""
STATIC_SPEED = 2
"""which of them stands for all in a line"""
DROPS = np.geomspace(0.002, 1.0, 11)
"""shares of the speed"""
WITHIN_S = (1.0, 10.0, 60.0)
STATIC_WITHIN_S = (*WITHIN_S, 600.0)
_TIMES = ("within_1_s", "within_10_s", "within_60_s", "within_600_s")
STEADY_S, STEADY_SAMPLES = 60.0, 20
"""time before the drop, and least number of samples; a fan that has run for longer is known better"""


def drops_found(path: Path, rad_s_per_unit: float) -> list[Drop]:
    """The drops at some speeds up to the top speed of training, of the fan whose readings vary most; none without a
    calibration.

    Raises:
        UserError: the twin or its calibration cannot be read.
    """
    twin = load_tray_twin(path)
    if calibration_in(path, twin) is None:
        return []
    speeds = [share * twin.card.top_speed_rad_s / rad_s_per_unit for share in SPEEDS]
    return [
        Drop.model_validate(
            {"speed": speed}
            | {name: share * speed if np.isfinite(share) else None for name, share in zip(_TIMES, shares, strict=False)}
        )
        for speed, shares in zip(speeds, smallest_drops(twin).tolist(), strict=True)
    ]


def smallest_drops(twin: TrayTwin) -> Array:
    """(SPEEDS, WITHIN_S or STATIC_WITHIN_S) shares of the speed; infinite where not even standstill is found in that
    time."""
    known = known_of(twin)
    each = known.fans
    fan = int(np.argmax(np.hypot(each.noise_rad_s, each.pulse_rad_s)))
    count = len(SPEEDS) * len(DROPS)
    fans = each.of(np.full(count, fan))
    period_ns = round(NS_PER_S / twin.card.rate_hz)
    bin_ns = bin_ns_of(period_ns, float(fans.held_s.min()))
    limit = Limit(known.priors, known.declared_s).free()
    decision = limit.decision(fans, bin_ns, period_ns)
    bins = Bins(bin_ns, fans.top_rad_s, fans.reads_balance, None)
    speed_rad_s, drop = np.repeat(SPEEDS, len(DROPS)) * fans.top_rad_s, np.tile(DROPS, len(SPEEDS))
    scores: list[Array] = []
    within_s = STATIC_WITHIN_S if twin.card.is_static else WITHIN_S
    for one in bins.take(dropping(twin, fans, speed_rad_s, drop, within_s[-1])):
        decision.take(one)
        if one.t_ns > _steady_s(twin) * NS_PER_S:
            scores.append(decision.score * limit.factor / known.limit_factor)
    ends = [int(seconds * NS_PER_S / bin_ns + 0.5) for seconds in within_s]
    nothing = [np.zeros(count)]
    highest = np.stack([np.max(nothing + scores[:end], axis=0).reshape(len(SPEEDS), -1) for end in ends], axis=1)
    return np.array([[_crossing(at_speed) for at_speed in within] for within in highest])


def static_words(path: Path, unit: str) -> str:
    """What a static twin is, and what it finds, in one line; empty for a twin that knows the motion of its fans."""
    twin = load_tray_twin(path)
    if not twin.card.is_static:
        return ""
    per_unit, period_s = RAD_S_PER_UNIT[unit], 1.0 / twin.card.rate_hz
    speed_rad_s = SPEEDS[STATIC_SPEED] * twin.card.top_speed_rad_s
    shares = smallest_drops(twin)[STATIC_SPEED]
    found: list[str] = []
    for seconds, share in zip(STATIC_WITHIN_S, shares.tolist(), strict=True):
        text = f"{share * speed_rad_s / per_unit:,.0f} {unit}"
        if np.isfinite(share) and text not in "".join(found):
            found.append(f"{text} that lasts {f'{seconds / 60:g} min' if seconds >= 60 else f'{seconds:g} s'}")
    finds = f"a drop of {' or '.join(found)} is found" if found else "no drop is found within ten minutes"
    sigma, speed = np.max(twin.sigma_rad_s) / per_unit, speed_rad_s / per_unit
    return (
        f"samples every {period_in_words(period_s)} hardly show the motion: a static twin, speed over command within "
        f"{sigma:,.3g} {unit} (one sigma); at {speed:,.0f} {unit} {finds}; not found: what is over within "
        f"{period_in_words(FEWEST * period_s)}, and how fans start and stop"
    )


def _crossing(score: Array) -> float:
    """The drop whose score is 1. score: of each of DROPS."""
    above = np.flatnonzero(score >= 1.0)
    if not len(above):
        return np.inf
    to = max(int(above[0]), 1)
    share = np.interp(1.0, score[to - 1 : to + 1], (0.0, 1.0))
    return float(DROPS[to - 1] * (DROPS[to] / DROPS[to - 1]) ** share)


def _steady_s(twin: TrayTwin) -> float:
    return max(STEADY_S, STEADY_SAMPLES / twin.card.rate_hz)


def dropping(twin: TrayTwin, fans: Fans, speed_rad_s: Array, drop: Array, for_s: float | None = None) -> Prediction:
    """Fans whose readings are exact, and which drop by these shares of their speed after a steady time.

    for_s: how long; None: for the longest of WITHIN_S.
    """
    steady_s, for_s = _steady_s(twin), WITHIN_S[-1] if for_s is None else for_s
    t_s = np.arange(round((steady_s + for_s) * twin.card.rate_hz)) / twin.card.rate_hz
    low, high = twin.card.command_range
    shape = len(t_s), len(speed_rad_s)
    after = (t_s >= steady_s)[:, np.newaxis]
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

"""Scores of a synthetic tray: sines of speed, seeded noise, one fan with a fault, one with a gap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fantwin.schemas.blocks import cut
from fantwin.schemas.enums import FanState, InvalidReason, Statistic, Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Score
from tests.support.made_messages import alarm, filled

START_NS = 1_700_000_000_000_000_000
STEP_NS = 10_000_000
SIGMA = 4.0


def made_up_tray(
    *,
    tray: str = "tray1",
    fans: int = 3,
    seconds: float = 20.0,
    block: int = 10,
    faulty_fan: int | None = 2,
    fault_s: tuple[float, float] = (8.0, 14.0),
    gap_fan: int | None = 1,
    gap_s: tuple[float, float] = (10.0, 11.5),
) -> tuple[list[Score], list[Alarm]]:
    """Scores in blocks of `block` samples, and the alarms that go with them."""
    t_s = np.arange(round(seconds * 1e9 / STEP_NS)) * STEP_NS / 1e9
    predicted = 300 + 40 * np.sin(0.5 * t_s[:, None] + np.arange(fans))
    measured = predicted + np.random.default_rng(7).normal(0, SIGMA, predicted.shape)
    state = np.full(predicted.shape, FanState.NORMAL, np.uint8)
    invalid_reason = np.zeros(predicted.shape, np.uint8)
    alarms = []
    if faulty_fan is not None:
        start, stop = fault_s
        measured[(t_s >= start) & (t_s < stop), faulty_fan] -= 30
        for from_s, to_s, what in (
            (start, start + 0.5, FanState.SUSPECT),
            (start + 0.5, stop, FanState.ALARM),
            (stop, stop + 0.5, FanState.RETURNING),
        ):
            state[(t_s >= from_s) & (t_s < to_s), faulty_fan] = what
        for at_s, active in ((start + 0.5, True), (stop + 0.5, False)):
            alarms.append(_alarm(tray, faulty_fan, at_s, start, active))
    if gap_fan is not None:
        gap = (t_s >= gap_s[0]) & (t_s < gap_s[1])
        measured[gap, gap_fan] = np.nan
        state[gap, gap_fan], invalid_reason[gap, gap_fan] = FanState.UNKNOWN, InvalidReason.GAP
    valid = state != FanState.UNKNOWN
    residual = measured - predicted
    whole = filled(
        Score,
        len(t_s),
        fans,
        period_ns=STEP_NS,
        t_ns=START_NS + np.arange(len(t_s)) * STEP_NS,
        command=0.5,
        measured_speed_rad_s=measured,
        predicted_speed_rad_s=predicted,
        band_variance=(2 * SIGMA) ** 2,
        state=state,
        valid=valid,
        invalid_reason=invalid_reason,
        torque_balance_command=np.where(np.isfinite(measured), -residual / 100, np.nan),
        score=np.abs(residual) / (2 * SIGMA),
        statistic=np.where(valid, Statistic.DEVIATION, Statistic.NONE),
    )
    blocks = (cut(whole, first, min(first + block, len(t_s))) for first in range(0, len(t_s), block))
    return [replace(each, header=Header("test", number, tray)) for number, each in enumerate(blocks)], alarms


def _alarm(tray: str, fan: int, at_s: float, onset_s: float, active: bool) -> Alarm:
    fields = {"active": active, "onset_t_ns": START_NS + round(onset_s * 1e9), "residual_std_rad_s": 2 * SIGMA}
    fields |= {"statistic": Statistic.DEVIATION, "residual_rad_s": -30.0 if active else -1.0}
    fields |= {"score": 3.75 if active else 0.1, "torque_balance_command": 0.3 if active else 0.01}
    fields["transition"] = Transition.RAISED if active else Transition.CLEARED
    fields["message"] = "slower than its twin" if active else "back in the band"
    return alarm(fan, START_NS + round(at_s * 1e9), tray, "test", **fields)


def one_sample(fans: int, *reasons: InvalidReason) -> Score:
    """A score of one sample. reasons: why the fans are not judged, beginning with fan 0; the rest are judged."""
    invalid = np.array([[*reasons, *[InvalidReason.NONE] * (fans - len(reasons))]], np.uint8)
    valid = invalid == InvalidReason.NONE
    return filled(Score, 1, fans, period_ns=STEP_NS, t_ns=START_NS, state=0, valid=valid, invalid_reason=invalid)

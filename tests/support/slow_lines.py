"""Fans of which a system of monitoring takes a sample now and then, whenever the command moves."""

from __future__ import annotations

import numpy as np

from fantwin.schemas.messages import Array

TOP_RPM, VISCOUS, FINE = 2865.0, 0.1, 20


def slow_line(
    seconds: float,
    period_s: float,
    time_constant_s: float,
    seed: int,
    *,
    synchronous: bool = False,
    drag_from_s: float = np.inf,
) -> tuple[Array, Array, Array]:
    """Times in s, commands in PWM steps and speeds in rpm, (n,) each. The command moves a little all the time, and far
    now and then.

    synchronous: it moves with the samples, as in the log of a controller; else at any time. drag_from_s: from then on
    the fan has 10 % more drag.
    """
    rng = np.random.default_rng(seed)
    step_s = period_s if synchronous else 0.9 * max(0.3 * period_s, min(period_s, time_constant_s))
    count = int(seconds / step_s) + 2
    far = rng.uniform(0.2, 1.0, count)[np.cumsum(rng.random(count) < step_s / (6.0 * max(period_s, time_constant_s)))]
    wanted = np.round(255.0 * (far + 0.01 * rng.normal(size=count)).clip(0.15, 1.0))
    step = period_s / max(FINE, round(5.0 * period_s / time_constant_s))
    t_s = np.arange(round(seconds / step)) * step
    command = wanted[np.floor(t_s / step_s + 1e-9).astype(int)]
    top = TOP_RPM * np.pi / 30.0
    drag = (255.0 - VISCOUS * top) / top**2
    inertia = time_constant_s * (VISCOUS + 1.4 * drag * top)
    speed, found = 0.7 * top, np.empty(len(t_s))
    for k, u in enumerate(command.tolist()):
        found[k] = speed
        more = 1.1 if t_s[k] >= drag_from_s else 1.0
        speed += (u - more * (VISCOUS + drag * speed) * speed) / inertia * step
    rows = slice(None, None, round(period_s / step))
    rpm = found[rows] * 30.0 / np.pi * (1.0 + 0.003 * rng.normal(size=len(found[rows])))
    return t_s[rows], command[rows], np.round(rpm)

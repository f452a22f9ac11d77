"""The torque balance: the command given minus the command that a healthy fan needs for the measured motion.

    needed = inertia w' + viscous w + drag w|w| + friction          friction: constant, against the rotation

In units of the command; positive where the fan needs more than a healthy one. Under a speed loop a fault shows here and
hardly in the speed. Both sides go through lambda / (s + lambda), so that nothing is differentiated. On a uniform grid
of period h, with a = exp(-lambda h), v_k the command that acts from k to k + 1 (after its lag, twin.models.lag) and m_k
the mean of w_k and w_k+1,

    x_k = v_k - inertia (w_k+1 - w_k) / h - viscous m_k - drag m_k |m_k| - friction
    f_k+1 = a f_k + (1 - a) x_k,    f_0 = 0,        balance_k = f_k / (1 - a^k)

The readings of a tacho that averages take the place of the speed, and v_k is then what that tacho would show of the
command (twin.measurement): v_k = (M v(t_k) + M v(t_k+1)) / 2.

The filter weighs the difference quotient by (1 - a) / h, which is about lambda: white tacho noise of standard deviation
s makes a balance of about inertia lambda s, whatever the rate. twin.fitting.balance_fit finds the coefficients.
"""

from collections.abc import Sequence

import numpy as np

from fantwin.schemas.tacho import INSTANTANEOUS, Tacho, tacho_of_each_fan
from fantwin.twin.measurement import Measurement
from fantwin.twin.models.lag import effective_command
from fantwin.twin.models.recursion import linear_recursion
from fantwin.twin.runs import Array

FILTER_RATE_PER_S = 3.0
COEFFICIENTS = ("inertia", "viscous", "drag", "friction")


def balance_of(terms: Array, coefficients: Array) -> Array:
    """(...,) balance of filtered terms (..., 5) by coefficients (..., 4)."""
    return terms[..., 0] - np.sum(terms[..., 1:] * coefficients, axis=-1)


def filtered_terms(
    command: Array, speed_rad_s: Array, period_s: float, lag_s: Array, tacho: Sequence[Tacho] = INSTANTANEOUS
) -> tuple[Array, Array]:
    """The balance is linear: (n, fans, 5) filtered command and what each coefficient multiplies; NaN at first.

    command, speed_rad_s: (n, fans) on a grid of period_s; an unknown speed is NaN, and the filter restarts after it.
    lag_s: (fans,); before the first sample the command is taken as constant. tacho: one for all fans, or one for each.
    Beside it (n, fans) weight of measured samples in the filter, from 0 at a start to 1.
    """
    acting, _ = effective_command(command, np.full((len(command), 1), period_s), lag_s, command[0])
    times = np.broadcast_to(period_s * np.arange(len(command), dtype=np.float64)[:, np.newaxis], command.shape)
    acting = Measurement(times, tacho_of_each_fan(tacho, command.shape[1])).of_command(acting)
    middle = (speed_rad_s[1:] + speed_rad_s[:-1]) / 2.0
    rise = np.diff(speed_rad_s, axis=0) / period_s
    one = np.ones_like(middle)
    terms = np.stack((acting[:-1], rise, middle, middle * np.abs(middle), one, one), axis=-1)
    known = np.isfinite(middle)
    decay = np.exp(-FILTER_RATE_PER_S * period_s)
    forcing = (1.0 - decay) * np.where(known[..., np.newaxis], terms, 0.0)
    start = np.zeros((1, *forcing.shape[1:]))
    filtered = linear_recursion(np.where(known, decay, 0.0), np.concatenate((start, forcing)))
    # The filtered constant 1 is the divisor that corrects for the start from zero.
    weight = filtered[..., -1]
    with np.errstate(invalid="ignore"):
        return filtered[..., :-1] / weight[..., np.newaxis], weight

"""The last seconds of one fan as a filtered regression, in which every fault is a column.

The torque balance is linear in its coefficients. Both sides are filtered by lambda / (s + lambda), the filtering
operator (Peng and Chen, equations (13) to (18)), so that no speed is differentiated. On the grid, with
a = exp(-lambda h), v the command after its lag, m_k = (w_k + w_k+1) / 2 and the healthy coefficients,

    x_k = v_k - inertia (w_k+1 - w_k) / h - viscous m_k - drag m_k|m_k| - friction - offset
    f_k+1 = a f_k + (1 - a) x_k

A fault changes one term from some time on. With a time course p, 0 before and up to 1 after, the same filter applied to
p times that term gives its column, and the residual of the fault is f - size * column. A course that begins at sample j
and is linear in time from then on needs no filter of its own: with F the filter over the whole term,

    F_j = F - a^(k-j+1) F at j-1      from j on

Each term is therefore filtered twice, unchanged and multiplied by the time. Everything else needs only the products of
these columns.

The healthy coefficients and the fan's offset have errors. A fan observed at few speeds is known better than any single
coefficient, because the errors of the coefficients compensate one another. Each independent combination of errors
therefore has a column, scaled by its standard deviation.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scoring.torque_balance import load_lfilter

Array: TypeAlias = NDArray[np.float64]

BRIDGE_S = 0.1
"""missing speeds are interpolated up to this; after a longer gap the filter has to settle again"""
LACK_OF_FIT = np.array([0.03, 0.01, 0.01, 0.05])
"""relative errors of the healthy coefficients beyond those from noise: noisy speeds bias the inertia by some percent,
and friction depends a little on speed"""
GAP_MEMORIES = 4.0
"""settling time after a gap, in time constants of the filter: the command during the gap is unknown"""
SIGNIFICANT = 2.0
"""standard errors from zero at which a coefficient counts as different from zero"""
MIN_STEADY_ROWS, STEADY_S, STEADY_SHARE = 25, 5.0, 0.03
"""shared noise is estimated from at least this many rows; the speed stays within this share of its mean for STEADY_S"""
MEAN_OVER_S = 0.2
"""rows are means over this time: longer than the noise of a tacho, shorter than the filter"""
RESIDUAL, COMMAND, DRAG, SQUARE, CONSTANT, JUMP = range(6)
"""columns of the residual and of the terms that a fault can change; the columns of the errors follow"""
FIRST_ERROR = 6


@dataclass(frozen=True, eq=False)
class HealthyBalance:
    """Torque balance of one healthy fan, from the twin's card, in units of its command."""

    inertia: float
    viscous: float
    drag: float
    friction: float
    lag_s: float
    covariance: Array
    """(4, 4) of the errors of inertia, viscous, drag and friction"""
    filter_rate_per_s: float
    sigma_command: float
    """standard deviation of the healthy balance"""
    autocorrelation_time_s: float
    lowest_speed_rad_s: float = 0.0
    """the balance does not hold below this speed: breakaway, standstill, the lowest reading of a tacho"""


@dataclass(frozen=True, eq=False)
class Window:
    """The last grid samples of one fan. command, speed_rad_s: (n,), NaN where unknown or where the sensor gave none.

    onset: index of the first anomalous sample, as the detector found it. fan_offset: balance of this fan when healthy,
    from commissioning, and its standard error. expected_command: (n,) healthy balance expected at each speed, apart
    from the offset, from calibration; NaN where the speed is unknown. All in units of the command. expected_rad_s: (n,)
    what a healthy fan would read; NaN where it is not known. reading_missing: (n,) where the line gave no reading,
    though its speed may be known from readings around it; None: where it is not known. supply_voltage_v, current_a:
    (n,), NaN where it is not known; None: it is not measured. given_command: (n,) as the fan was given it, where
    `command` is that at the twin's reference conditions; None: they do not differ.
    """

    period_s: float
    command: Array
    speed_rad_s: Array
    onset: int
    fan_offset: float = 0.0
    fan_offset_std_error: float = 0.0
    expected_command: Array | float = 0.0
    expected_rad_s: Array | float = math.nan
    reading_missing: NDArray[np.bool_] | None = None
    supply_voltage_v: Array | None = None
    current_a: Array | None = None
    given_command: Array | None = None

    @property
    def as_given(self) -> Window:
        """With the command as the fan was given it: whether it should turn does not depend on what it is supplied."""
        return self if self.given_command is None else replace(self, command=self.given_command)


class RegressionWindow:
    """Filtered columns of a window, as rows of means over MEAN_OVER_S."""

    def __init__(self, window: Window, healthy: HealthyBalance) -> None:
        h = window.period_s
        self.period_s, self.onset, self.samples = h, window.onset, len(window.command)
        self._decay = float(np.exp(-healthy.filter_rate_per_s * h))
        speed = _bridged(window.speed_rad_s)
        middle = (speed[:-1] + speed[1:]) / 2.0
        acting = acting_command(_held(window.command), h, healthy.lag_s)[:-1]
        motion = np.stack((np.diff(speed) / h, middle, middle * np.abs(middle), np.ones_like(middle)))
        coefficients = np.array((healthy.inertia, healthy.viscous, healthy.drag, healthy.friction))
        errors = healthy.covariance + np.diag(np.square(LACK_OF_FIT * coefficients))
        errors[3, 3] += window.fan_offset_std_error**2
        square = healthy.drag * motion[2]
        # A rotor without blades has no quadratic drag; its drag is then everything that rises with speed.
        has_square = healthy.drag > SIGNIFICANT * np.sqrt(healthy.covariance[2, 2])
        drag = square if has_square else square + healthy.viscous * middle
        self._momentum = healthy.inertia * speed[:-1] / h
        self._seconds = (np.arange(len(speed)) - window.onset) * h
        counts = _counts(window, healthy, speed)
        self._after = counts & (np.arange(1, len(speed)) > window.onset)
        self.per_row = max(1, round(MEAN_OVER_S / h))
        """samples in a row"""
        self._starts = np.arange(0, len(middle), self.per_row)
        self._ends = np.append(self._starts[1:], len(middle))
        valid = np.add.reduceat(counts.astype(float), self._starts)
        self._enough = valid >= self.per_row / 2.0
        self._enough_before_onset = (self._ends <= window.onset)[self._enough]
        self._weight = counts / np.repeat(np.maximum(valid, 1.0), self._ends - self._starts)
        healthy_balance = (window.fan_offset + _bridged(np.broadcast_to(window.expected_command, speed.shape)))[:-1]
        residual = acting - coefficients @ motion - healthy_balance
        fixed = np.vstack((residual, _independent(errors) @ motion))
        self._fixed = self._whole(fixed)
        terms = np.stack((acting, drag, square, motion[3]))
        terms -= self._shared(terms, residual, middle)[:, np.newaxis] * residual
        changing = np.concatenate((terms, terms * self._seconds[:-1], self._momentum[np.newaxis]))
        self._changing = self._filtered(changing)
        self._changing_sums = _summed(self._changing * self._weight)
        self._decay_sums = _summed(self._weight * self._decay ** (np.arange(len(middle)) % self.per_row))
        self.rows = self._fixed.shape[-1]
        self.typical_command = float(np.abs(acting).mean())
        self.constant_need = healthy.friction + window.fan_offset
        self.speeds_after = np.abs(middle[self._after])
        """speeds of the samples that count since the onset, rad/s"""

    def columns(self, begin_s: Array, full_s: Array) -> Array:
        """(courses, FIRST_ERROR + 4, rows) columns of faults that grow linearly from zero to their sizes.

        begin_s, full_s: (courses,) start and end of the growth, in seconds after the onset. Equal for a step; before
        the window for a fault that is present throughout. A growth never ends before the window does.
        """
        is_step = begin_s == full_s
        first = np.where(is_step, begin_s - self.period_s / 2.0, np.nextafter(begin_s, np.inf))
        at: Any = np.searchsorted(self._seconds[:-1], first)
        slope, level = np.zeros(len(at)), np.ones(len(at))
        slope[~is_step] = 1.0 / (full_s[~is_step] - begin_s[~is_step])
        level[~is_step] = -slope[~is_step] * begin_s[~is_step]
        whole = self._rows(self._changing_sums, at)
        past = np.where(at > 0, self._changing[:, at - 1], 0.0).T[..., np.newaxis] * self._decay
        since = whole - past * self._decayed(at)[:, np.newaxis]
        slope, level = slope[:, np.newaxis, np.newaxis], level[:, np.newaxis, np.newaxis]
        changed = level * since[:, :4] + slope * since[:, 4:8]
        before = np.maximum(at - 1, 0)
        height = np.where(at > 0, level[:, 0, 0] + slope[:, 0, 0] * self._seconds[at], 0.0) * self._momentum[before]
        jump = slope * self.period_s * since[:, 8:]
        jump += ((1.0 - self._decay) * height)[:, np.newaxis, np.newaxis] * self._decayed(before)[:, np.newaxis]
        fixed = np.broadcast_to(self._fixed, (len(at), *self._fixed.shape))
        return np.concatenate((fixed[:, :1], changed, jump, fixed[:, 1:]), axis=1)

    def _shared(self, terms: Array, residual: Array, speed_rad_s: Array) -> Array:
        """(terms,) regression coefficients of each term on the residual's noise.

        A controller reacts to the noise of the tacho: its command is then correlated with the residual of a healthy fan
        as that of a weak drive would be, all the time. That noise is also in the drag. Estimated before the onset and
        at steady speed only: while a fan accelerates, both are correlated for physical reasons. Zero where it is not
        significant.
        """
        from scipy.ndimage import maximum_filter1d, uniform_filter1d  # noqa: PLC0415  see load_lfilter

        rows = self._whole(np.vstack((speed_rad_s, terms, residual)))[:, self._enough_before_onset]
        shared = np.zeros(len(terms))
        if rows.shape[1] < MIN_STEADY_ROWS:
            return shared
        span = round(STEADY_S / MEAN_OVER_S)
        means = uniform_filter1d(rows, span, axis=1)
        speed, *deviations, noise = rows - means
        steady = maximum_filter1d(np.abs(speed), span) <= STEADY_SHARE * np.abs(means[0])
        power = float(noise[steady] @ noise[steady])
        if np.count_nonzero(steady) < MIN_STEADY_ROWS or power <= 0.0:
            return shared
        for number, term in enumerate(deviations):
            share = float(term[steady] @ noise[steady]) / power
            unexplained = np.square(term[steady] - share * noise[steady]).sum()
            if abs(share) > SIGNIFICANT * np.sqrt(unexplained / power / np.count_nonzero(steady)):
                shared[number] = np.clip(share, -1.0, 1.0)
        return shared

    def _whole(self, terms: Array) -> Array:
        """(terms, rows) filtered terms, as means over rows."""
        return self._rows(_summed(self._filtered(terms) * self._weight), np.zeros(1, int))[0]

    def _filtered(self, terms: Array) -> Array:
        filtered: Any = load_lfilter()([1.0 - self._decay], [1.0, -self._decay], terms, axis=-1)
        return filtered

    def _rows(self, sums: Array, at: Array) -> Array:
        """(courses, terms, rows) means over rows, from samples `at` on. sums: running sums (terms, n)."""
        begins = np.clip(self._starts, at[:, np.newaxis], self._ends)
        found = sums[:, self._ends] - sums[:, begins].swapaxes(0, 1)
        return found[..., self._enough]

    def _decayed(self, at: Array) -> Array:
        """(courses, rows) means of a^(k - at) from samples `at` on."""
        begins = np.clip(self._starts, at[:, np.newaxis], self._ends)
        since = np.maximum(self._starts - at[:, np.newaxis], -self.per_row)
        found = self._decay**since * (self._decay_sums[self._ends] - self._decay_sums[begins])
        return found[:, self._enough]


def _summed(values: Array) -> Array:
    """(..., n + 1) running sums, starting at zero."""
    return np.concatenate((np.zeros((*values.shape[:-1], 1)), np.cumsum(values, axis=-1)), axis=-1)


def _independent(covariance: Array) -> Array:
    """(4, 4) independent combinations of the errors, each of variance one."""
    scale = np.sqrt(np.diag(covariance))
    known = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(known, known))
    return (scale[:, np.newaxis] * vectors * np.sqrt(np.maximum(values, 0.0))).T


def acting_command(command: Array, period_s: float, lag_s: float) -> Array:
    """(n,) mean over each sample period of the command after its lag, lag i' + i = command; settled at the start."""
    if lag_s <= 0.0:
        return command
    decay = np.exp(-period_s / lag_s)
    before: Any = load_lfilter()([0.0, 1.0 - decay], [1.0, -decay], command - command[0]) + command[0]
    return command + (before - command) * (1.0 - decay) * lag_s / period_s


def mean_of_correlated(correlation_samples: float, samples: int) -> tuple[float, float]:
    """Variance of the mean of `samples` samples of unit variance, and the factor by which correlation between such
    means increases the variance of their mean; for a first-order autoregression with this correlation time.
    """
    phi = np.exp(-1.0 / correlation_samples) if correlation_samples > 0.0 else 0.0
    whole = (1.0 - phi**samples) / (1.0 - phi)
    variance = ((1.0 + phi) / (1.0 - phi) - 2.0 * phi * whole / (samples * (1.0 - phi))) / samples
    lag_one = phi * whole**2 / samples**2 / variance
    return float(variance), float((1.0 + lag_one) / (1.0 - lag_one))


def _bridged(speed_rad_s: Array) -> Array:
    """Missing speeds interpolated linearly; the nearest speed at the ends."""
    known = np.isfinite(speed_rad_s)
    if not known.any():
        return np.zeros(len(speed_rad_s))
    at = np.arange(len(speed_rad_s))
    return np.interp(at, at[known], speed_rad_s[known])


def _held(command: Array) -> Array:
    """Unknown commands replaced by the last known one; before the first known one, by that."""
    known = np.isfinite(command)
    if not known.any():
        return np.zeros(len(command))
    last = np.maximum.accumulate(np.where(known, np.arange(len(command)), np.argmax(known)))
    return command[last]


def _counts(window: Window, healthy: HealthyBalance, speed_rad_s: Array) -> NDArray[np.bool_]:
    """(n - 1,) which samples count, from the second on: measured, and the filter has settled since its start, long
    gaps and speeds that are too low.
    """
    memory = 1.0 / (healthy.filter_rate_per_s * window.period_s)
    missing = ~np.isfinite(window.speed_rad_s + window.command)
    bridge = max(1, round(BRIDGE_S / window.period_s))
    whole_gaps = np.lib.stride_tricks.sliding_window_view(np.pad(missing, (bridge, 0)), bridge + 1)
    gap = np.asarray(whole_gaps.all(axis=1))
    slow = np.abs(speed_rad_s) < healthy.lowest_speed_rad_s
    slow[0] = True
    settled = (_since(slow) >= memory) & (_since(gap) >= GAP_MEMORIES * memory)
    return (settled & ~missing)[1:]


def _since(flags: NDArray[np.bool_]) -> Array:
    """(n,) samples since the last flag (n,), infinite before the first."""
    at = np.arange(len(flags))
    last = np.maximum.accumulate(np.where(flags, at, -1))
    return np.where(last < 0, np.inf, at - last)

"""What tachos are expected to show of speeds: the measurement between a free run and the readings.

A count shows the mean speed over a window W that ended some time ago: a delay d, and an age between 0 and H, for which
a reading is held. The phase of the windows is not known, so all ages are equally likely, and the expected reading is

    M w (t) = 1 / (H W) integral over a from 0 to H, over s from 0 to W, of w(t - d - a - s)
            = (Q(t - d) - Q(t - d - H) - Q(t - d - W) + Q(t - d - H - W)) / (H W),    Q'' = w

It is linear, leaves a constant as it is, and shows a ramp d + (W + H) / 2 late. Between samples speeds are linear and
commands are held; Q is then known exactly, whatever the steps. Before the first sample both are taken as constant,
which is a guess: a reading that shows any of that time cannot be compared (`comparable`).

A reading scatters about the expected one, however good the model, by its resolution q and by its age. The phases of
the first and the last pulse of a count have the variance q^2 / 6, and the rounding of an average q^2 / 12. Over ages
from 0 to H the mean of the window differs by H d/dt M w, and if it does so evenly the variance is the square of that
over 12.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from fantwin.schemas.tacho import Tacho
from fantwin.twin.runs import Array, Run


class Measurement:
    """The tachos of a batch of signals that are sampled at the same or at different times.

    t_s: (n, batch) not decreasing; a repeated time is padding. tacho: (batch,).
    """

    def __init__(self, t_s: Array, tacho: Sequence[Tacho]) -> None:
        self.t_s = t_s
        self.tacho = tuple(tacho)
        self.comparable: NDArray[np.bool_] = t_s - t_s[0] >= [each.reach_s for each in self.tacho]
        self._passes_unchanged = all(each.reach_s == 0.0 for each in self.tacho)

    def of_speed(self, speed_rad_s: Array, part: slice = slice(None)) -> Array:
        """(n, batch) or (n, batch, P) expected readings of speeds, or of their derivatives.

        part: the columns that are given, if not all. One speed that is not finite makes all its readings NaN.
        """
        return speed_rad_s if self._passes_unchanged else self._on_speeds.apply(speed_rad_s, part)

    def of_command(self, command: Array) -> Array:
        """(n, batch) held commands as the tachos would show them, to be set against readings; held, too.

        From sample k to k + 1 the mean of what they would show at both, which depends on no later command.
        """
        if self._passes_unchanged:
            return command
        shown = _Operator(self.t_s, self.tacho, held=True).apply(command)
        return np.concatenate(((shown[:-1] + shown[1:]) / 2.0, shown[-1:]))

    def noise_rad_s(self, expected_rad_s: Array) -> Array:
        """(n, batch) standard deviation of readings about the expected ones (n, batch); 0 for instantaneous tachos."""
        of_age = np.array([each.held_s for each in self.tacho]) * self.slope(expected_rad_s) / np.sqrt(12.0)
        graded = [each.resolution_rad_s / np.sqrt(each.resolution_steps) for each in self.tacho]
        return np.hypot(of_age, np.array(graded))

    def slope(self, signal: Array) -> Array:
        """Slope of a signal (n, batch), per second: the mean of those before and after each sample; 0 over padding."""
        step_s = np.diff(self.t_s, axis=0)
        with np.errstate(invalid="ignore", over="ignore"):
            rise = np.diff(signal, axis=0)
            slope = np.divide(rise, step_s, out=np.zeros_like(rise), where=step_s > 0.0)
            return (np.concatenate((slope[:1], slope)) + np.concatenate((slope, slope[-1:]))) / 2.0

    @cached_property
    def _on_speeds(self) -> "_Operator":
        return _Operator(self.t_s, self.tacho, held=False)


def measurement_of(run: Run) -> Measurement:
    """The measurement of all fans of a run."""
    return Measurement(np.broadcast_to(run.t_s[:, np.newaxis], run.speed_rad_s.shape), run.tacho)


def with_measured_command(run: Run) -> Run:
    """The run with its commands as its tachos would show them: J r' + alpha r + C_D r|r| = M tau for its readings r.

    Exact but for the drag while the speed changes, for M w|w| is not r|r|.
    """
    return replace(run, command=measurement_of(run).of_command(run.command))


class _Operator:
    """M as three sparse matrices: on the signal and on its first and second integral at the samples.

    held: the signal is held from sample to sample, not linear in between.
    """

    def __init__(self, t_s: Array, tacho: Sequence[Tacho], held: bool) -> None:
        # Signals one after the other, so that a part of the batch is a block of rows.
        self.samples, batch = t_s.shape
        self.held = held
        self.step_s = np.diff(t_s, axis=0).T
        rows, columns, of_signal, of_first, of_second = [], [], [], [], []
        for signal, (times, its) in enumerate(zip(t_s.T, tacho, strict=True)):
            row = signal * self.samples + np.arange(self.samples)
            for lag_s, weight in _corners(its):
                at_s = times - lag_s
                node = np.maximum(np.searchsorted(times, at_s, side="right") - 1, 0)
                following = np.minimum(node + 1, self.samples - 1)
                into_s, step_s = at_s - times[node], times[following] - times[node]
                linear = (into_s > 0.0) & (step_s > 0.0) & (not held)
                with np.errstate(divide="ignore", invalid="ignore"):
                    share = np.where(linear, into_s / step_s, 0.0)
                if weight is None:
                    on_node, on_next = 1.0 - share, share
                    on_first = on_second = np.zeros(self.samples)
                else:
                    on_next = weight * share * into_s**2 / 6.0
                    on_node = weight * into_s**2 / 2.0 - on_next
                    on_first, on_second = weight * into_s, np.full(self.samples, weight)
                rows += [row, row]
                columns += [signal * self.samples + node, signal * self.samples + following]
                of_signal += [on_node, on_next]
                of_first += [on_first, np.zeros(self.samples)]
                of_second += [on_second, np.zeros(self.samples)]
        place = (np.concatenate(rows), np.concatenate(columns))
        size = (batch * self.samples,) * 2
        self.matrices = [csr_array((np.concatenate(of), place), size) for of in (of_signal, of_first, of_second)]
        for matrix in self.matrices:
            matrix.eliminate_zeros()

    def apply(self, signal: Array, part: slice = slice(None)) -> Array:
        """M of (n, batch) or (n, batch, P), of some columns of the batch."""
        first, last, _ = part.indices(len(self.step_s))
        values = signal.reshape(*signal.shape[:2], -1).transpose(1, 0, 2)
        # A constant is left as it is; without the mean the integrals stay small, and so does rounding.
        with np.errstate(invalid="ignore", over="ignore"):
            mean = values.mean(axis=1, keepdims=True)
            values = values - mean
            step_s = self.step_s[first:last, :, np.newaxis]
            start, end = values[:, :-1], values[:, :-1] if self.held else values[:, 1:]
            once, twice = np.zeros_like(values), np.zeros_like(values)
            np.cumsum(step_s * (start + end) / 2.0, axis=1, out=once[:, 1:])
            np.cumsum(step_s * (once[:, :-1] + step_s * (2.0 * start + end) / 6.0), axis=1, out=twice[:, 1:])
            block = slice(first * self.samples, last * self.samples)
            integrals = [integral.reshape(-1, values.shape[2]) for integral in (values, once, twice)]
            shown = np.zeros_like(integrals[0])
            for matrix, integral in zip(self.matrices, integrals, strict=True):
                shown += matrix[block, block] @ integral
            return (shown.reshape(values.shape) + mean).transpose(1, 0, 2).reshape(signal.shape)


def _corners(tacho: Tacho) -> list[tuple[float, float | None]]:
    """Lags in s at which the second integral counts, and its weight there; None: the signal itself counts."""
    window_s, held_s, delay_s = tacho.window_s, tacho.held_s, tacho.delay_s
    if window_s == 0.0:
        return [(delay_s, None)]
    each = 1.0 / (window_s * held_s)
    return [
        (delay_s, each),
        (delay_s + held_s, -each),
        (delay_s + window_s, -each),
        (delay_s + held_s + window_s, each),
    ]

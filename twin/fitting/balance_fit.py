"""The torque balance of each fan: its definition, and its coefficients and healthy variation from healthy runs.

The balance is the command given minus the command that a healthy fan needs for the measured motion.

    needed = inertia w' + viscous w + drag w|w| + friction          friction: constant, against the rotation

It is in units of the command; positive where the fan needs more than a healthy one. Under a speed loop a fault shows
here and hardly in the speed. Both sides go through lambda / (s + lambda), so that nothing is differentiated. On a
uniform grid of period h, with a = exp(-lambda h), v_k the command that acts from k to k + 1 (after its lag,
twin.models.lag) and m_k the mean of w_k and w_k+1,

    x_k = v_k - inertia (w_k+1 - w_k) / h - viscous m_k - drag m_k |m_k| - friction
    f_k+1 = a f_k + (1 - a) x_k,    f_0 = 0,        balance_k = f_k / (1 - a^k)

The readings of a tacho that averages take the place of the speed, and v_k is then what that tacho would show of the
command (twin.tacho_readings): v_k = (M v(t_k) + M v(t_k+1)) / 2.

The filter weighs the difference quotient by (1 - a) / h, which is about lambda: white tacho noise of standard deviation
s makes a balance of about inertia lambda s, whatever the rate.

There are two candidates for the coefficients of each fan. *physics*: J, alpha, C_D and lag_s of the identification, and
the friction by least squares. A noisy tacho does not bias them, but the physics lack dry friction, and a speed loop can
bias them. *least-squares*: all four coefficients by least squares on the filtered balance, none of the first three
below zero; the lag is that of the physics. It includes friction and works under a loop, but noise in the speeds makes
its inertia too small.

The candidates are compared by the *residual standard deviation*: that of the balance about the mean of each run.
(Commissioning removes constant differences between runs.) Least squares is cross-validated: each group of samples uses
the coefficients of the other groups. The physics need none, for their friction does not change a standard deviation. A
group is a run, or a part of one where runs are few. Held-out runs take no part in the choice; they give sigma.

The smaller standard deviation is better, but bias alone lowers that of least squares: where noise reduces its inertia
by the share 1 - r, it reduces the standard deviation by at most the share 1 - sqrt(r) (r is the reliability ratio of
Fuller, Measurement Error Models, 1987, section 1.1). So least squares is chosen where its standard deviation is below
that of the physics times sqrt(r), with r = inertia / J, but between 1/2 and 1: noise does not explain a J of twice the
inertia or more. The errors of a tacho that counts last for a count and depend on the motion, so that they bias all the
coefficients. All that such a bias can take away is the variance that the errors cause, (J lambda)^2 times theirs; least
squares must lower the variance by more. (On simulated racks least squares reached 0.73 times the standard deviation of
the physics, and a balance at held speeds that was off by twice as much.)

A fan that stands, starts or stops is left out, and so is the first second of each stretch; with a tacho that averages
also as long as a reading shows any of that. Errors are those of the identification where coefficients come from there,
otherwise of the jackknife over the groups, which allows for errors that are correlated within a group and for runs that
differ.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.optimize import lsq_linear

from fantwin.schemas.tacho import INSTANTANEOUS, Tacho, tacho_of_each_fan
from fantwin.schemas.twin_card import BalanceCard, BalanceSource
from fantwin.twin.errors import TwinError
from fantwin.twin.evaluation.resampling import resampled
from fantwin.twin.evaluation.residual_analysis import analyse_residual
from fantwin.twin.fitting.identification import Identification
from fantwin.twin.models.lag import effective_command
from fantwin.twin.models.physics import LAG
from fantwin.twin.models.recursion import linear_recursion
from fantwin.twin.runs import GAP_IN_MEDIAN_PERIODS, Array, Run
from fantwin.twin.tacho_readings import Measurement, measurement_of

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


LOWEST_SHARE_OF_TOP = 0.05
SETTLING_S = 3.0 / FILTER_RATE_PER_S
ENOUGH_RUNS, GROUPS = 4, 8
MIN_RELIABILITY = 0.5
INERTIA, FRICTION = COEFFICIENTS.index("inertia"), COEFFICIENTS.index("friction")
LOWER_BOUNDS = (0.0, 0.0, 0.0, -np.inf)


@dataclass(frozen=True, eq=False)
class _Stretch:
    """A gap-free part of a run on its grid, and the terms of its balance (n, fans, 5), NaN where they do not count."""

    run: int
    grid: Run
    terms: Array


def fit_balance(runs: Sequence[Run], held_out: Sequence[Run], identification: Identification) -> BalanceCard:
    """The balance of each fan in units of its command, fitted and chosen on the runs.

    Its sigma comes from the held-out runs, or from the same ones where there are none. Raises TwinError where a fan
    never turns long enough, or its balance never moves.
    """
    lag_s = identification.parameters[:, LAG]
    lowest_speed_rad_s = LOWEST_SHARE_OF_TOP * identification.top_speed_rad_s
    learned = _stretches(runs, lag_s, lowest_speed_rad_s)
    judged = _stretches(held_out, lag_s, lowest_speed_rad_s) or learned
    fans = range(len(lag_s))
    chosen = [_choose(learned, identification, fan) for fan in fans]
    coefficients = np.array([coefficients for coefficients, _, _ in chosen])
    sigma = np.array(
        [_residual_std([balance_of(run, coefficients[fan]) for run in _by_run(judged, fan)]) for fan in fans]
    )
    if not np.all(sigma > 0.0):
        raise TwinError(f"fan {np.argmin(sigma > 0.0)}: its torque balance never moves; check the speed column")
    of_fans: dict[str, Any] = dict(zip(COEFFICIENTS, coefficients.T.tolist(), strict=True)) | {
        "covariance": [covariance.tolist() for _, covariance, _ in chosen],
        "lag_s": lag_s.tolist(),
        "source": [source for _, _, source in chosen],
        "sigma_command": sigma.tolist(),
        "autocorrelation_time_s": [_autocorrelation_time_s(judged, coefficients[fan], fan) for fan in fans],
        "lowest_speed_rad_s": lowest_speed_rad_s.tolist(),
    }
    return BalanceCard(**of_fans, filter_rate_per_s=FILTER_RATE_PER_S)


def _stretches(runs: Sequence[Run], lag_s: Array, lowest_speed_rad_s: Array) -> list[_Stretch]:
    """All stretches of the runs, each run at its own rate. Missing speeds are bridged where a command would be."""
    found: list[_Stretch] = []
    for index, run in enumerate(runs):
        rate_hz = 1.0 / run.median_period_s
        for piece in run.split_at_gaps():
            if piece.duration_s * rate_hz < 1.0:
                continue
            grid = resampled(piece, rate_hz)
            speed = np.column_stack([_bridged(of_fan) for of_fan in grid.speed_rad_s.T])
            terms, weight = filtered_terms(grid.command, speed, 1.0 / rate_hz, lag_s, grid.tacho)
            standing = np.abs(speed) < lowest_speed_rad_s
            reach = round((SETTLING_S + max(tacho.reach_s for tacho in grid.tacho)) * rate_hz)
            near_standstill = maximum_filter1d(standing.astype(np.int8), 2 * reach + 1, axis=0, mode="nearest") > 0
            settled = weight >= 1.0 - np.exp(-FILTER_RATE_PER_S * SETTLING_S)
            counts = settled & ~near_standstill & measurement_of(grid).comparable
            found.append(_Stretch(index, grid, np.where(counts[..., np.newaxis], terms, np.nan)))
    return found


def _bridged(speed_rad_s: Array) -> Array:
    """(n,) one fan's speeds on a grid, linear across short gaps, NaN in long ones."""
    known = np.flatnonzero(np.isfinite(speed_rad_s))
    if len(known) < 2:
        return np.full_like(speed_rad_s, np.nan)
    at = np.arange(len(speed_rad_s))
    after = np.clip(np.searchsorted(known, at), 1, len(known) - 1)
    short = known[after] - known[after - 1] <= GAP_IN_MEDIAN_PERIODS
    between = np.interp(at, known, speed_rad_s[known], left=np.nan, right=np.nan)
    return np.where(short, between, speed_rad_s)


def _choose(
    learned: Sequence[_Stretch], identification: Identification, fan: int
) -> tuple[Array, Array, BalanceSource]:
    """(4,) coefficients of a fan, the (4, 4) covariance of their errors, and which candidate they are."""
    runs = _by_run(learned, fan)
    parts = 1 if len(runs) >= ENOUGH_RUNS else -(-GROUPS // len(runs))
    groups = [np.array_split(run, parts) for run in runs]
    # The triangular factor, five rows, contains all that least squares needs from a group.
    triangles = [np.linalg.qr(group).R for of_run in groups for group in of_run]
    free = _least_squares(triangles)
    without = [_least_squares([other for other in triangles if other is not left_out]) for left_out in triangles]
    physics, of_physics = _physics([group for of_run in groups for group in of_run], identification, fan)
    of_others = iter(without)
    least_squares_std = _residual_std(
        [np.concatenate([balance_of(group, next(of_others)) for group in of_run]) for of_run in groups]
    )
    physics_std = _residual_std([balance_of(run, physics) for run in runs])
    reliability = np.clip(free[INERTIA] / physics[INERTIA], MIN_RELIABILITY, 1.0)
    of_counts = (physics[INERTIA] * FILTER_RATE_PER_S) ** 2 * _variance_of_counts(learned, fan)
    if least_squares_std**2 < min(physics_std**2 * reliability, physics_std**2 - of_counts):
        return free, _jackknife(np.array(without)), "least-squares"
    return physics, of_physics, "physics"


def _variance_of_counts(stretches: Sequence[_Stretch], fan: int) -> float:
    """Mean square error of a fan's readings, (rad/s)^2, of whole counts and of their age; 0 where it does not count."""
    found = []
    for stretch in stretches:
        grid, speed_rad_s = stretch.grid.fan(fan), stretch.grid.speed_rad_s[:, fan]
        (tacho,) = grid.tacho
        held = max(1, round(tacho.held_s / grid.median_period_s))
        change = (speed_rad_s[held:] - speed_rad_s[:-held]) if tacho.held_s else np.zeros(1)
        found.append(tacho.resolution_rad_s**2 / tacho.resolution_steps + change**2 / 12.0)
    return float(np.nanmean(np.concatenate(found)))


def _physics(groups: Sequence[Array], identification: Identification, fan: int) -> tuple[Array, Array]:
    """(4,) identified coefficients with the friction that is left, and the (4, 4) covariance of their errors.

    The friction compensates the mean error of the identified coefficients.
    """
    own = np.append(identification.parameters[fan, :LAG], 0.0)
    samples = np.array([len(group) for group in groups])
    total = np.array([balance_of(group, own).sum() for group in groups])
    without = (total.sum() - total) / (samples.sum() - samples)
    own[FRICTION] = total.sum() / samples.sum()
    makes_good = np.vstack((np.eye(LAG), -np.concatenate(groups)[:, 1 : 1 + LAG].mean(axis=0)))
    covariance = makes_good @ identification.covariance[fan, :LAG, :LAG] @ makes_good.T
    covariance[FRICTION, FRICTION] += _jackknife(without[:, np.newaxis]).item()
    return own, covariance


def _least_squares(triangles: Sequence[Array]) -> Array:
    """(4,) coefficients with the smallest sum of squares of the balance."""
    stacked = np.concatenate(triangles)
    scale = np.linalg.norm(stacked[:, 1:], axis=0) + np.finfo(float).tiny
    return lsq_linear(stacked[:, 1:] / scale, stacked[:, 0], (LOWER_BOUNDS, np.inf), method="bvls").x / scale


def _jackknife(without: Array) -> Array:
    """(k, k) covariance of the errors, from the estimates (groups, k) that leave out one group each."""
    apart = without - without.mean(axis=0)
    return (len(without) - 1) / len(without) * apart.T @ apart


def _by_run(stretches: Sequence[_Stretch], fan: int) -> list[Array]:
    """(m, 5) terms of a fan that count, for each run that has some. Raises TwinError where there are too few."""
    of_runs: dict[int, list[Array]] = {}
    for stretch in stretches:
        terms = stretch.terms[:, fan]
        of_runs.setdefault(stretch.run, []).append(terms[np.isfinite(terms[:, 0])])
    runs = [run for parts in of_runs.values() if len(run := np.concatenate(parts)) >= GROUPS]
    if not runs:
        raise TwinError(
            f"fan {fan}: no run in which it turns for more than {SETTLING_S:g} s on end, which its torque balance "
            "needs; give a longer one"
        )
    return runs


def _residual_std(balances: Sequence[Array]) -> float:
    """Standard deviation within runs, over all their samples."""
    return float(np.sqrt(np.mean(np.concatenate([balance - balance.mean() for balance in balances]) ** 2)))


def _autocorrelation_time_s(stretches: Sequence[_Stretch], coefficients: Array, fan: int) -> float:
    balances = [balance_of(stretch.terms[:, fan], coefficients) for stretch in stretches]
    of_run = np.repeat([stretch.run for stretch in stretches], [len(balance) for balance in balances])
    balance = np.concatenate(balances)
    counted = np.isfinite(balance)
    samples = np.maximum(np.bincount(of_run[counted], minlength=of_run[-1] + 1), 1)
    mean = np.bincount(of_run[counted], balance[counted], minlength=of_run[-1] + 1) / samples
    within = (balance - mean[of_run])[:, np.newaxis]
    pieces = [stretch.grid.fan(fan) for stretch in stretches]
    (analysis,) = analyse_residual(within, pieces, settling_s=0.0)
    time_s = analysis.autocorrelation_time_s
    return time_s if np.isfinite(time_s) else 1.0 / FILTER_RATE_PER_S

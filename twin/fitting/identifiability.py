"""What a recording does not determine about a fan, why, and what to record instead.

Whether a parameter is determined follows from the covariance of the estimates; the reason follows from the data. Two
problems that the covariance cannot show are detected in the data alone: a recording that hardly excites the fan, and a
controller that feeds the speed back into the command while its set-point rests.

Under feedback the direct approach, which fits command to speed as if there were no loop, is biased by the noise that
its noise model lacks, in proportion to the share of the command that is of noise (Forssell and Ljung, Automatica 35,
1999; Ljung, System Identification, second edition, section 13.4). Ours is white noise on the speed: that of a tacho,
but not that of a load that fluctuates. `python -m bench.detection.loops` has both. Where a set-point moves by a tenth
of the speed or more, the bias is below the intervals, as in open loop, so there are no instruments here. Where it
rests, noise is all that is left, estimates are wrong by 90 % with narrow intervals, and none are made.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.special import fdtrc

from fantwin.twin.models.physics import PARAMETER_NAMES
from fantwin.twin.runs import Array, Run

J, ALPHA, C_D, LAG_S = (PARAMETER_NAMES.index(name) for name in ("J", "alpha", "C_D", "lag_s"))

# The half width of a 95 % interval in standard errors, for words; the intervals themselves are identification's.
REACH = 2.0
# The inertia cannot be zero, so this share of it, and not an interval that contains zero, is the criterion.
UNCERTAIN_INERTIA = 0.25
# alpha and C_D of a fan run from standstill to top speed correlate by -0.96 to -0.98, from two thirds of it by -0.99.
TRADE_OFF_CORRELATION = -0.99
NARROW_SPEED_RANGE = 0.35
# At so many standard errors from zero, a coefficient counts as determined even where the two trade off.
WELL_DISTINCT = 10.0
# Of the damping at one end of the speeds to that at the other; the fit keeps both positive (twin.models.physical).
EDGE = 1e-3
# Noise estimates scatter by some percent.
MISFIT = 1.1
TOP_SPEED_QUANTILE = 0.99

FEWEST_STEPS, FEWEST_LEVELS = 3, 3
LEVELS_PER_RANGE = 10
SMALL_COMMAND_RANGE = 0.1
SMALL_SPEED_RANGE_IN_NOISE = 5.0

SHORTEST_TIME_CONSTANTS = 75
"""one round of `fantwin command --sweep`: 13 levels until the speed has settled, and ten for one time constant each"""
RECOMMENDED_TIME_CONSTANTS, RECOMMENDED_S = 150, 300.0
"""two rounds, and the five minutes of docs/tutorial/own-fan.md; the longer of the two"""

LAGS = 5
"""past samples that a command may depend on"""
FEWEST_MOVES = 50
"""moves of the command needed for a decision; a controller makes them within seconds"""
FALSE_ALARM_PROBABILITY = 1e-3
FEEDBACK_SHARE = 0.05
"""share of the command's variation; feedback is harmless if the external excitation is twenty times stronger"""
LARGEST_MOVE = 5.0
"""in median changes; a larger change is a step of the set-point and is clipped to this"""
RESTS = 0.1
"""share of the speed: the set-point of a loop whose speed keeps within this has not moved"""

MORE_OF = {
    ALPHA: "record longer, with steps at low speed, where friction outweighs drag",
    C_D: "record steps at higher speed (a rotor without blades has none)",
}


def identifiability_warnings(runs: Sequence[Run], parameters: Array, covariance: Array) -> tuple[str, ...]:
    """One warning for each property of a fan that the runs do not determine; none if they determine everything.

    parameters: (fans, 4) in the order of PARAMETER_NAMES. covariance: (fans, 4, 4), zero for a parameter that was held.
    """
    pieces = [piece for run in runs for piece in run.split_at_gaps()]
    return tuple(
        f"fan {fan}: {line}"
        for fan in range(len(parameters))
        for line in (
            *_poor_excitation(pieces, fan),
            *_inertia(pieces, fan, parameters[fan], covariance[fan]),
            *_drag(pieces, fan, parameters[fan], covariance[fan]),
            *_lag(pieces, parameters[fan], covariance[fan]),
        )
    )


def short_warnings(pieces: Sequence[Run], time_constant_s: Array) -> tuple[str, ...]:
    """One line if the runs are too short to show what the fans do; none if they are not.

    pieces: without gaps. time_constant_s: (fans,).
    """
    recorded_s, slowest_s = sum(piece.duration_s for piece in pieces), float(time_constant_s.max())
    if recorded_s >= SHORTEST_TIME_CONSTANTS * slowest_s:
        return ()
    recommended_s = max(RECOMMENDED_TIME_CONSTANTS * slowest_s, RECOMMENDED_S)
    return (
        f"too short: {recorded_s:.0f} s are {recorded_s / slowest_s:.0f} time constants of the slowest fan "
        f"({slowest_s:.2g} s), and one round of steps takes {SHORTEST_TIME_CONSTANTS}; "
        f"record {np.ceil(recommended_s / 60.0):.0f} min or more, in steps over the whole range of the command",
    )


def misfit_warnings(pieces: Sequence[Run], rmse_rad_s: Array, floor_rad_s: Array) -> tuple[str, ...]:
    """One line for the fans whose free run stays clear of their noise. pieces: without gaps.

    rmse_rad_s: (fans,). floor_rad_s: (fans,) of it due to the tacho alone, 0 where that is instantaneous.
    """
    noise_rad_s = [floor_rad_s[fan] or _noise(pieces, fan) for fan in range(len(rmse_rad_s))]
    fans = [fan for fan, noise in enumerate(noise_rad_s) if rmse_rad_s[fan] > MISFIT * noise > 0.0]
    if not fans:
        return ()
    worst = max(fans, key=lambda fan: rmse_rad_s[fan])
    which = f"fan{'s' * (len(fans) > 1)} {', '.join(map(str, fans))}"
    misses = f"{'up to ' * (len(fans) > 1)}{rmse_rad_s[worst]:.3g} rad/s"
    return (
        f"{which}: the physical model misses the speed by {misses}, of which noise explains "
        f"{noise_rad_s[worst]:.3g} rad/s: use a hybrid; here friction, a dead zone or a drive bend the parameters and "
        "their intervals",
    )


def feedback_share(pieces: Sequence[Run], fan: int) -> float:
    """Share of the command's variation explained by the past noise of the measured speed; 0 if none is found.

    The test of Granger for feedback (Caines and Chan, IEEE Transactions on Automatic Control 20, 1975): what of the
    speed its own past and that of the command do not predict is noise; a command given from outside does not follow
    from past noise, beyond what it follows from its own past. Only samples at which the command moves are looked at,
    and the share must be significant by an F test and large enough to matter: the physics that the linear
    prediction lacks leave traces of the command in the noise, but small ones.

    The noise of the sample at which the command was given counts only where the command moves against it. The other
    sign is a speed measured a little later than its command. pieces: without gaps.

    Of a tacho that counts, one sample of each count is looked at: those between repeat it, and a prediction from them
    leaves the next count as noise, which the command has caused.
    """
    every = [max(1, round(piece.tacho[fan].held_s / piece.median_period_s)) for piece in pieces]
    signals = [
        (piece.command[::step, fan], piece.speed_rad_s[::step, fan]) for piece, step in zip(pieces, every, strict=True)
    ]
    signals = [(command, speed_rad_s) for command, speed_rad_s in signals if len(command) > 4 * LAGS]
    if not signals:
        return 0.0
    predictors = [_predictors(command, speed_rad_s) for command, speed_rad_s in signals]
    noise = np.split(
        _residual(np.concatenate(predictors), np.concatenate([speed_rad_s[LAGS:] for _, speed_rad_s in signals]))[0],
        np.cumsum([len(part) for part in predictors])[:-1],
    )
    move = np.concatenate([np.diff(command)[2 * LAGS - 1 :] for command, _ in signals])
    own_past = np.concatenate([_past(command)[LAGS:] for command, _ in signals])
    noise_now = np.concatenate([part[LAGS:] for part in noise])
    noise_before = np.concatenate([_past(part) for part in noise])

    used = (move != 0.0) & np.isfinite(noise_now) & np.all(np.isfinite(noise_before), axis=1)
    if np.count_nonzero(used) < FEWEST_MOVES:
        return 0.0
    move = move[used]
    largest = LARGEST_MOVE * np.median(np.abs(move))
    move = np.clip(move, -largest, largest)
    own_past = np.column_stack((np.ones(len(move)), own_past[used]))
    everything_before = np.column_stack((own_past, noise_before[used]))
    alone, rank_alone = _residual(own_past, move)
    informed, rank_informed = _residual(everything_before, move)
    new = _residual(everything_before, noise_now[used])[0]
    if new @ informed < 0.0:
        informed, rank_informed = _residual(np.column_stack((everything_before, noise_now[used])), move)
    explained, unexplained = alone @ alone - informed @ informed, informed @ informed
    extra, free = rank_informed - rank_alone, len(move) - rank_informed
    share = float(explained / (move @ move))
    if extra <= 0 or free <= 0 or share < FEEDBACK_SHARE:
        return 0.0
    probability = fdtrc(extra, free, (explained / extra) / (unexplained / free))
    return share if probability < FALSE_ALARM_PROBABILITY else 0.0


def why_a_loop_tells_nothing(pieces: Sequence[Run], fan: int) -> str:
    """Why nothing but noise moved a fan that is in a loop, and what to do; empty: its set-point has moved."""
    low, high = _speed_range(pieces, fan)
    if high - low >= max(RESTS * high, SMALL_SPEED_RANGE_IN_NOISE * _noise(pieces, fan)):
        return ""
    command, speed_rad_s = (
        float(np.nanmedian(np.concatenate([of[:, fan] for of in signals])))
        for signals in ([piece.command for piece in pieces], [np.abs(piece.speed_rad_s) for piece in pieces])
    )
    return (
        f"closed loop at one set-point: the command answers the noise of a speed that keeps between {low:.3g} and "
        f"{high:.3g} rad/s, so J, alpha and C_D cannot be known, only that command {command:.3g} gives "
        f"{speed_rad_s:.3g} rad/s; record several set-points over the range, or steps of the command "
        "(`fantwin command --sweep`)"
    )


def _poor_excitation(pieces: Sequence[Run], fan: int) -> Iterator[str]:
    command = np.concatenate([piece.command[:, fan] for piece in pieces])
    moves = float(np.ptp(command)) / max(float(np.abs(command).max()), np.finfo(float).tiny)
    low, high = _speed_range(pieces, fan)
    noise, steps, levels = _noise(pieces, fan), _steps(pieces, fan), len(np.unique(_levels(command, command)))
    hardly = f"the speed moves by {high - low:.3g} rad/s, hardly more than its noise of {noise:.2g} rad/s"
    reasons = {
        f"the command moves by {moves:.1%} of its largest value only": moves < SMALL_COMMAND_RANGE,
        f"the command changes {steps} time(s) only": steps < FEWEST_STEPS,
        f"the command has {levels} level(s) only": levels < FEWEST_LEVELS,
        hardly: high - low < SMALL_SPEED_RANGE_IN_NOISE * noise,
    }
    if any(reasons.values()):
        yield (
            f"little excitation: {', and '.join(reason for reason, holds in reasons.items() if holds)}; "
            "J, alpha and C_D rest on that alone: record steps between three or more levels, from low to full command"
        )


def _inertia(pieces: Sequence[Run], fan: int, parameters: Array, covariance: Array) -> Iterator[str]:
    inertia, error = parameters[J], np.sqrt(covariance[J, J])
    if error > UNCERTAIN_INERTIA * inertia:
        low, high = _speed_range(pieces, fan)
        yield (
            f"J is poorly determined ({inertia:.3g} ± {REACH * error:.2g}): it shows in transients alone, and too few "
            f"stand out; the speed moves by {high - low:.3g} rad/s, its noise is {_noise(pieces, fan):.2g} rad/s and "
            f"samples are {_period_s(pieces):.2g} s apart: record more and larger steps, several samples in each "
            "transient"
        )


def _drag(pieces: Sequence[Run], fan: int, parameters: Array, covariance: Array) -> Iterator[str]:
    """alpha and C_D: they trade off; or one has the wrong sign, or is not distinguishable from zero."""
    low, high = _speed_range(pieces, fan)
    both, errors = parameters[[ALPHA, C_D]], np.sqrt(np.diag(covariance))
    distinct, well_distinct = (np.all(both > reach * errors[[ALPHA, C_D]]) for reach in (REACH, WELL_DISTINCT))
    product = errors[ALPHA] * errors[C_D]
    correlation = covariance[ALPHA, C_D] / product if product > 0.0 else 0.0
    on_edge = _on_edge(pieces, fan, parameters)
    narrow = high - low < NARROW_SPEED_RANGE * high
    if narrow and (on_edge or (correlation < TRADE_OFF_CORRELATION and not well_distinct)):
        yield (
            f"alpha and C_D cannot be distinguished: the speed keeps between {low:.3g} and {high:.3g} rad/s; "
            f"{_determined(low, high, parameters, covariance)}; record speeds from a third of the largest up to it"
        )
        return
    if distinct and not on_edge:
        return
    for which in (ALPHA, C_D):
        name, value, reach = PARAMETER_NAMES[which], parameters[which], REACH * errors[which]
        if value + reach < 0.0:
            yield (
                f"{name} is negative ({value:.3g} ± {reach:.2g}): the physical model does not describe this data "
                "(friction, dead zone or offset, for which it has no term); do not trust it outside the recorded "
                "speeds; a hybrid learns the difference"
            )
        elif on_edge and which == ALPHA and parameters[C_D] > 0.0:
            yield f"{name} is not distinguishable from zero (the fit drove it there): {MORE_OF[which]}"
        elif value - reach <= 0.0:
            yield f"{name} is not distinguishable from zero ({value:.3g} ± {reach:.2g}): {MORE_OF[which]}"


def _on_edge(pieces: Sequence[Run], fan: int, parameters: Array) -> bool:
    """Whether the fit is at the edge of the stable models: no damping at rest or none at top speed.

    The covariance there is that of a parameter that can no longer move.
    """
    top = np.nanquantile(np.abs(np.concatenate([piece.speed_rad_s[:, fan] for piece in pieces])), TOP_SPEED_QUANTILE)
    damping = parameters[ALPHA], parameters[ALPHA] + 2.0 * parameters[C_D] * top
    return bool(min(damping) < EDGE * max(damping))


def _determined(low_rad_s: float, high_rad_s: float, parameters: Array, covariance: Array) -> str:
    """The sum of alpha and C_D that is known best: their torque per speed at the speed that cancels the covariance."""
    variance = covariance[C_D, C_D]
    speed = -covariance[ALPHA, C_D] / variance if variance > 0.0 else np.nan
    if not low_rad_s <= speed <= high_rad_s:
        return "not even alpha + C_D w is known"
    direction = np.zeros(len(parameters))
    direction[[ALPHA, C_D]] = 1.0, speed
    reach = REACH * np.sqrt(max(float(direction @ covariance @ direction), 0.0))
    return f"what is known is alpha + C_D w = {direction @ parameters:.4g} ± {reach:.1g} at w = {speed:.3g} rad/s"


def _lag(pieces: Sequence[Run], parameters: Array, covariance: Array) -> Iterator[str]:
    lag_s, reach_s, period_s = parameters[LAG_S], REACH * np.sqrt(covariance[LAG_S, LAG_S]), _period_s(pieces)
    if reach_s > 0.0 and lag_s <= max(reach_s, period_s):
        yield (
            f"lag_s ({1e3 * lag_s:.3g} ± {1e3 * reach_s:.2g} ms) is not determined by samples every "
            f"{1e3 * period_s:.3g} ms: no lag, a delay, and clocks of command and speed that differ look the same; "
            "record with several samples in a lag, or take it as the twin's and not as the fan's"
        )


def _predictors(command: Array, speed_rad_s: Array) -> Array:
    """(n - LAGS, 2 LAGS + 2) what the next speed is predicted from; the squared speed stands for the drag."""
    speeds = _past(speed_rad_s)
    return np.column_stack((np.ones(len(speeds)), speeds, speeds[:, 0] * np.abs(speeds[:, 0]), _past(command)))


def _past(signal: Array) -> Array:
    """(n - LAGS, LAGS) the samples before each, the latest first."""
    return np.lib.stride_tricks.sliding_window_view(signal[:-1], LAGS)[:, ::-1]


def _residual(regressors: Array, target: Array) -> tuple[Array, int]:
    """The residual of target (n,), NaN where a value is missing, and the rank of regressors (n, P)."""
    whole = np.isfinite(target) & np.all(np.isfinite(regressors), axis=1)
    size = np.linalg.norm(regressors[whole], axis=0) + np.finfo(float).tiny
    coefficients, _, rank, _ = np.linalg.lstsq(regressors[whole] / size, target[whole], rcond=1e-10)
    return target - regressors @ (coefficients / size), int(rank)


def _levels(command: Array, all_commands: Array) -> Array:
    """(n,) which tenth of the range of all commands each one is nearest to."""
    return np.rint((command - all_commands.min()) / (np.ptp(all_commands) / LEVELS_PER_RANGE))


def _steps(pieces: Sequence[Run], fan: int) -> int:
    """How often the command goes from one tenth of its range to another."""
    command = np.concatenate([piece.command[:, fan] for piece in pieces])
    return sum(int(np.count_nonzero(np.diff(_levels(piece.command[:, fan], command)))) for piece in pieces)


def _speed_range(pieces: Sequence[Run], fan: int) -> tuple[float, float]:
    """The speeds, whatever their direction, that a fan is below for 5 % and for 95 % of the samples, in rad/s."""
    low, high = np.nanquantile(np.abs(np.concatenate([piece.speed_rad_s[:, fan] for piece in pieces])), (0.05, 0.95))
    return float(low), float(high)


def _noise(pieces: Sequence[Run], fan: int) -> float:
    """Standard deviation of the noise of a speed that does not change, in rad/s.

    That of the tacho's resolution where it counts; or else, robust, of white noise with the second differences.
    """
    tacho = pieces[0].tacho[fan]
    if graded := tacho.resolution_rad_s / np.sqrt(tacho.resolution_steps):
        return float(graded)
    bends = np.concatenate([np.diff(piece.speed_rad_s[:, fan], 2) for piece in pieces])
    bends = bends[np.isfinite(bends)]
    return float(1.4826 * np.median(np.abs(bends)) / np.sqrt(6.0)) if bends.size else 0.0


def _period_s(pieces: Sequence[Run]) -> float:
    return float(np.median(np.concatenate([np.diff(piece.t_s) for piece in pieces])))

"""How well a model follows measured runs.

The figures that count are those of the free run: it starts from the mean of the first five measured speeds, as a
deployed twin starts from the measured speed, and is driven by the commands alone. Runs are split at long gaps and
restarted after them. The one-step error, from measured speeds to the next one, is given beside it and says little.
Missing samples count nowhere. RMSE, maximum error and R2 are equations (32) to (34) of Peng and Chen, the band of two
sigma (35) and (36).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.errors import TwinError
from twin.models import TwinModel
from twin.runs import Array, Run, common_fans, starting_speed_rad_s

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Figures:
    """Free-run figures in rad/s (r2 and coverage without unit), and the one-step error beside them.

    Infinite where the free run diverged; NaN where nothing was measured, and r2 where the speed never changed.
    coverage_2_sigma: the share of samples within two healthy standard deviations of the free run.
    """

    rmse_rad_s: float
    max_error_rad_s: float
    r2: float
    one_step_rmse_rad_s: float
    coverage_2_sigma: float
    samples: int


@dataclass(frozen=True)
class Evaluation:
    """Figures of each fan, and of all fans' samples together."""

    per_fan: tuple[Figures, ...]
    pooled: Figures


def evaluate_model(model: TwinModel, parameters: Array, sigma_rad_s: Array, runs: Sequence[Run]) -> Evaluation:
    """Evaluate on runs. parameters: (fans, 3). sigma_rad_s: (fans,) healthy standard deviation of the free run."""
    pieces = evaluation_pieces(runs)
    speed = np.concatenate([piece.speed_rad_s for piece in pieces])
    residual = free_run_residuals(model, parameters, pieces)
    one_step = np.concatenate([_one_step_residual(model, parameters, piece) for piece in pieces])
    within = np.abs(residual) <= 2.0 * sigma_rad_s
    measured = np.isfinite(speed)
    spread = np.where(measured, speed - _column_mean(speed), 0.0) ** 2
    per_fan = tuple(
        _figures(measured[:, fan], residual[:, fan], one_step[:, fan], within[:, fan], spread[:, fan])
        for fan in range(speed.shape[1])
    )
    return Evaluation(per_fan, _figures(measured, residual, one_step, within, spread))


def evaluation_pieces(runs: Sequence[Run]) -> list[Run]:
    """The runs split at their long gaps. Raises TwinError when there is nothing to evaluate."""
    common_fans(runs)
    pieces = [piece for run in runs for piece in run.split_at_gaps()]
    if not pieces:
        raise TwinError("the runs hold nothing but gaps; give runs with two samples in a row or more")
    return pieces


def free_run_residuals(model: TwinModel, parameters: Array, pieces: Sequence[Run]) -> Array:
    """(samples, fans) measured minus free run over pieces one after the other: NaN missing, infinite diverged."""
    parts = []
    for piece in pieces:
        state = model.state_layout.initial_state(starting_speed_rad_s(piece.speed_rad_s), piece.command[0])
        predicted, _ = model.advance(state, piece.command, piece.step_s, parameters)
        parts.append(_residual(piece.speed_rad_s, predicted))
    return np.concatenate(parts)


def healthy_sigma_rad_s(residual: Array) -> Array:
    """(fans,) root mean square of the healthy free-run residual (samples, fans): the band is centred on the twin."""
    count = np.maximum(np.isfinite(residual).sum(axis=0), 1)
    with np.errstate(over="ignore"):
        return np.sqrt(np.nansum(residual**2, axis=0) / count)


def pooled_rmse_rad_s(residual: Array) -> float:
    """Root mean square over all measured samples of a residual (samples, fans)."""
    with np.errstate(over="ignore"):
        return float(np.sqrt(np.nanmean(residual**2)))


def _one_step_residual(model: TwinModel, parameters: Array, piece: Run) -> Array:
    """(n, fans) measured minus the prediction from the measured samples before; NaN where those are missing."""
    predicted = np.full_like(piece.speed_rad_s, np.nan)
    layout = model.state_layout
    for k in range(max(layout.speed - 1, layout.command), piece.samples - 1):
        state = layout.measured_state(piece.speed_rad_s, piece.command, k)
        block = slice(k, k + 1)
        _, following = model.advance(state, piece.command[block], piece.step_s[block], parameters)
        predicted[k + 1] = following[:, 0]
    return piece.speed_rad_s - predicted


def _residual(measured: Array, predicted: Array) -> Array:
    diverged = np.isfinite(measured) & ~np.isfinite(predicted)
    return np.where(diverged, np.inf, measured - predicted)


def _figures(measured: Flags, residual: Array, one_step: Array, within: Flags, spread: Array) -> Figures:
    samples = int(np.count_nonzero(measured))
    if samples == 0:
        return Figures(np.nan, np.nan, np.nan, np.nan, np.nan, 0)
    total, errors = float(spread.sum()), np.where(measured, residual, 0.0)
    with np.errstate(over="ignore"):
        squares = float(np.sum(errors**2))
    steps = one_step[np.isfinite(one_step)]
    return Figures(
        rmse_rad_s=float(np.sqrt(squares / samples)),
        max_error_rad_s=float(np.abs(errors).max()),
        r2=1.0 - squares / total if total > 0.0 else np.nan,
        one_step_rmse_rad_s=float(np.sqrt(np.mean(steps**2))) if steps.size else np.nan,
        coverage_2_sigma=float(np.count_nonzero(within & measured) / samples),
        samples=samples,
    )


def _column_mean(speed_rad_s: Array) -> Array:
    measured = np.isfinite(speed_rad_s)
    return np.where(measured, speed_rad_s, 0.0).sum(axis=0) / np.maximum(measured.sum(axis=0), 1)

"""How far a network may depart from the physics, chosen by cross-validation over recordings.

A free-running model that fits a handful of recordings to the last disturbance predicts the next one worse than its
physics do. With several recordings and none held out, each third of them is left out in turn and predicted in free
run, with several prior standard deviations of the network (mean absolute error, the published loss). The smallest one
is taken that is not worse than the best by more than one standard error of their difference over the recordings (the
rule of one standard error: Hastie, Tibshirani and Friedman, The Elements of Statistical Learning, section 7.10). For a
hybrid zero is among the choices: no network at all.
"""

from collections.abc import Sequence

import numpy as np

from fantwin.twin.errors import TwinError
from fantwin.twin.evaluation.accuracy import evaluation_pieces, free_run_residuals
from fantwin.twin.fitting.identification import identify
from fantwin.twin.fitting.training import GRID_PRIOR_STD, train_network
from fantwin.twin.models.fan_ode import NetworkOde
from fantwin.twin.progress import Progress, unreported, within
from fantwin.twin.runs import Array, Run

PRIOR_STDS = (0.1 * GRID_PRIOR_STD, GRID_PRIOR_STD)
FOLDS = 3
ITERATIONS = 25


def choose_prior_std(model: NetworkOde, runs: Sequence[Run], *, seed: int, progress: Progress = unreported) -> float:
    """The prior standard deviation for training.train_network.

    GRID_PRIOR_STD where there is a single run, or where the runs are too few to leave some out.
    """
    # A recording in which some fan was never measured cannot be evaluated.
    runs = [run for run in runs if np.all(np.isfinite(run.speed_rad_s).any(axis=0))]
    folds = min(FOLDS, len(runs))
    if folds < 2:
        return GRID_PRIOR_STD
    prior_stds = (0.0, *PRIOR_STDS) if model.has_physics else PRIOR_STDS
    losses: list[list[float]] = [[] for _ in prior_stds]
    for fold in range(folds):
        left_out, rest = list(runs[fold::folds]), [run for k, run in enumerate(runs) if k % folds != fold]
        of_fold = within(f"cross-validation {fold + 1} of {folds}", progress)
        try:
            identification = identify(rest, progress=of_fold)
        except TwinError:
            # The remaining runs do not excite every fan: this choice cannot be fitted.
            return GRID_PRIOR_STD
        for index, prior_std in enumerate(prior_stds):
            trained, parameters, _ = train_network(
                model,
                rest,
                [],
                identification,
                max_iterations=ITERATIONS,
                seed=seed,
                prior_std=prior_std,
                progress=within(f"choice {index + 1} of {len(prior_stds)}", of_fold),
            )
            # The mean absolute error in rad/s of each; infinite where its free run diverges.
            residuals = (free_run_residuals(trained, parameters, evaluation_pieces([run])) for run in left_out)
            losses[index] += [float(np.nanmean(np.abs(residual))) for residual in residuals]
    return prior_stds[simplest_of_the_best(np.array(losses))]


def simplest_of_the_best(losses: Array) -> int:
    """The first choice that is not worse than the best one by more than a standard error. losses: (choices, runs)."""
    best = losses[int(np.argmin(losses.mean(axis=1)))]
    with np.errstate(invalid="ignore"):
        worse = losses - best
        error = worse.std(axis=1, ddof=1) / np.sqrt(losses.shape[1])
        return int(np.argmax(worse.mean(axis=1) <= error))

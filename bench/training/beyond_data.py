"""Beyond the data: twins trained below 75 % of the command, judged above.

How wrong the free run is there, beside NARX and the physics, and whether the card says so: the share of readings within
two standard deviations of the free run, by the healthy sigma alone, and with the unseen error of the card as well
(twin.fitting.model_uncertainty).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
import typer

from bench.printing import JsonOption, progress, show
from bench.training.measured_sets import esc_test
from bench.training.published_fan import random_stairs
from bench.training.rough_table import DUTY_RANGE, simulated_plant
from fantwin.twin.build import train_twin
from fantwin.twin.evaluation.accuracy import compared_readings, evaluation_pieces, free_run_readings
from fantwin.twin.finishing import TrainedTwin
from fantwin.twin.runs import Run

SHARE = 0.75
SECONDS = 80.0
LEAST_SAMPLES = 50
KINDS = (("physical", 1), ("narx", 1), ("hybrid", 1), ("hybrid", 4))


def main(
    seeds: Annotated[int, typer.Option(min=1, help="How many seeds of weights, and of simulated data.")] = 3,
    json_output: JsonOption = False,
) -> None:
    """Print the error above 75 % of the command, and the coverage of two standard deviations."""
    rows: dict[str, list[dict[str, Any]]] = {}
    for name, unit_rad_s in (("rough plant", 1.0), ("esc_test, duty", np.pi / 30.0)):
        title = f"{name}, above {SHARE:.0%} of the command"
        rows[title] = []
        for seed in range(seeds):
            training, held_out = _parted(esc_test()) if unit_rad_s != 1.0 else _simulated(seed)
            for kind, networks in KINDS:
                progress(f"{title}: {kind}, {networks} network(s), seed {seed}")
                twin = train_twin(training, [], kind, name=kind, seed=seed, networks=networks)
                row = {"model": kind, "networks": networks, "seed": seed}
                rows[title].append(row | _judged(twin, held_out, _highest(training), unit_rad_s))
    show(
        rows,
        ["rmse: rad/s, of esc_test rpm", "asked of the hybrid: coverage 0.9 with the unseen error"],
        as_json=json_output,
    )


def _simulated(seed: int) -> tuple[list[Run], list[Run]]:
    low, high = DUTY_RANGE
    below = low + SHARE * (high - low)
    return (
        [simulated_plant(random_stairs(seed, SECONDS, 1, low, below), seed).run],
        [simulated_plant(random_stairs(1000 + seed, SECONDS, 1, low, high), 1000 + seed).run],
    )


def _parted(runs: Sequence[Run]) -> tuple[list[Run], list[Run]]:
    """The stretches below the share of the highest command, and those above."""
    limit = SHARE * _highest(runs)
    parts: tuple[list[Run], list[Run]] = ([], [])
    for run in runs:
        is_above = run.command[:, 0] > limit
        edges = [0, *(np.flatnonzero(np.diff(is_above)) + 1).tolist(), run.samples]
        for first, end in pairwise(edges):
            if end - first >= LEAST_SAMPLES:
                parts[int(is_above[first])].append(run.rows(first, end))
    return parts


def _highest(runs: Sequence[Run]) -> float:
    return max(float(run.command.max()) for run in runs)


def _judged(twin: TrainedTwin, runs: Sequence[Run], trained_to: float, unit_rad_s: float) -> dict[str, Any]:
    """Over the samples whose command is above that of training."""
    sigma_rad_s, uncertainty = np.array(twin.card.sigma_rad_s), twin.card.model_uncertainty
    errors, unseen = [], []
    for piece in evaluation_pieces(runs):
        predicted = free_run_readings(twin.model, twin.parameters, piece)
        error = compared_readings(piece) - predicted
        kept = np.isfinite(error) & (piece.command > trained_to)
        errors.append(error[kept])
        unseen.append(
            (uncertainty.unseen_std_at(predicted, piece.command) if uncertainty else np.zeros_like(error))[kept]
        )
    error, unseen_rad_s = np.concatenate(errors), np.concatenate(unseen)
    return {
        "rmse": float(np.sqrt(np.mean(error**2))) / unit_rad_s,
        "covered by sigma": round(float(np.mean(np.abs(error) <= 2.0 * sigma_rad_s)), 2),
        "with the unseen error": round(float(np.mean(np.abs(error) <= 2.0 * np.hypot(sigma_rad_s, unseen_rad_s))), 2)
        if uncertainty
        else "-",
        "unseen error, median": float(np.median(unseen_rad_s)) / unit_rad_s if uncertainty else "-",
    }


if __name__ == "__main__":
    typer.run(main)

"""Detectors of established libraries, on typical features: mean and standard deviation of the residuals over one
second.

Every 0.16 s, mean and standard deviation over the last second of both residuals: four features. A model of PyOD is
fitted to healthy fans of all trays together; the half-space trees of river learn on and on, for each fan alone, as is
their kind. `pip install '.[bench]'` brings both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bench.detection.methods import Method
from bench.detection.residuals import Moving, balance_sigmas, speed_sigmas
from fantwin.schemas.messages import Array, Prediction

WINDOW_S = 1.0
ROWS = 16
"""from one set of features to the next"""
FITTED_ON = 20_000
LARGEST_SIGMAS = 20.0


class Features:
    """Mean and standard deviation of both residuals over the last second."""

    def __init__(self, rate_hz: float) -> None:
        self._moving = Moving(round(WINDOW_S * rate_hz))

    def take(self, block: Prediction) -> Array:
        """(m, fans, 4) for every ROWS-th sample; NaN where there is none."""
        residuals = np.stack((speed_sigmas(block), balance_sigmas(block)), axis=-1)
        means = self._moving.means(np.concatenate((residuals, np.square(residuals)), axis=-1))[::ROWS]
        std = np.sqrt(np.maximum(means[..., 2:] - np.square(means[..., :2]), 0.0))
        return np.clip(np.concatenate((means[..., :2], std), axis=-1), -LARGEST_SIGMAS, LARGEST_SIGMAS)


class Scored:
    """The score of a set of features holds until the next one."""

    def __init__(self, rate_hz: float, score: Callable[[Array], Array]) -> None:
        """score: (k, fans, 4), NaN where there is nothing, to (k, fans)."""
        self._features = Features(rate_hz)
        self._score = score

    def take(self, block: Prediction) -> Array:
        """See methods.Scores."""
        return np.repeat(self._score(self._features.take(block)), ROWS, axis=0)[: len(block.t_ns)]


def library_methods(rate_hz: float, healthy: Sequence[Sequence[Prediction]], *, few_fans: bool) -> list[Method]:
    """One of each library. healthy: runs to fit to. few_fans: only some are scored, for these are slow.

    Ends the program with one line where a library is missing.
    """
    try:
        from pyod.models.knn import KNN  # pyright: ignore[reportMissingImports]  # noqa: PLC0415
        from river.anomaly import HalfSpaceTrees  # pyright: ignore[reportMissingImports]  # noqa: PLC0415
    except ImportError as error:
        raise SystemExit(
            f"{error.name} is missing: `make bench` installs it, or .venv/bin/pip install pyod river"
        ) from error
    return [
        _pyod_method("nearest neighbours", KNN(), rate_hz, healthy, 3 if few_fans else 1),
        _river_method(HalfSpaceTrees, rate_hz, 13 if few_fans else 1),
    ]


def _pyod_method(name: str, model: Any, rate_hz: float, healthy: Sequence[Sequence[Prediction]], every: int) -> Method:
    parts = []
    for run in healthy:
        features = Features(rate_hz)
        parts += [features.take(block).reshape(-1, 4) for block in run]
    known = np.concatenate(parts)
    known = known[np.isfinite(known).all(axis=1)]
    rows = np.random.default_rng(0).permutation(len(known))[:FITTED_ON]
    model.fit(known[rows])

    def score(features: Array) -> Array:
        scores = np.full(features.shape[:2], np.nan)
        flat = features[:, ::every].reshape(-1, 4)
        scored = np.isfinite(flat).all(axis=1)
        found = np.full(len(flat), np.nan)
        if scored.any():
            found[scored] = model.decision_function(flat[scored])
        scores[:, ::every] = found.reshape(len(features), -1)
        return scores

    return Method(f"PyOD {name}", lambda _: Scored(rate_hz, score), every=every)


def _river_method(half_space_trees: Callable[..., Any], rate_hz: float, every: int) -> Method:
    """Tan, Ting and Liu, IJCAI 2011."""
    limits = dict.fromkeys(range(4), (-LARGEST_SIGMAS, LARGEST_SIGMAS))

    def scores(fans: int) -> Scored:
        trees = {fan: half_space_trees(window_size=1000, limits=limits, seed=fan) for fan in range(0, fans, every)}

        def score(features: Array) -> Array:
            scored = np.full(features.shape[:2], np.nan)
            for fan, tree in trees.items():
                for row in np.flatnonzero(np.isfinite(features[:, fan]).all(axis=1)).tolist():
                    sample = dict(enumerate(features[row, fan].tolist()))
                    scored[row, fan] = tree.score_one(sample)
                    tree.learn_one(sample)
            return scored

        return Scored(rate_hz, score)

    return Method("river half-space trees", scores, every=every)

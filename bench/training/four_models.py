"""Figures of the models that `fantwin train` sets side by side (twin.comparison), over runs held out."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from fantwin.twin.build import evaluate, train_twin
from fantwin.twin.comparison import Contender, contend
from fantwin.twin.evaluation.accuracy import Figures
from fantwin.twin.kinds import ModelKind
from fantwin.twin.runs import Run

NO_FIGURES = Figures(np.inf, np.inf, -np.inf, np.inf, 0.0, 0)


def trained(kind: ModelKind, runs: Sequence[Run], seed: int) -> Contender:
    """One kind, trained on runs without any held out."""
    train = partial(train_twin, runs, [], kind.name, name=kind.title, seed=seed)
    return contend(kind, train, runs, [])


def held_out_figures(contender: Contender, runs: Sequence[Run]) -> Figures:
    """Figures of the free run, pooled over the fans. Infinite if it diverges or the model could not be trained."""
    return evaluate(contender.twin, runs).pooled if contender.twin else NO_FIGURES


def trained_in_s(contender: Contender) -> float:
    """How long identification and training took."""
    return contender.twin.card.training.duration_s if contender.twin else np.nan

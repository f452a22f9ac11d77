"""Several models trained on the same recordings and evaluated on the same other recordings."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from fantwin.twin.build import evaluate
from fantwin.twin.errors import TwinError
from fantwin.twin.evaluation.accuracy import Evaluation, evaluation_pieces, free_run_residuals, pooled_rmse_rad_s
from fantwin.twin.export.fan_rows import measured_as_in_card
from fantwin.twin.finishing import TrainedTwin
from fantwin.twin.kinds import ModelKind
from fantwin.twin.models.physics import LAG, PARAMETER_NAMES
from fantwin.twin.runs import Run

Source = Literal["test", "held-out", "training"]
"""Which data a figure is of. test: not used in training. held-out: not fitted, but used to stop training and for
sigma. training: fitted, so too optimistic."""


@dataclass(frozen=True, eq=False)
class Contender:
    """A kind of model and its twin. twin is None if it could not be trained: invalid_reason says why, in one line.

    training_rmse_rad_s: free run over the training runs. held_out, test: None without such runs.
    """

    kind: ModelKind
    twin: TrainedTwin | None = None
    invalid_reason: str = ""
    training_rmse_rad_s: float = np.nan
    training: Evaluation | None = None
    held_out: Evaluation | None = None
    test: Evaluation | None = None

    @property
    def judged(self) -> Evaluation | None:
        """Its figures over the data of the comparison."""
        return self.test or self.held_out or self.training

    @property
    def physical_parameters(self) -> int:
        """How many of a fan's own parameters the model uses; a lag of zero is none."""
        if self.twin is None:
            return 0
        has_lag = bool(np.any(self.twin.parameters[:, LAG] != 0.0))
        return sum(has_lag or name != PARAMETER_NAMES[LAG] for name in self.twin.model.used_parameters)


def source_of(validation_runs: Sequence[Run], test_runs: Sequence[Run]) -> Source:
    """The data for comparing models: the test runs, or else the held-out ones, or else the training runs."""
    return "test" if test_runs else "held-out" if validation_runs else "training"


def contend(
    kind: ModelKind,
    train: Callable[[], TrainedTwin],
    runs: Sequence[Run],
    test_runs: Sequence[Run],
    fan_numbers: Sequence[int] | None = None,
) -> Contender:
    """Train one kind on the runs by `train` and evaluate it. test_runs take no part in training; fan_numbers: as of
    build.train_twin.

    A kind that cannot be trained, while others can, is a result and not an error.
    """
    try:
        trained = train()
    except TwinError as error:
        return Contender(kind, invalid_reason=str(error))
    pieces = evaluation_pieces(measured_as_in_card(trained.card, range(trained.card.fans), runs))
    residual = free_run_residuals(trained.model, trained.parameters, pieces)
    is_held_out = trained.card.validation.source == "held-out"
    return Contender(
        kind,
        trained,
        training_rmse_rad_s=pooled_rmse_rad_s(residual),
        training=None if is_held_out else trained.validation,
        held_out=trained.validation if is_held_out else None,
        test=evaluate(trained, test_runs, fan_numbers) if test_runs else None,
    )


def best(contenders: Sequence[Contender]) -> Contender:
    """The one with the smallest free-run rmse over the data of the comparison.

    Raises TwinError when none could be trained, with the reason of the first.
    """
    able = [(each.judged.pooled.rmse_rad_s, each) for each in contenders if each.judged]
    if not able:
        raise TwinError(contenders[0].invalid_reason)
    return min(able, key=lambda pair: pair[0])[1]

"""Trains a twin on what was read from recordings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias

from fantwin.pipeline.learning.training_data import TrainingData, data_cards

if TYPE_CHECKING:
    from fantwin.twin.each_network import ForEachNetwork
    from fantwin.twin.finishing import TrainedTwin
    from fantwin.twin.progress import Progress

Trainer: TypeAlias = Literal["levenberg-marquardt", "adam"]
"""repeated here, because twin takes a while to load"""
NETWORKS = 4
"""enough that twins hardly depend on the seed: docs/reference/benchmarks.md"""


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of a training: the options of `fantwin train` explain them."""

    model: str = "hybrid"
    seed: int = 0
    trainer: Trainer = "levenberg-marquardt"
    iterations: int | None = None
    networks: int | None = None
    command_unit: str = ""


DEFAULT_SETTINGS = TrainingSettings()


def fit_twin(
    training_data: TrainingData,
    held_out: TrainingData | None,
    name: str,
    settings: TrainingSettings = DEFAULT_SETTINGS,
    progress: Progress | None = None,
    each_network: ForEachNetwork | None = None,
) -> TrainedTwin:
    """Train a twin on what was read. held_out: chooses its weights and gives its band. each_network: runs the trainings
    of its networks; None: in this process, one after another.

    Raises:
        TwinError: the data do not suffice.
    """
    from fantwin.twin.build import train_twin  # noqa: PLC0415  the command line loads twin only when it is needed
    from fantwin.twin.each_network import one_after_another  # noqa: PLC0415
    from fantwin.twin.kinds import find_kind  # noqa: PLC0415
    from fantwin.twin.progress import unreported  # noqa: PLC0415

    can_average = find_kind(settings.model).has_ode_network and settings.trainer == DEFAULT_SETTINGS.trainer
    return train_twin(
        training_data.runs,
        held_out.runs if held_out else [],
        settings.model,
        name=name,
        seed=settings.seed,
        max_iterations=settings.iterations,
        trainer=settings.trainer,
        networks=settings.networks if settings.networks is not None else NETWORKS if can_average else 1,
        each_network=each_network or one_after_another,
        command_unit=settings.command_unit,
        fan_numbers=training_data.fans,
        data=data_cards(training_data),
        validation_data=data_cards(held_out) if held_out else (),
        progress=progress or unreported,
    )

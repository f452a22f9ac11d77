"""The kinds of model, one row each. `fantwin train`, `compare` and `report` know the kinds from here alone.

To add a kind: a file in twin.models with a class that offers what twin.models.model.Model asks for, and a row here
with the function that fits it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

from fantwin.twin.errors import TwinError
from fantwin.twin.fitting.model_fits import FitRequest, FittedModel, Trainer, fit_narx, fit_network_ode, fit_physical
from fantwin.twin.models import hybrid, neural_ode
from fantwin.twin.models.hybrid import Hybrid
from fantwin.twin.models.narx import Narx
from fantwin.twin.models.neural_ode import NeuralOde
from fantwin.twin.models.physical import PhysicalModel

BOTH_INPUTS = ("speed", "command")


@dataclass(frozen=True)
class Variant:
    """A kind with certain network inputs, as comparisons train it. name: for programs. title: for people."""

    name: str
    title: str
    network_inputs: tuple[str, ...] = BOTH_INPUTS


@dataclass(frozen=True)
class ModelKind:
    """A kind of model.

    name: in cards and on the command line. title: for people. fit: from data to a model. trainers: those that can
    train it. variants: what comparisons train; without any, the kind itself. predicts: the speed, which the tacho then
    measures, or the readings themselves. knows_drives: it can be put behind a drive (twin.models.drive).
    averages_networks: it can be the mean of several trainings (twin.fitting.mean_model).
    """

    name: str
    title: str
    fit: Callable[[FitRequest], FittedModel]
    trainers: tuple[Trainer, ...] = ("levenberg-marquardt",)
    variants: tuple[Variant, ...] = ()
    predicts: Literal["speed", "readings"] = "speed"
    knows_drives: bool = False
    averages_networks: bool = False


KINDS = [
    ModelKind(PhysicalModel.kind, "physical", fit_physical, knows_drives=True),
    ModelKind(Narx.kind, "NARX", fit_narx, predicts="readings"),
    ModelKind(
        NeuralOde.kind,
        "neural ODE",
        partial(fit_network_ode, units=neural_ode.UNITS, make=NeuralOde),
        trainers=("levenberg-marquardt", "adam"),
        knows_drives=True,
        averages_networks=True,
    ),
    ModelKind(
        Hybrid.kind,
        "hybrid",
        partial(fit_network_ode, units=hybrid.UNITS, make=Hybrid),
        trainers=("levenberg-marquardt", "adam"),
        knows_drives=True,
        averages_networks=True,
        variants=(Variant("hybrid", "hybrid [w, tau]"), Variant("hybrid-w", "hybrid [w]", network_inputs=("speed",))),
    ),
]


def find_kind(name: str) -> ModelKind:
    """The kind of this name. Raises TwinError when there is none."""
    for kind in KINDS:
        if kind.name == name:
            return kind
    raise TwinError(f"kind {name!r} is unknown; use one of {', '.join(kind.name for kind in KINDS)}")


def kind_title(name: str) -> str:
    """The title of a kind for people; of an unknown one, such as in the card of a later version, its name."""
    return next((kind.title for kind in KINDS if kind.name == name), name)

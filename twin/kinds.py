"""The kinds of model, one row each. `fantwin train` and `report` know the kinds from here alone.

To add a kind: a file in twin.models with a class that offers what twin.models.model.Model asks for, and a row here
with the function that fits it. A card holds the `kind` of that class.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal

from fantwin.twin.errors import TwinError
from fantwin.twin.fitting.model_fits import (
    FitRequest,
    FittedModel,
    fit_narx,
    fit_network_ode,
    fit_physical,
    fit_static_model,
)
from fantwin.twin.models import hybrid, neural_ode
from fantwin.twin.models.hybrid import Hybrid
from fantwin.twin.models.narx import Narx
from fantwin.twin.models.neural_ode import NeuralOde
from fantwin.twin.models.physical import PhysicalModel
from fantwin.twin.models.static import StaticModel


@dataclass(frozen=True)
class ModelKind:
    """A kind of model.

    name: on the command line. title: for people. fit: from data to a model. predicts: the speed, which the tacho then
    measures, or the readings themselves. knows_motion: its errors after a change of the command count; those of a kind
    that does not are not comparable. knows_drives: it can be put behind a drive (twin.models.drive).
    has_ode_network: it has a network that adam can train as well, and that can be the mean of several trained ones
    (twin.fitting.mean_of_networks).
    """

    name: str
    title: str
    fit: Callable[[FitRequest], FittedModel]
    predicts: Literal["speed", "readings"] = "speed"
    knows_motion: bool = True
    knows_drives: bool = False
    has_ode_network: bool = False


_neural_ode = partial(fit_network_ode, make=NeuralOde, units=neural_ode.UNITS)
_hybrid = partial(fit_network_ode, make=Hybrid, units=hybrid.UNITS)
_hybrid_w = partial(_hybrid, inputs=("speed",))

KINDS = [
    ModelKind(PhysicalModel.kind, "physical", fit_physical, knows_drives=True),
    ModelKind(Narx.kind, "NARX", fit_narx, predicts="readings"),
    ModelKind(NeuralOde.kind, "neural ODE", _neural_ode, knows_drives=True, has_ode_network=True),
    ModelKind(Hybrid.kind, "hybrid", _hybrid, knows_drives=True, has_ode_network=True),
    ModelKind("hybrid-w", "hybrid [w]", _hybrid_w, knows_drives=True, has_ode_network=True),
    ModelKind(StaticModel.kind, "static", fit_static_model, predicts="readings", knows_motion=False),
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

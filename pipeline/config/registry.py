"""The stages, named by import string: the pipeline knows their names and order, never their code.

The order is that of the data. The launcher starts from the end, so that whoever listens is there first,
and stops from the beginning, so that what is in flight arrives.
"""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pipeline.runtime.stage import Stage

STAGES: dict[str, str] = {
    "acquisition": "stages.acquisition:STAGE",
    "resampler": "stages.resampler:STAGE",
    "twin_integrator": "stages.twin_integrator:STAGE",
    "scorer": "stages.scorer:STAGE",
    "recorder": "stages.recorder:STAGE",
    "viewer": "stages.viewer:STAGE",
}


@cache
def load_stage(name: str) -> Stage:
    """The declaration of the stage called `name`.

    Raises:
        KeyError: no such stage.
    """
    module, attribute = STAGES[name].split(":")
    return getattr(import_module(module), attribute)

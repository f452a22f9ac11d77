"""Runs at other supply voltages and temperatures as if they had been recorded at those of a twin.

schemas.reference_conditions has the physics. A run that is converted has no auxiliary columns any more.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fantwin.schemas.reference_conditions import ConditionRatios, ReferenceConditions
from fantwin.twin.errors import TwinError
from fantwin.twin.runs import Array, Run

LEAST_KNOWN = 0.95
"""a quantity is used if it is known in so large a share of the samples of each run and fan"""


def reference_of(runs: Sequence[Run]) -> ReferenceConditions | None:
    """The conditions of a twin of these runs: the medians of what is known throughout; None where nothing is."""
    supply_v, temperature_c = _median(runs, "supply_voltage_v"), _median(runs, "temperature_c")
    if supply_v is not None and supply_v <= 0.0:
        supply_v = None
    if supply_v is None and temperature_c is None:
        return None
    return ReferenceConditions(supply_voltage_v=supply_v, temperature_c=temperature_c)


def at_reference(runs: Sequence[Run], reference: ReferenceConditions | None) -> list[Run]:
    """The runs at the reference conditions: commands and speeds converted, speeds missing where these are not known.

    Raises TwinError when a run does not have a quantity that is needed.
    """
    if reference and reference.needed:
        return [_converted(run, reference) for run in runs]
    return [replace(run, auxiliary={}) if run.auxiliary else run for run in runs]


def ratios_of(run: Run, reference: ReferenceConditions) -> tuple[Array, Array, NDArray[np.bool_]]:
    """The ratios of torque and density over a run, and whether all that is needed is known; (n, fans) each.

    Raises TwinError when the run does not have a quantity that is needed.
    """
    for name in reference.needed:
        if name not in run.auxiliary:
            raise TwinError(f"run {run.name!r} has no {name}, which the twin needs: give recordings that have it")
    nothing = np.zeros((0, run.fans))
    columns = [run.auxiliary.get(name, nothing) for name in ("supply_voltage_v", "temperature_c")]
    return ConditionRatios(reference, run.fans).update(run.t_s, columns[0], columns[1])


def _converted(run: Run, reference: ReferenceConditions) -> Run:
    torque, density, known = ratios_of(run, reference)
    speed_rad_s = np.where(known, run.speed_rad_s * density, np.nan)
    return replace(run, command=run.command * torque * density, speed_rad_s=speed_rad_s, auxiliary={})


def _median(runs: Sequence[Run], name: str) -> float | None:
    """Over all runs; None if it is not known nearly throughout."""
    if not runs or any(name not in run.auxiliary for run in runs):
        return None
    probe = ReferenceConditions(**{name: 1.0})
    if any(ratios_of(run, probe)[2].mean(axis=0).min() < LEAST_KNOWN for run in runs):
        return None
    values = np.concatenate([run.auxiliary[name].ravel() for run in runs])
    return float(f"{np.nanmedian(values):.6g}")

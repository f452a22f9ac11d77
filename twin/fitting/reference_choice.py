"""Chooses the measured conditions that a twin allows for.

Torque is proportional to the supply voltage, and drag to the density of the air: this is physics and is not fitted. But
a fan that controls its own speed compensates for both, and a column may be bad. So if a quantity varies enough, the
fans are also identified without it, and it is left out if the error of the free run is then lower.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from fantwin.schemas.channels import BY_NAME
from fantwin.schemas.reference_conditions import ReferenceConditions
from fantwin.twin.errors import TwinError
from fantwin.twin.fitting.identification import Identification, identify
from fantwin.twin.progress import Progress, unreported, within
from fantwin.twin.reference import at_reference, ratios_of, reference_of
from fantwin.twin.runs import Run

LEAST_VARIATION = 0.01
"""a quantity is tested only if the standard deviation of its ratio (of torque, or of density) exceeds this for a fan"""
LEAST_GAIN = 0.01
"""a quantity is left out if the free-run error is then lower by more than this share"""


@dataclass(frozen=True, eq=False)
class AtReference:
    """The identification. conditions: those of the twin; None: no quantity is used. notes: a line for each left out."""

    conditions: ReferenceConditions | None
    identification: Identification
    notes: tuple[str, ...]


def identify_at_reference(
    runs: Sequence[Run], validation_runs: Sequence[Run] = (), *, progress: Progress = unreported
) -> AtReference:
    """Identify every fan at the reference conditions of all runs. Raises TwinError as `identify` does."""
    conditions = reference_of([*runs, *validation_runs])
    identification = identify(at_reference(runs, conditions), progress=progress)
    notes: list[str] = []
    for name in conditions.needed if conditions else ():
        assert conditions is not None
        which = 0 if name == "supply_voltage_v" else 1
        ratios = np.concatenate([ratios_of(run, conditions)[which] for run in runs])
        if np.std(ratios, axis=0).max() <= LEAST_VARIATION:
            continue
        fewer = replace(conditions, **{name: None})
        try:
            without = identify(at_reference(runs, fewer), progress=within(f"without {BY_NAME[name].title}", progress))
        except TwinError:  # they cannot be identified without it
            continue
        with_rad_s, without_rad_s = (float(np.sqrt(np.mean(each.rmse_rad_s**2))) for each in (identification, without))
        if without_rad_s < (1.0 - LEAST_GAIN) * with_rad_s:
            conditions, identification = fewer, without
            notes.append(
                f"{BY_NAME[name].title}: not used, because the fans do not follow it: "
                f"the error of the physical free run is "
                f"{without_rad_s:.3g} rad/s without it and {with_rad_s:.3g} rad/s with it"
            )
    return AtReference(conditions if conditions and conditions.needed else None, identification, tuple(notes))


def behind_a_drive(found: AtReference) -> tuple[str, ...]:
    """The notes of a twin of fans that control their own speed: why it uses none of the quantities."""
    if found.conditions is None:
        return found.notes
    unused = " and ".join(BY_NAME[name].title for name in found.conditions.needed)
    return (*found.notes, f"{unused}: not used, because these fans control their own speed")

"""Which measured conditions a twin allows for: those with which the physics of the fans fit.

Torque is proportional to the supply voltage, and drag to the density of the air: this is physics and is not fitted. But
a fan that controls its own speed makes up for both, and a column may be bad. So where a quantity varies enough to tell,
the fans are identified without it, too, and it is left out if the free run is then better.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from schemas.reference_conditions import ReferenceConditions
from twin.fitting.identification import Identification, identify
from twin.progress import Progress, unreported, within
from twin.reference import at_reference, ratios_of, reference_of
from twin.runs import Run

LEAST_VARIATION = 0.01
"""standard deviation of the ratio of torque, or of density, from which on the data can tell"""
LEAST_GAIN = 0.01
"""a quantity is left out if that lowers the free-run error by more than this share"""
TITLES = {"supply_voltage_v": "supply voltage", "temperature_c": "temperature"}


@dataclass(frozen=True, eq=False)
class AtReference:
    """What is identified. conditions: the twin's; None: no quantity counts. notes: a line for each that is left out."""

    conditions: ReferenceConditions | None
    identification: Identification
    notes: tuple[str, ...]


def identify_at_reference(
    runs: Sequence[Run], validation_runs: Sequence[Run] = (), *, progress: Progress = unreported
) -> AtReference:
    """Identify every fan at the reference conditions of all runs. Raises TwinError as identify."""
    conditions = reference_of([*runs, *validation_runs])
    identification = identify(at_reference(runs, conditions), progress=progress)
    notes: list[str] = []
    for name in conditions.needed if conditions else ():
        assert conditions is not None
        if not _varies(runs, conditions, name):
            continue
        fewer = replace(conditions, **{name: None})
        without = identify(at_reference(runs, fewer), progress=within(f"without {TITLES[name]}", progress))
        with_rad_s, without_rad_s = (_rmse_rad_s(each) for each in (identification, without))
        if without_rad_s < (1.0 - LEAST_GAIN) * with_rad_s:
            conditions, identification = fewer, without
            notes.append(
                f"{TITLES[name]}: not used, because the fans do not follow it: the error of the physical free run is "
                f"{without_rad_s:.3g} rad/s without it and {with_rad_s:.3g} rad/s with it"
            )
    return AtReference(conditions if conditions and conditions.needed else None, identification, tuple(notes))


def behind_a_drive(found: AtReference) -> tuple[str, ...]:
    """Why a twin of fans that control their own speed allows for nothing; its notes."""
    if found.conditions is None:
        return found.notes
    unused = " and ".join(TITLES[name] for name in found.conditions.needed)
    return (*found.notes, f"{unused}: not used, because these fans control their own speed")


def _varies(runs: Sequence[Run], conditions: ReferenceConditions, name: str) -> bool:
    ratios = np.concatenate([ratios_of(run, conditions)[0 if name == "supply_voltage_v" else 1] for run in runs])
    return bool(np.std(ratios, axis=0).max() > LEAST_VARIATION)


def _rmse_rad_s(identification: Identification) -> float:
    return float(np.sqrt(np.mean(identification.rmse_rad_s**2)))

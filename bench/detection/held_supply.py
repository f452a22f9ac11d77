"""Compare twins with and without the supply voltage: 4-pin fans that hold their speed, and ones that follow the supply.

For each seed and kind of fan, two physical twins are trained on half an hour of a thermostat's commands, with and
without the measured supply voltage and temperature. Each runs freely over another half hour. Printed are their errors,
what the first one uses, and the errors of the physical model without a drive (`identify`) on the training run.

    python -m bench.detection.held_supply [--seeds 3] [--seconds 1800]
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bench.detection.tray_run import run_of
from fantwin.schemas.reference_conditions import ReferenceConditions
from fantwin.schemas.tacho import Tacho
from fantwin.simulation.plant import Surroundings
from fantwin.simulation.tacho import TachoSettings
from fantwin.simulation.tray import TraySettings
from fantwin.twin.build import evaluate, train_twin
from fantwin.twin.finishing import TrainedTwin
from fantwin.twin.fitting.identification import identify
from fantwin.twin.reference import at_reference, reference_of
from fantwin.twin.runs import Run

FANS, RATE_HZ, FANS_SEED = 3, 10.0, 7
TACHO = Tacho(kind="count", window_s=1.0, pulses=2)
WANDERS = (0.05, 0.0)
HELD = {1.0: "hold their speed", 0.0: "follow the supply"}


def simulated(seed: int, held: float, wander: float, seconds: float) -> Run:
    """A run with supply voltage and temperature."""
    return run_of(
        TraySettings(
            fans=FANS,
            fan="4-pin",
            rate_hz=RATE_HZ,
            duration_s=seconds,
            profile="thermostat",
            seed=seed,
            fans_seed=FANS_SEED,
            tacho=TachoSettings((TACHO,)),
            surroundings=Surroundings(
                supply_wander=wander,
                supply_held=held,
                temperature_swing_c=8.0,
                measured=("supply_voltage_v", "temperature_c"),
            ),
        )
    )


def found(twin: TrainedTwin) -> str:
    """Whether the twin has a drive, and which columns it uses."""
    used = " and ".join(twin.card.conditions.needed) if twin.card.conditions else "no columns"
    return f"{'a drive' if twin.card.drive else 'no drive'}, {used}"


def of_physics(run: Run, reference: ReferenceConditions | None) -> float:
    """The free-run error of the physical model without a drive on the run that it is fitted to, rad/s."""
    identified = identify(at_reference([run], reference))
    return float(np.sqrt(np.mean(identified.rmse_rad_s**2)))


def error_rad_s(twin: TrainedTwin, run: Run) -> float:
    """The error of the free run, rad/s; NaN where nothing is measured."""
    rmse_rad_s = evaluate(twin, [run]).pooled.rmse_rad_s
    return float("nan") if rmse_rad_s is None else rmse_rad_s


def _range(values: Sequence[float]) -> str:
    return f"{min(values):.2f} to {max(values):.2f}"


def main() -> None:
    """Print a line for each kind of fans and supply."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=1800.0)
    arguments = parser.parse_args()
    for held, words in HELD.items():
        for wander in WANDERS:
            made: list[str] = []
            errors: list[tuple[float, float, float, float]] = []
            for seed in range(arguments.seeds):
                training, other = (simulated(100 * seed + k, held, wander, arguments.seconds) for k in (1, 2))
                twin = train_twin([training], [], "physical", name="knows")
                blind = train_twin([replace(training, auxiliary={})], [], "physical", name="blind")
                made.append(found(twin))
                both = reference_of([training])
                assert both is not None
                errors.append(
                    (
                        error_rad_s(twin, other),
                        error_rad_s(blind, replace(other, auxiliary={})),
                        of_physics(training, both),
                        of_physics(training, replace(both, supply_voltage_v=None)),
                    )
                )
            own, without, with_both, with_air = map(_range, zip(*errors, strict=True))
            print(
                f"supply wanders by {100 * wander:.0f} %, fans {words}: {'; '.join(sorted(set(made)))}: {own} rad/s, "
                f"without columns {without}; physics with both {with_both}, with temperature {with_air}",
                flush=True,
            )


if __name__ == "__main__":
    main()

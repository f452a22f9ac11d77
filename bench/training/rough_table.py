"""A simulated fan with low-speed friction, dead zone and electrical lag: how near each model comes to the noise floor.

The plant is that of `fantwin simulate` (simulation.plant), whose friction holds the rotor still below breakaway.
Training: random stairs over the whole duty range. Held out: other stairs, and a person's hand at the knob. The floor
is the tacho's own error in the run held out; `distance` is the rmse less that.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import typer

from bench.printing import JsonOption, progress, show
from bench.training.four_models import held_out_figures, trained, trained_in_s
from bench.training.published_fan import RATE_HZ, SimulatedRun, random_stairs
from fantwin.simulation.excitation import Manual
from fantwin.simulation.plant import FanParameters, advance, at_rest
from fantwin.simulation.tacho import NoisyTacho
from fantwin.twin.comparison import Contender
from fantwin.twin.kinds import KINDS
from fantwin.twin.runs import Array, Run

DUTY_RANGE = (0.0, 1.0)
MUST_REACH, MUST_R2, MUST_BE_NEARER = 1.03, 0.999, 5.0


def main(
    seconds: Annotated[float, typer.Option(min=20, help="Length of training.")] = 160.0,
    runs: Annotated[int, typer.Option(min=1, help="How many independent repetitions.")] = 3,
    json_output: JsonOption = False,
) -> None:
    """Print each model's held-out error over the noise floor, its R2, and how much nearer than the physics it is."""
    tables: dict[str, list[dict[str, Any]]] = {}
    for seed in range(runs):
        training = simulated_plant(random_stairs(seed, seconds, 1, *DUTY_RANGE), seed)
        tests = {
            "other stairs": simulated_plant(random_stairs(1000 + seed, 80.0, 1, *DUTY_RANGE), 1000 + seed),
            "a hand at the knob": simulated_plant(_by_hand(2000 + seed, 80.0), 2000 + seed),
        }
        learned = []
        for kind in KINDS:
            progress(f"repetition {seed + 1} of {runs}: {kind.title}")
            learned.append(trained(kind, [training.run], seed))
        for how, test in tests.items():
            tables[f"held out: {how}, seed {seed}"] = _rows(learned, test)
    notes = [
        f"asked of the hybrid: {MUST_REACH} x the floor or less, R2 {MUST_R2} or more, {MUST_BE_NEARER:g} times nearer "
        "to the floor than the physical model"
    ]
    show(tables, notes, as_json=json_output)


def simulated_plant(command: Array, seed: int, parameters: FanParameters | None = None) -> SimulatedRun:
    """Fans of the plant under duty (n, fans) at 100 Hz, from standstill, read by their tachos.

    parameters: fields of numbers, or (fans,) each. seed: of the noise.
    """
    parameters = parameters or FanParameters()
    tacho, rng = NoisyTacho(), np.random.default_rng([seed, 2])
    state, true, read = at_rest(command.shape[1]), [], []
    for duty in command:
        true.append(state.speed_rad_s)
        read.append(tacho.read(state.speed_rad_s, rng))
        state = advance(state, duty, 1.0 / RATE_HZ, parameters)
    run = Run(f"plant {seed}", np.arange(len(command)) / RATE_HZ, command, np.array(read))
    return SimulatedRun(run, np.array(true))


def _by_hand(seed: int, duration_s: float) -> Array:
    profile = Manual(1, seed, *DUTY_RANGE)
    return np.stack([profile.command(k / RATE_HZ) for k in range(round(duration_s * RATE_HZ))])


def _rows(learned: list[Contender], test: SimulatedRun) -> list[dict[str, Any]]:
    floor_rad_s = test.noise_rms_rad_s
    figures = [held_out_figures(one, [test.run]) for one in learned]
    physical_distance = figures[0].rmse_rad_s - floor_rad_s
    return [
        {
            "model": one.kind.title,
            "rmse": found.rmse_rad_s,
            "floor": floor_rad_s,
            "to floor": found.rmse_rad_s / floor_rad_s,
            "R2": round(found.r2, 5),
            "max error": found.max_error_rad_s,
            "distance": found.rmse_rad_s - floor_rad_s,
            "nearer than physics": physical_distance / (found.rmse_rad_s - floor_rad_s),
            "trained in s": round(trained_in_s(one), 1),
        }
        for one, found in zip(learned, figures, strict=True)
    ]


if __name__ == "__main__":
    typer.run(main)

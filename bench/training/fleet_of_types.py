"""Fans of three types: how well a twin learned from some fans of a type predicts others that it was not trained on.

The plant is that of `fantwin simulate` (simulation.plant) with three sets of nominal parameters; the fans of a type
differ by a normal variation of each parameter, friction and electrical lag included. A twin of each type is trained on
a few fans; others are placed by some minutes of their own (twin.twin_of_type). Their errors are those of another run,
under other random stairs, as multiples of the floor, which is the tacho's own error in that run.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import typer

from bench.printing import JsonOption, progress, show
from bench.training.published_fan import SimulatedRun, random_stairs
from bench.training.rough_table import DUTY_RANGE, simulated_plant
from fantwin.simulation.plant import FanParameters, tray_of_fans
from fantwin.twin.build import evaluate, train_twin
from fantwin.twin.evaluation.accuracy import Evaluation, sums_of_model
from fantwin.twin.finishing import TrainedTwin
from fantwin.twin.fitting.fans_of_a_type import TypeOfFans
from fantwin.twin.models.physical import physical_parameters
from fantwin.twin.runs import Run
from fantwin.twin.twin_of_type import place_twin

TYPES = {
    "bench fan": FanParameters(),
    "small, quick": FanParameters(
        J=0.005, alpha=0.006, C_D=2.5e-6, coulomb_v=0.12, breakaway_v=0.4, stribeck_rad_s=15.0
    ),
    "large, slow": FanParameters(J=0.04, alpha=0.012, C_D=3e-5, supply_v=24.0, coulomb_v=0.3, breakaway_v=0.9),
}
HELD_OUT_S = 40.0


def main(
    trained: Annotated[int, typer.Option(min=2, help="Fans of each type that its twin is trained on.")] = 20,
    placed: Annotated[int, typer.Option(min=1, help="Fans of each type that are placed.")] = 40,
    train_s: Annotated[float, typer.Option(min=20, help="Length of the training run.")] = 120.0,
    own_s: Annotated[float, typer.Option(min=20, help="Length of the run that fans are placed by.")] = 180.0,
    variation: Annotated[
        float, typer.Option(min=0.0, max=0.29, help="Of parameters from fan to fan, relative.")
    ] = 0.05,
    themselves: Annotated[bool, typer.Option(help="Also train a twin of the placed fans, on the same run.")] = True,
    json_output: JsonOption = False,
) -> None:
    """Print the error of fans that were never trained on, over the floor, and what training and placing cost."""
    errors: list[dict[str, Any]] = []
    costs: list[dict[str, Any]] = []
    for number, (title, base) in enumerate(TYPES.items()):
        progress(f"{title}: simulating {trained} and {placed} fans")
        first = tray_of_fans(trained, 10 * number, variation, base)
        others = tray_of_fans(placed, 10 * number + 1, variation, base)
        learned_from = _run(first, 10 * number, train_s).run
        own, then = _run(others, 10 * number + 1, own_s).run, _run(others, 10 * number + 2, HELD_OUT_S)
        progress(f"{title}: training")
        type_twin, training_s = _timed(lambda runs=[learned_from]: train_twin(runs, [], "hybrid", name="type"))
        progress(f"{title}: placing")
        twin, placing_s = _placed(type_twin, own)
        progress(f"{title}: evaluating")
        alone, alone_s = (
            _timed(lambda runs=[own]: train_twin(runs, [], "hybrid", name="themselves"))
            if themselves
            else (None, np.nan)
        )
        floors = _Floors.of(then)
        own_error = evaluate(twin, [then.run])
        errors.append(
            {
                "type": title,
                "trained": trained,
                "placed": placed,
                "floor": floors.pooled_rad_s,
                "typical physics": _typical(type_twin, then.run).pooled.rmse_rad_s / floors.pooled_rad_s,
                "placed, error": own_error.pooled.rmse_rad_s,
                "to floor": own_error.pooled.rmse_rad_s / floors.pooled_rad_s,
                "worst fan": floors.worst(own_error),
                "coverage": round(own_error.pooled.coverage_2_sigma, 3),
                "trained themselves": evaluate(alone, [then.run]).pooled.rmse_rad_s / floors.pooled_rad_s
                if alone
                else np.nan,
            }
        )
        costs.append(
            {
                "type": title,
                "train, s": round(training_s, 1),
                "place, s": round(placing_s, 1),
                "place, s a fan": round(placing_s / placed, 2),
                "train themselves, s": round(alone_s, 1),
            }
        )
    notes = [
        "floor and error in rad/s, the others as multiples of the floor; coverage: of the band of two sigma",
        "typical physics: the network of the type beside the mean physics of its fans, without data of their own",
    ]
    show({"fans never trained on, held-out run": errors, "processor time": costs}, notes, as_json=json_output)


@dataclass(frozen=True)
class _Floors:
    """Error of a perfect model, rad/s: of all fans together, and of each."""

    pooled_rad_s: float
    per_fan_rad_s: tuple[float, ...]

    @classmethod
    def of(cls, run: SimulatedRun) -> _Floors:
        noise = run.run.speed_rad_s - run.true_speed_rad_s
        return cls(run.noise_rms_rad_s, tuple(np.sqrt(np.mean(noise**2, axis=0)).tolist()))

    def worst(self, error: Evaluation) -> float:
        """The largest ratio of a fan's error to its floor."""
        return max(figures.rmse_rad_s / floor for figures, floor in zip(error.per_fan, self.per_fan_rad_s, strict=True))


def _run(parameters: FanParameters, seed: int, duration_s: float) -> SimulatedRun:
    command = random_stairs(seed, duration_s, len(np.asarray(parameters.J)), *DUTY_RANGE)
    return simulated_plant(command, seed, parameters)


def _timed(work: Callable[[], TrainedTwin]) -> tuple[TrainedTwin, float]:
    """The twin, and the processor time in s."""
    started_s = time.process_time()
    twin = work()
    return twin, time.process_time() - started_s


def _placed(type_twin: TrainedTwin, own: Run) -> tuple[TrainedTwin, float]:
    with TemporaryDirectory() as folder:
        path = type_twin.save(Path(folder) / "type.onnx")
        return _timed(lambda: place_twin(path, [own], [], name="placed"))


def _typical(type_twin: TrainedTwin, run: Run) -> Evaluation:
    """Fans with the mean physics of their type."""
    of_type = TypeOfFans.of_card(type_twin.card)
    unknowns, top_rad_s = np.tile(of_type.mean, (run.fans, 1)), np.full(run.fans, of_type.top_speed_rad_s)
    sigma = np.full(run.fans, np.median(type_twin.card.sigma_rad_s))
    return sums_of_model(type_twin.model, physical_parameters(unknowns, top_rad_s), sigma, [run]).evaluation()


if __name__ == "__main__":
    typer.run(main)

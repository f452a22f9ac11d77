"""Who trains a hybrid to the noise floor first? 80 s at 100 Hz of the rough simulated fan, one run, one thread each.

Ours is `train_twin`, from the data to the finished twin: identification, training, validation, card. The others are
given the identified physics for nothing, are not charged for compiling, and are stopped as soon as they reach the
target:

- the published recipe (twin.fitting.torch_reference): Adam, mean absolute error, RK4;
- Adam through diffrax, compiled, float32, steps by optax;
- Adam through torchdiffeq, float64.

The last two minimise the mean square over stretches with learned initial speeds, at the rates and lengths that did
best of those tried. Each has its natural start: random hidden units without output yet, and for ours the placement of
twin.fitting.initial_weights. diffrax also runs from our placement, to separate the effect of the start from the rest.
All are evaluated alike: one free run over the whole 80 s from the measured start, in multiples of the noise as it fell.
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import time
from typing import Annotated, Any

import torch
import typer

from bench.printing import JsonOption, progress, show
from bench.training import race_diffrax, race_published, race_torchdiffeq
from bench.training.published_fan import SimulatedRun, rough_run
from bench.training.race_problem import Phase, TimedEvaluation, problem
from fantwin.twin.build import train_twin
from fantwin.twin.finishing import TrainedTwin
from fantwin.twin.fitting.identification import Identification, identify

TARGET = 1.01
SECONDS = 80.0
MUST_BE_SOONER = 20.0
DIFFRAX_PHASES = (Phase(50, 1e-2, until_share=0.3), Phase(200, 3e-3))
DIFFRAX_PLACED_PHASES = (Phase(200, 1e-2),)
TORCHDIFFEQ_PHASES = (Phase(50, 3e-2, until_share=0.5), Phase(50, 1e-2))
OUR_ITERATIONS = (5, 10, 15, 20, 30, 45)


def main(
    limit: Annotated[float, typer.Option(min=1, help="Seconds given to each of the others.")] = 300.0,
    seed: Annotated[int, typer.Option(help="Seed of the data and the starts.")] = 1,
    json_output: JsonOption = False,
) -> None:
    """Print who reaches 1.01 x the noise floor on the training data, after how long, and the ratio to ours."""
    torch.set_num_threads(1)
    simulated = rough_run(seed, SECONDS)
    rows = [_ours_to_the_target(simulated, seed), _ours(simulated, seed)]
    identification = identify([simulated.run])
    rows.append(_published(simulated, identification, seed, limit))
    rows.append(_diffrax(simulated, identification, seed, limit, placed=False))
    rows.append(_diffrax(simulated, identification, seed, limit, placed=True))
    rows.append(_torchdiffeq(simulated, identification, seed, limit))
    ours_s = rows[0]["reached in s"]
    for row in rows:
        spent_s = row["reached in s"] or limit
        row["times ours"] = "-" if not ours_s else f"{'' if row['reached in s'] else '> '}{spent_s / ours_s:.3g}"
    notes = [
        f"asked of ours: {MUST_BE_SOONER:g} times sooner than any other from its natural start",
        f"'>': not reached in {limit:g} s",
        "the first row of ours goes no further than to the target, as the others; the next is a whole training",
    ]
    show({f"to {TARGET} x the floor, 80 s at 100 Hz": rows}, notes, as_json=json_output)


def _row(
    who: str, start: str, best: float, best_after_s: float, reached_s: float | None, iterations: int, compiled_s: float
) -> dict[str, Any]:
    return {
        "who": who,
        "start": start,
        "best / floor": f"{best:.4f}",
        "after s": round(best_after_s, 1),
        "reached in s": None if reached_s is None else round(reached_s, 2),
        "iterations": iterations,
        "compiled in s": round(compiled_s, 1),
    }


def _ours_to_the_target(simulated: SimulatedRun, seed: int) -> dict[str, Any]:
    """Ours with the fewest iterations allowed that reach the target; the others are stopped there too."""
    rows = (_ours(simulated, seed, iterations) for iterations in OUR_ITERATIONS)
    row = next((row for row in rows if row["reached in s"]), None) or _ours(simulated, seed)
    return {**row, "who": "ours, to the target"}


def _ours(simulated: SimulatedRun, seed: int, iterations: int | None = None) -> dict[str, Any]:
    name = "ours, whole training"
    progress(name if iterations is None else f"{name}, --iterations {iterations}")
    start_s = time.perf_counter()
    twin = train_twin([simulated.run], [], "hybrid", name="race", seed=seed, max_iterations=iterations)
    took_s, best = time.perf_counter() - start_s, _error(twin, simulated)
    reached_s = took_s if best <= TARGET else None
    return _row(name, "placed", best, took_s, reached_s, twin.card.training.iterations, 0.0)


def _published(simulated: SimulatedRun, identification: Identification, seed: int, limit_s: float) -> dict[str, Any]:
    progress("published recipe in torch, random start")
    timed = _timed(simulated, identification, seed, limit_s, placed=False)
    race_published.train(timed.problem, timed)
    return _result_row("published recipe in torch", "random", timed, 0.0)


def _diffrax(
    simulated: SimulatedRun, identification: Identification, seed: int, limit_s: float, *, placed: bool
) -> dict[str, Any]:
    start = "placed" if placed else "random"
    progress(f"diffrax, {start} start")
    timed = _timed(simulated, identification, seed, limit_s, placed=placed)
    phases = DIFFRAX_PLACED_PHASES if placed else DIFFRAX_PHASES
    compiled_s = race_diffrax.train(timed.problem, timed, phases, single=True)
    return _result_row("Adam through diffrax", start, timed, compiled_s)


def _torchdiffeq(simulated: SimulatedRun, identification: Identification, seed: int, limit_s: float) -> dict[str, Any]:
    progress("torchdiffeq, random start")
    timed = _timed(simulated, identification, seed, limit_s, placed=False)
    race_torchdiffeq.train(timed.problem, timed, TORCHDIFFEQ_PHASES)
    return _result_row("Adam through torchdiffeq", "random", timed, 0.0)


def _timed(
    simulated: SimulatedRun, identification: Identification, seed: int, limit_s: float, *, placed: bool
) -> TimedEvaluation:
    task = problem(simulated.run, identification, placed=placed, seed=seed)
    return TimedEvaluation(task, simulated.noise_rms_rad_s, TARGET, limit_s)


def _result_row(who: str, start: str, timed: TimedEvaluation, compiled_s: float) -> dict[str, Any]:
    return _row(who, start, timed.best, timed.best_after_s, timed.reached_after_s, timed.iterations, compiled_s)


def _error(twin: TrainedTwin, simulated: SimulatedRun) -> float:
    return twin.validation.pooled.rmse_rad_s / simulated.noise_rms_rad_s


if __name__ == "__main__":
    typer.run(main)

"""The exported file against torch (equal?) and against other ways to run the same hybrid (how much faster?).

One hybrid of the rough simulated fan. Each engine runs blocks of samples, state in and state out, for 1 to 10,000
fans; the speed is samples times fans per second, the best of several blocks, on one thread. All take one Runge-Kutta
step of order four a sample, except diffrax (order three, which it has built in, and cheaper) and scipy (its adaptive
RK45, at a tolerance of 1e-6).
"""

from __future__ import annotations

import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["XLA_FLAGS"] = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import jax  # pyright: ignore[reportMissingImports]
import jax.numpy as jnp  # pyright: ignore[reportMissingImports]
import numpy as np
import torch
import typer
from scipy.integrate import solve_ivp

from bench.printing import JsonOption, progress, show
from bench.training import race_diffrax, race_torchdiffeq
from bench.training.published_fan import RATE_HZ, ROUGH_RANGE, random_stairs, rough_run
from fantwin.twin.build import train_twin
from fantwin.twin.export.onnx_twin import OnnxTwin
from fantwin.twin.finishing import TrainedTwin
from fantwin.twin.fitting.torch_reference import torch_free_run
from fantwin.twin.models.hybrid import Hybrid
from fantwin.twin.models.physics import LAG
from fantwin.twin.models.right_hand_side import FanEquation
from fantwin.twin.runs import Array

STEP_S = 1.0 / RATE_HZ
FANS = (1, 8, 1_000, 10_000)
EQUAL_WITHIN = 1e-5

Engine: TypeAlias = Callable[[Array, Array], Any]
"""Runs a twin from initial speeds (fans,) through commands (n, fans) and waits for the result."""


def main(
    block: Annotated[int, typer.Option(min=2, help="Samples a call.")] = 100,
    repeats: Annotated[int, typer.Option(min=1, help="Best of so many calls.")] = 5,
    json_output: JsonOption = False,
) -> None:
    """Print how near the ONNX file is to torch over 60 s, and steps per second of each engine as ratios."""
    torch.set_num_threads(1)
    progress("training the hybrid")
    twin = train_twin([rough_run(1, 40.0).run], [], "hybrid", name="bench")
    if np.any(twin.parameters[:, LAG]):
        raise SystemExit("the fan was given a lag that it does not have; the other engines know none")
    with tempfile.TemporaryDirectory() as folder:
        onnx = OnnxTwin(twin.save(Path(folder) / "bench.onnx"))
    progress("ONNX against torch, 60 s")
    equality = _equality(twin, onnx)
    rows = [_speeds(twin, onnx, fans, block, repeats) for fans in FANS]
    notes = [
        "each figure: how many times as many steps per second the ONNX file makes (below 1: fewer)",
        "numpy is the package's own free run, which solves a whole block at once instead of sample by sample",
        "compiling (jit) is not counted",
    ]
    tables = {
        f"ONNX against torch, free run of 60 s, asked {EQUAL_WITHIN:g}": [equality],
        f"steps per second, blocks of {block} samples": rows,
    }
    show(tables, notes, as_json=json_output)


def _equality(twin: TrainedTwin, onnx: OnnxTwin) -> dict[str, Any]:
    command = random_stairs(7, 60.0, 8, *ROUGH_RANGE)
    step_s = np.full(len(command), STEP_S)
    initial, parameters = np.linspace(0.0, 150.0, 8), np.repeat(twin.parameters, 8, axis=0)
    state = onnx.state_layout.initial_state(initial, command[0])
    ours, _ = onnx.advance(state, command, step_s, parameters)
    theirs = _in_torch(twin, command)(initial, command).numpy()
    difference = np.abs(ours - theirs)
    return {
        "fans": 8,
        "samples": len(command),
        "largest difference rad/s": f"{difference.max():.2g}",
        "relative to the speed": f"{np.max(difference / np.maximum(np.abs(theirs), 1.0)):.2g}",
        "relative to the range": f"{difference.max() / np.ptp(theirs):.2g}",
    }


def _speeds(twin: TrainedTwin, onnx: OnnxTwin, fans: int, block: int, repeats: int) -> dict[str, Any]:
    command = np.tile(random_stairs(7, block / RATE_HZ, min(fans, 8), *ROUGH_RANGE), -(-fans // 8))[:, :fans]
    command = np.ascontiguousarray(command)
    initial = np.linspace(20.0, 150.0, fans)
    engines: dict[str, Engine] = {
        "onnx": _in_a_block(onnx, twin, fans),
        "numpy": _in_a_block(twin.model, twin, fans),
        "torch": _in_torch(twin, command),
        "torchdiffeq": _in_torchdiffeq(twin),
        "diffrax": _in_diffrax(twin),
        "scipy": _in_scipy(twin),
    }
    per_s = {}
    for name, engine in engines.items():
        progress(f"{fans} fans: {name}")
        per_s[name] = fans * len(command) / _best_s(engine, initial, command, repeats)
    ratios = {f"onnx / {name}": per_s["onnx"] / value for name, value in per_s.items() if name != "onnx"}
    return {"fans": fans, "onnx steps/s": per_s["onnx"], **ratios}


def _best_s(engine: Engine, initial: Array, command: Array, repeats: int) -> float:
    """The shortest of several calls, after a first one that may compile."""
    took_s = []
    for _ in range(repeats + 1):
        start_s = time.perf_counter()
        engine(initial, command)
        took_s.append(time.perf_counter() - start_s)
        if took_s[-1] > 20.0:
            break
    return min(took_s[1:] or took_s)


def _in_a_block(model: Any, twin: TrainedTwin, fans: int) -> Engine:
    parameters = np.repeat(twin.parameters, fans, axis=0)

    def run(initial: Array, command: Array) -> Any:
        state = model.state_layout.initial_state(initial, command[0])
        return model.advance(state, command, np.full(len(command), STEP_S), parameters)

    return run


def _in_torch(twin: TrainedTwin, command: Array) -> Engine:
    parameters = torch.from_numpy(np.repeat(twin.parameters, command.shape[1], axis=0))
    theta = torch.from_numpy(_hybrid(twin).network.theta)
    step_s = torch.full((len(command),), STEP_S, dtype=torch.float64)

    def run(initial: Array, command: Array) -> torch.Tensor:
        with torch.no_grad():
            return torch_free_run(
                _hybrid(twin), theta, parameters, torch.from_numpy(initial), torch.from_numpy(command), step_s
            )

    return run


def _in_torchdiffeq(twin: TrainedTwin) -> Engine:
    parameters, theta = torch.from_numpy(twin.parameters), torch.from_numpy(_hybrid(twin).network.theta)

    def run(initial: Array, command: Array) -> torch.Tensor:
        with torch.no_grad():
            return race_torchdiffeq.speeds(
                _hybrid(twin), theta, parameters, torch.from_numpy(initial), torch.from_numpy(command), STEP_S
            )

    return run


def _in_diffrax(twin: TrainedTwin) -> Engine:
    theta = jnp.asarray(_hybrid(twin).network.theta)
    solve = jax.jit(
        lambda initial, command: race_diffrax.speeds(_hybrid(twin), theta, twin.parameters, initial, command, STEP_S)
    )
    return lambda initial, command: jax.block_until_ready(solve(initial, command))


def _in_scipy(twin: TrainedTwin) -> Engine:
    equation = FanEquation(twin.parameters, _hybrid(twin).network)

    def run(initial: Array, command: Array) -> Any:
        speed = initial
        for held in command:  # a held command is smooth between two samples only
            slope = lambda _, w, held=held: equation.acceleration(w, held)  # noqa: E731
            speed = solve_ivp(slope, (0.0, STEP_S), speed, rtol=1e-6, first_step=STEP_S).y[:, -1]
        return speed

    return run


def _hybrid(twin: TrainedTwin) -> Hybrid:
    assert isinstance(twin.model, Hybrid)
    return twin.model


if __name__ == "__main__":
    typer.run(main)

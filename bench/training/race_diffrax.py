"""Adam through diffrax: the free run and its gradient compiled as a whole, steps by optax."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import diffrax  # pyright: ignore[reportMissingImports]
import jax  # pyright: ignore[reportMissingImports]
import jax.numpy as jnp  # pyright: ignore[reportMissingImports]
import numpy as np
import optax  # pyright: ignore[reportMissingImports]

from bench.training.race_problem import Phase, Problem, TimedEvaluation
from fantwin.twin.models.hybrid import Hybrid
from fantwin.twin.runs import Array

jax.config.update("jax_enable_x64", True)


def speeds(
    model: Hybrid, theta: jax.Array, parameters: Array, initial: jax.Array, command: jax.Array, step_s: float
) -> jax.Array:
    """(n, batch) free run, speeds at each sample. parameters: (batch, 4) or (1, 4). command: (n, batch), held.

    Time is counted in samples, so that a stage's command is the one at the whole number below. The solver is of third
    order, its last stage being the first one of the next step.
    """
    inertia, viscous, drag = parameters.T[:3]
    scale, units, dtype = model.network.scaling, model.network.units, command.dtype
    rows, bias = theta[:-1].reshape(-1, units), theta[-1]

    def slope(t: Any, speed: Any, _: Any) -> jax.Array:
        held = command[jnp.floor(t).astype(int)]
        w = (speed - scale.speed_offset_rad_s) / scale.speed_scale_rad_s
        u = (held - scale.command_offset) / scale.command_scale
        hidden = jnp.tanh(w[:, None] * rows[0] + u[:, None] * rows[1] + rows[2])
        known = (held - (viscous + drag * jnp.abs(speed)) * speed) / inertia
        return (step_s * (known + scale.acceleration_scale_rad_s2 * (hidden @ rows[3] + bias))).astype(dtype)

    steps = len(command) - 1
    solved = diffrax.diffeqsolve(
        diffrax.ODETerm(slope),
        diffrax.Bosh3(),
        0.0,
        float(steps),
        1.0,
        initial,
        saveat=diffrax.SaveAt(t0=True, steps=True),
        stepsize_controller=diffrax.ConstantStepSize(),
        max_steps=steps,
        throw=False,
    )
    assert solved.ys is not None
    return solved.ys


def train(problem: Problem, timed: TimedEvaluation, phases: Sequence[Phase], *, single: bool) -> float:
    """Mean square error of stretches with learned initial speeds. single: float32. Returns the time to compile, s."""
    dtype = jnp.float32 if single else jnp.float64
    theta, compiled_in_s = jnp.asarray(problem.model.network.theta, dtype), 0.0
    for phase in phases:
        improve, unknowns, state = _prepared(problem, phase, theta, dtype)
        began_s = time.perf_counter()
        jax.block_until_ready(improve(unknowns, state))
        compiled_in_s += time.perf_counter() - began_s
        timed.start()
        while timed.spent_s < phase.until_share * timed.limit_s or phase is phases[-1]:
            unknowns, state = improve(unknowns, state)
            if timed.due() and timed.finished(np.asarray(unknowns["theta"])):
                return compiled_in_s
        timed.pause()
        theta = unknowns["theta"]
    return compiled_in_s


def _prepared(problem: Problem, phase: Phase, theta: jax.Array, dtype: Any) -> tuple[Any, Any, Any]:
    """A compilable step of Adam, the unknowns to start from, and Adam's state."""
    command, measured = (jnp.asarray(values, dtype) for values in problem.stretches(phase.stretch))
    scale = problem.model.network.scaling.speed_scale_rad_s
    parameters = problem.identification.parameters.astype(dtype)
    unknowns = {"theta": theta, "initial": jnp.mean(measured[:5], axis=0) / scale}
    optimiser = optax.adam(phase.learning_rate)

    def loss(unknowns: dict[str, jax.Array]) -> jax.Array:
        run = speeds(problem.model, unknowns["theta"], parameters, scale * unknowns["initial"], command, problem.step_s)
        return jnp.mean(((run - measured) / scale) ** 2)

    @jax.jit
    def improve(unknowns: Any, state: optax.OptState) -> tuple[Any, optax.OptState]:
        steps, state = optimiser.update(jax.grad(loss)(unknowns), state)
        return optax.apply_updates(unknowns, steps), state

    return improve, unknowns, optimiser.init(unknowns)

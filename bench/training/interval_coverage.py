"""Monte Carlo of the identification: how often its 95 % intervals hold the true J, alpha and C_D.

The published simulated fan under several kinds of command, some hundred runs of each that differ in noise alone and
in the command's seed. With n runs a true coverage of 95 % gives a count that scatters by sqrt(0.95 * 0.05 / n).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any

import numpy as np
import typer

from bench.printing import JsonOption, progress, show
from bench.training.published_fan import (
    DRAG,
    INERTIA,
    RATE_HZ,
    TEST_RANGE,
    TRAINING_RANGE,
    VISCOUS,
    published_fan,
    random_stairs,
    sum_of_sines,
)
from fantwin.simulation.excitation import Chirp, Staircase
from fantwin.twin.fitting.identification import identify
from fantwin.twin.runs import Array

TRUE = {"J": INERTIA, "alpha": VISCOUS, "C_D": DRAG}
MUST_COVER = (0.93, 0.97)


def main(
    runs: Annotated[int, typer.Option(min=10, help="Runs of each kind of command.")] = 400,
    json_output: JsonOption = False,
) -> None:
    """Print the coverage of the 95 % intervals, the bias and the scatter of each parameter."""
    rows = []
    for command_name, command in COMMANDS.items():
        progress(f"{runs} runs: {command_name}")
        rows += _rows(command_name, command, runs)
    scatter = np.sqrt(0.95 * 0.05 / runs)
    notes = [f"asked: {MUST_COVER[0]:.0%} to {MUST_COVER[1]:.0%}; the count itself scatters by {scatter:.1%}"]
    show({f"95 % intervals over {runs} runs of each kind": rows}, notes, as_json=json_output)


def _sampled(profile: Staircase | Chirp, duration_s: float) -> Array:
    return np.stack([profile.command(k / RATE_HZ) for k in range(round(duration_s * RATE_HZ))])


COMMANDS: dict[str, Callable[[int], Array]] = {
    "random stairs, 40 s": lambda seed: random_stairs(seed, 40.0, 1, *TRAINING_RANGE),
    "random stairs, 10 s": lambda seed: random_stairs(seed, 10.0, 1, *TRAINING_RANGE),
    "sum of sines, 40 s": lambda seed: sum_of_sines(seed, 40.0, 1, *TEST_RANGE),
    "staircase, 40 s": lambda seed: _sampled(Staircase(1, seed, *TRAINING_RANGE, hold_s=2.5), 40.0),
}


def _rows(command_name: str, command: Callable[[int], Array], runs: int) -> list[dict[str, Any]]:
    found, low, high = [], [], []
    for seed in range(runs):
        identified = identify([published_fan(command(seed), seed, command_name).run])
        found.append(identified.parameters[0, : len(TRUE)])
        interval = identified.interval_95[0, : len(TRUE)]
        low.append(interval[:, 0])
        high.append(interval[:, 1])
    values, below, above = np.array(found), np.array(low), np.array(high)
    rows = []
    for column, (name, true) in enumerate(TRUE.items()):
        covered = (below[:, column] <= true) & (true <= above[:, column])
        rows.append(
            {
                "command": command_name,
                "parameter": name,
                "coverage": f"{covered.mean():.1%}",
                "as asked": "yes" if MUST_COVER[0] <= covered.mean() <= MUST_COVER[1] else "no",
                "bias": f"{values[:, column].mean() / true - 1.0:+.2%}",
                "scatter": f"{values[:, column].std() / true:.2%}",
                "median half width": f"{np.median(above[:, column] - below[:, column]) / 2.0 / true:.2%}",
            }
        )
    return rows


if __name__ == "__main__":
    typer.run(main)

"""`fantwin report` without a twin: the physical parameters of the fans in recordings."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from fantwin.pipeline.cli.progress import interruptible, training_progress
from fantwin.pipeline.cli.recordings_in_parallel import RecordingsInParallel
from fantwin.pipeline.cli.twins.training_data import (
    Part,
    TrainingData,
    read_training_data,
    show_hints,
    twin_errors,
)

if TYPE_CHECKING:
    from fantwin.twin.fitting.identification import Identification
    from fantwin.twin.fitting.reference_choice import AtReference
    from fantwin.twin.runs import Array

UNITS = {
    "J": "command units per rad/s²",
    "alpha": "command units per rad/s",
    "C_D": "command units per (rad/s)²",
    "lag_s": "seconds",
}


def show_fans(recordings: Sequence[Path], part: Part, pool: RecordingsInParallel, *, json_output: bool) -> None:
    """Print J, alpha and C_D of J w' + alpha w + C_D w|w| = command for each fan, and the lag of its command.

    Each has a 95 % interval. w is in rad/s and the command in its own unit, and so are the parameters: only their
    ratios are mechanical quantities. Where supply voltage or temperature are recorded and the fans follow them, the
    parameters hold at reference values of these. A warning names what the recordings do not determine, and why.

    Raises:
        UserError: the recordings cannot be used.
        typer.Exit: Ctrl-C, or recordings were skipped.
    """
    with interruptible("nothing was identified"), twin_errors():
        from fantwin.twin.fitting.reference_choice import identify_at_reference  # noqa: PLC0415  loads twin only when it is needed

        with pool:
            training_data = read_training_data(recordings, part, pool)
        if not json_output:
            show_hints(training_data.hints)
        with training_progress(training_data) as start:
            found = identify_at_reference(training_data.runs, progress=start(""))
    result = as_json(found, training_data)
    if json_output:
        typer.echo(json.dumps(result | pool.as_json()))
    else:
        Console().print(_table(result))
        if result["allows_for"]:
            typer.echo(f"allows for {result['allows_for']}")
        for warning in result["warnings"]:
            typer.secho(f"warning: {warning}", fg=typer.colors.YELLOW, err=True)
    pool.end()


def as_json(at_reference: AtReference, training_data: TrainingData) -> dict[str, Any]:
    """The result as JSON fields; None where a figure is undefined.

    Rows and columns of covariance and correlation are in the order of `parameters`; those of a lag that was not found
    are zero, and undefined.
    """
    from fantwin.twin.models.physics import PARAMETER_NAMES  # noqa: PLC0415

    found, conditions = at_reference.identification, at_reference.conditions
    fans = [
        {
            "fan": training_data.fans[fan],
            **dict(zip(PARAMETER_NAMES, found.parameters[fan].tolist(), strict=True)),
            **{f"{name}_95": _interval(found, fan, k) for k, name in enumerate(PARAMETER_NAMES)},
            "covariance": found.covariance[fan].tolist(),
            "correlation": _correlation(found.covariance[fan]),
            "time_constant_s": float(found.time_constant_s[fan]),
            "lambda_per_s": float(found.lambda_per_s[fan]),
            "rmse": float(found.rmse_rad_s[fan]) / training_data.rad_s_per_unit,
        }
        for fan in range(len(found.parameters))
    ]
    return {
        "fans": fans,
        "parameters": list(PARAMETER_NAMES),
        "units": {name: UNITS[name] for name in PARAMETER_NAMES},
        "speed_unit": training_data.speed_unit,
        "iterations": found.iterations,
        "warnings": training_data.with_fan_numbers([*at_reference.notes, *found.warnings, *found.misfits]),
        "allows_for": conditions.in_words if conditions else "",
        "hints": list(training_data.hints),
    }


def _interval(found: Identification, fan: int, index: int) -> list[float] | None:
    """None for a parameter that was not estimated: a lag that was not found."""
    return found.interval_95[fan, index].tolist() if found.covariance[fan, index, index] > 0.0 else None


def _correlation(covariance: Array) -> list[list[float | None]]:
    errors = [math.sqrt(covariance[k, k]) for k in range(len(covariance))]

    def between(row: int, column: int) -> float | None:
        product = errors[row] * errors[column]
        return min(max(float(covariance[row, column]) / product, -1.0), 1.0) if product > 0.0 else None

    return [[between(row, column) for column in range(len(errors))] for row in range(len(errors))]


def _table(result: dict[str, Any]) -> Table:
    """A row for each fan, the half width of each interval below its value."""
    mechanical = [name for name in result["parameters"] if name != "lag_s"]
    units = "; ".join(f"{name} in {result['units'][name]}" for name in mechanical)
    table = Table(
        box=SIMPLE_HEAD,
        pad_edge=False,
        caption=f"{units}. ± is half a 95 % interval; the time constant is that at the median speed.",
        caption_justify="left",
    )
    table.add_column("fan", no_wrap=True)
    for header in (*mechanical, "lag\nms", "time\nconst. s", f"rmse\n{result['speed_unit']}", "lambda\n1/s"):
        table.add_column(header, justify="right", no_wrap=True)
    for fan in result["fans"]:
        values = [_with_interval(fan[name], fan[f"{name}_95"]) for name in mechanical]
        figures = (f"{fan['time_constant_s']:.3g}", f"{fan['rmse']:.4g}", f"{fan['lambda_per_s']:.3g}")
        table.add_row(str(fan["fan"]), *values, _lag(fan), *figures)
    return table


def _lag(fan: dict[str, Any]) -> str:
    if fan["lag_s_95"] is None:
        return "none seen"
    low, high = fan["lag_s_95"]
    return _with_interval(1e3 * fan["lag_s"], [1e3 * low, 1e3 * high])


def _with_interval(value: float, interval: list[float]) -> str:
    return f"{value:.4g}\n± {(interval[1] - interval[0]) / 2:.1g}"

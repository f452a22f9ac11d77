"""`fantwin evaluate`: how well a twin follows recordings."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from pipeline.commands.model_maker import (
    FansOption,
    FromOption,
    Material,
    RecordingsArgument,
    ToOption,
    TrayOption,
    figures_in,
    model_maker,
    read_material,
    sentence,
)
from pipeline.commands.options import JsonOption
from pipeline.errors import UserError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from twin.evaluation import Evaluation
    from twin.resampling import Grid
    from twin.residual_analysis import ResidualAnalysis

EXPECTED_COVERAGE = math.erf(math.sqrt(2.0))
"""share of a normal distribution within two standard deviations"""


def evaluate(
    twin: Annotated[Path, typer.Argument(metavar="TWIN.onnx", help="The twin, as `fantwin train` makes it.")],
    recordings: RecordingsArgument,
    from_s: FromOption = 0.0,
    to_s: ToOption = math.inf,
    tray: TrayOption = None,
    fans: FansOption = None,
    rate: Annotated[
        list[str] | None,
        typer.Option(metavar="HZ|irregular", help="Judge it on this grid, too, e.g. 50. Repeatable."),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Run a twin freely over recordings and compare it with what was measured, in the recording's own units.

    The free run gets one initial speed and then the commands alone. The one-step error is given beside it; it says
    little, because it is corrected at each sample. What is left is tested: a good twin leaves white noise that does
    not follow the command.

    Example: fantwin evaluate TWIN.onnx held-out.mcap --rate 20 --rate irregular --json
    """
    grids: list[Grid] = [_grid(text) for text in rate or []]
    with model_maker():
        # The command line loads twin only when it is needed.
        import numpy as np  # noqa: PLC0415

        from twin.build import evaluate as evaluate_twin  # noqa: PLC0415
        from twin.evaluation import evaluation_pieces, free_run_residuals  # noqa: PLC0415
        from twin.onnx_twin import OnnxTwin  # noqa: PLC0415
        from twin.resampling import on_grid  # noqa: PLC0415
        from twin.residual_analysis import analyse_residual  # noqa: PLC0415

        loaded = OnnxTwin(twin)
        material = read_material(recordings, tray, fans, from_s, to_s)
        evaluation = evaluate_twin(loaded, material.runs)
        pieces = evaluation_pieces(material.runs)
        parameters = np.broadcast_to(loaded.parameters, (pieces[0].fans, loaded.parameters.shape[1]))
        analyses = analyse_residual(free_run_residuals(loaded, parameters, pieces), pieces)
        on_grids: list[tuple[Grid, Evaluation]] = [
            (grid, evaluate_twin(loaded, on_grid(material.runs, grid))) for grid in grids
        ]
    told = account(evaluation, analyses, on_grids, material)
    if json_output:
        typer.echo(json.dumps(told))
        return
    typer.echo(sentence(told, material.speed_unit))
    console = Console()
    console.print(_fan_table(told))
    if grids:
        console.print(_grid_table(told))
    for warning in told["warnings"]:
        typer.echo(warning, err=True)


def account(
    evaluation: Evaluation,
    analyses: tuple[ResidualAnalysis, ...],
    on_grids: Sequence[tuple[Grid, Evaluation]],
    material: Material,
) -> dict[str, Any]:
    """What a machine is told of an evaluation; speeds in the recordings' own unit, None where a figure is undefined."""
    scale = material.rad_s_per_unit

    def figures_of(judged: Evaluation) -> dict[str, Any]:
        by_fan = zip(material.fans, judged.per_fan, strict=True)
        return figures_in(judged.pooled, scale) | {
            "fans": [{"fan": number} | figures_in(fan, scale) for number, fan in by_fan]
        }

    told = figures_of(evaluation)
    for fan, analysis in zip(told["fans"], analyses, strict=True):
        fan["residual"] = residual_account(analysis, scale)
    return told | {
        "speed_unit": material.speed_unit,
        "expected_coverage_2_sigma": EXPECTED_COVERAGE,
        "warnings": material.named([]),
        "grids": [{"rate": grid} | figures_of(judged) for grid, judged in on_grids],
    }


def residual_account(analysis: ResidualAnalysis, rad_s_per_unit: float) -> dict[str, Any]:
    """One fan's residual analysis for machines; the mean in a unit of theirs."""
    return {
        "samples": analysis.samples,
        "step_s": analysis.step_s,
        "mean": _finite(analysis.mean_rad_s / rad_s_per_unit),
        "independent_samples": _finite(analysis.independent_samples),
        "autocorrelation_time_s": _finite(analysis.autocorrelation_time_s),
        "white": analysis.white,
        "ljung_box_p": _finite(analysis.ljung_box_p),
        "ljung_box_lags": analysis.ljung_box_lags,
        "lags_s": analysis.lags_s.tolist(),
        "autocorrelation": _finite_list(analysis.autocorrelation),
        "bound_95": _finite(analysis.bound_95),
        "cross_over_bound": _finite(analysis.cross_over_bound),
        "cross_peak_lag_s": _finite(analysis.cross_peak_lag_s),
        "cross_lags_s": analysis.cross_lags_s.tolist(),
        "cross_correlation": _finite_list(analysis.cross_correlation),
        "cross_bound_95": _finite(analysis.cross_bound_95),
    }


def _grid(text: str) -> Grid:
    if text == "irregular":
        return "irregular"
    try:
        rate_hz = float(text)
    except ValueError:
        rate_hz = math.nan
    if not (math.isfinite(rate_hz) and rate_hz > 0.0):
        raise UserError(f"--rate {text}: give a rate in Hz, e.g. --rate 50, or --rate irregular")
    return rate_hz


def _fan_table(told: dict[str, Any]) -> Table:
    unit = told["speed_unit"]
    table = Table("fan")
    expected = f"in ±2σ\n({EXPECTED_COVERAGE:.1%})"
    for header in (
        f"rmse\n{unit}",
        f"max error\n{unit}",
        "R2",
        f"one step\n{unit}",
        expected,
        "white p",
        "cross\n/ bound",
    ):
        table.add_column(header, justify="right")
    for figures in told["fans"]:
        residual = figures["residual"]
        tests = (_probability(residual["ljung_box_p"]), _shown(residual["cross_over_bound"], ".1f"))
        table.add_row(str(figures["fan"]), *_cells(figures), *tests)
    if len(told["fans"]) > 1:
        table.add_row("all", *_cells(told), "", "")
    return table


def _grid_table(told: dict[str, Any]) -> Table:
    """Figures of all fans together on the recordings' own grid and on the others."""
    unit = told["speed_unit"]
    table = Table("grid")
    for header in ("samples", f"rmse\n{unit}", f"max error\n{unit}", "R2", f"one step\n{unit}", "in ±2σ"):
        table.add_column(header, justify="right")
    for grid in ({"rate": None} | told, *told["grids"]):
        rate = grid["rate"]
        name = "own" if rate is None else rate if rate == "irregular" else f"{rate:g} Hz"
        table.add_row(name, str(grid["samples"]), *_cells(grid))
    return table


def _cells(figures: dict[str, Any]) -> tuple[str, ...]:
    formats = {"rmse": ".4g", "max_error": ".4g", "r2": ".4f", "one_step_rmse": ".4g", "coverage_2_sigma": ".1%"}
    return tuple(_shown(figures[name], digits) for name, digits in formats.items())


def _shown(value: float | None, digits: str) -> str:
    return "-" if value is None else format(value, digits)


def _probability(value: float | None) -> str:
    return "<0.001" if value is not None and value < 0.001 else _shown(value, ".3f")


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _finite_list(values: NDArray[np.float64]) -> list[float | None]:
    return [_finite(value) for value in values.tolist()]

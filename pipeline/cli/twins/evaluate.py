"""`fantwin evaluate`: how well a twin follows recordings."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from pipeline.cli.options import JsonOption, fan_numbers
from pipeline.cli.twins.figures import figures_in, sentence, shown
from pipeline.cli.twins.training_data import (
    FansOption,
    FromOption,
    RecordingsArgument,
    ToOption,
    TrainingData,
    TrayOption,
    data_cards,
    read_training_data,
    twin_errors,
)
from pipeline.errors import UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from twin.evaluation.accuracy import Evaluation
    from twin.evaluation.resampling import Grid
    from twin.evaluation.residual_analysis import ResidualAnalysis
    from twin.report.assessment import Assessment
    from twin.report.content import Content

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
        typer.Option(metavar="HZ|irregular", help="Evaluate on this sample grid, too, e.g. 50. Repeatable."),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Compare the free run of a twin with the measured speeds of recordings, in the recordings' own units.

    The free run gets one initial speed and then only the commands. The one-step error is shown for comparison: it is
    corrected at every sample, so it is small even for a poor twin. The residual is tested: that of a good twin is
    white noise that does not depend on the command.

    Example: fantwin evaluate TWIN.onnx held-out.mcap --rate 20 --rate irregular --json
    """
    grids: list[Grid] = [_grid(text) for text in rate or []]
    with twin_errors():
        # The command line loads twin only when it is needed.
        from twin.build import evaluate as evaluate_twin  # noqa: PLC0415
        from twin.evaluation.resampling import on_grid  # noqa: PLC0415
        from twin.export.onnx_twin import OnnxTwin  # noqa: PLC0415
        from twin.report.assessment import assess  # noqa: PLC0415
        from twin.report.content import SpeedUnit, report_content  # noqa: PLC0415

        loaded = OnnxTwin(twin)
        training_data = read_training_data(recordings, tray, fans, from_s, to_s)
        unit = SpeedUnit(training_data.speed_unit, training_data.rad_s_per_unit)
        content = report_content(loaded, training_data.runs, data_cards(training_data), unit, fan_numbers(fans))
        assessment = assess(content)
        on_grids: list[tuple[Grid, Evaluation]] = [
            (grid, evaluate_twin(loaded, on_grid(training_data.runs, grid), fan_numbers(fans))) for grid in grids
        ]
    result = as_json(content, assessment, on_grids, training_data)
    if json_output:
        typer.echo(json.dumps(result))
        return
    typer.echo(f"{result['headline']}\n{sentence(result, training_data.speed_unit)}")
    console = Console()
    console.print(_fan_table(result))
    if grids:
        console.print(_grid_table(result))
    for warning in result["warnings"]:
        typer.echo(warning, err=True)


def as_json(
    content: Content,
    assessment: Assessment,
    on_grids: Sequence[tuple[Grid, Evaluation]],
    training_data: TrainingData,
) -> dict[str, Any]:
    """The result as JSON fields; speeds in the recordings' own unit, None where a figure is undefined."""
    scale = training_data.rad_s_per_unit

    def figures_of(evaluation: Evaluation) -> dict[str, Any]:
        by_fan = zip(training_data.fans, evaluation.per_fan, strict=True)
        return figures_in(evaluation.pooled, scale) | {
            "fans": [{"fan": number} | figures_in(fan, scale) for number, fan in by_fan]
        }

    result = figures_of(content.evaluation)
    for its, fan in zip(result["fans"], content.fans, strict=True):
        its["residual"] = residual_json(fan.residual, scale)
    return result | {
        "speed_unit": training_data.speed_unit,
        "expected_coverage_2_sigma": EXPECTED_COVERAGE,
        "assessment": assessment.level,
        "headline": assessment.headline,
        "warnings": [*training_data.outliers, *assessment.warnings],
        "grids": [{"rate": grid} | figures_of(evaluation) for grid, evaluation in on_grids],
    }


def residual_json(analysis: ResidualAnalysis, rad_s_per_unit: float) -> dict[str, Any]:
    """One fan's residual analysis as JSON fields, the mean in the unit of the recordings."""
    return {
        "samples": analysis.samples,
        "period_s": analysis.period_s,
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
        raise UsageError(f"--rate {text}: give a rate in Hz, e.g. --rate 50, or --rate irregular")
    return rate_hz


def _fan_table(result: dict[str, Any]) -> Table:
    unit = result["speed_unit"]
    table = _empty_table("fan")
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
        table.add_column(header, justify="right", no_wrap=True)
    for figures in result["fans"]:
        residual = figures["residual"]
        tests = (_probability(residual["ljung_box_p"]), shown(residual["cross_over_bound"], ".1f", "-"))
        table.add_row(str(figures["fan"]), *_cells(figures), *tests)
    if len(result["fans"]) > 1:
        table.add_row("all", *_cells(result), "", "")
    return table


def _grid_table(result: dict[str, Any]) -> Table:
    """Figures of all fans together on the recorded grid and on the others."""
    unit = result["speed_unit"]
    table = _empty_table("grid")
    for header in ("samples", f"rmse\n{unit}", f"max error\n{unit}", "R2", f"one step\n{unit}", "in ±2σ"):
        table.add_column(header, justify="right", no_wrap=True)
    for grid in ({"rate": None} | result, *result["grids"]):
        rate = grid["rate"]
        name = "recorded" if rate is None else rate if rate == "irregular" else f"{rate:g} Hz"
        table.add_row(name, str(grid["samples"]), *_cells(grid))
    return table


def _cells(figures: dict[str, Any]) -> tuple[str, ...]:
    formats = {"rmse": ".4g", "max_error": ".4g", "r2": ".4f", "one_step_rmse": ".4g", "coverage_2_sigma": ".1%"}
    return tuple(shown(figures[name], form, "-") for name, form in formats.items())


def _empty_table(first: str) -> Table:
    """Narrow, so that numbers are whole on a terminal of 80 columns."""
    table = Table(box=SIMPLE_HEAD, padding=0)
    table.add_column(first, no_wrap=True)
    return table


def _probability(value: float | None) -> str:
    return "<0.001" if value is not None and value < 0.001 else shown(value, ".3f", "-")


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _finite_list(values: NDArray[np.float64]) -> list[float | None]:
    return [_finite(value) for value in values.tolist()]

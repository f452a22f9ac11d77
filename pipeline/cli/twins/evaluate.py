"""`fantwin evaluate`: how well a twin follows recordings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial, reduce
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from fantwin.pipeline.cli.in_parallel import JobsOption, RecordingsInParallel, SkipBadOption
from fantwin.pipeline.cli.options import JsonOption, fan_numbers, recorded_names
from fantwin.pipeline.cli.printing import table_of
from fantwin.pipeline.cli.progress import interruptible
from fantwin.pipeline.cli.twins.data_options import (
    FansOption,
    FromOption,
    RecordingsArgument,
    ToOption,
    TrayOption,
    report_damage,
)
from fantwin.pipeline.cli.twins.figures import figures_in, sentence, shown
from fantwin.pipeline.errors import UsageError
from fantwin.pipeline.learning.training_data import (
    Part,
    TrainingData,
    data_cards,
    joined,
    read_recording_data,
    twin_errors,
)
from fantwin.schemas.fan_names import fan_cell

if TYPE_CHECKING:
    from fantwin.twin.evaluation.accuracy import Evaluation
    from fantwin.twin.evaluation.resampling import Grid
    from fantwin.twin.evaluation.residual_analysis import ResidualAnalysis
    from fantwin.twin.report.assessment import Assessment
    from fantwin.twin.report.content import Summary
    from fantwin.twin.report.recording_sums import Extent

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
    jobs: JobsOption = None,
    skip_bad: SkipBadOption = False,
    json_output: JsonOption = False,
) -> None:
    """Compare the free run of a twin with the measured speeds of recordings, in the recordings' own units.

    The free run gets one initial speed and then only the commands. The one-step error is shown for comparison: it is
    corrected at every sample, so it is small even for a poor twin. The residual is tested: that of a good twin is
    white noise that does not depend on the command.

    Example: fantwin evaluate TWIN.onnx held-out.mcap --rate 20 --rate irregular --json
    """
    grids: list[Grid] = [_grid(text) for text in rate or []]
    part = Part(tray, fan_numbers(fans, recorded_names(recordings, tray)), from_s, to_s)
    pool = RecordingsInParallel(jobs, skip_bad)
    with interruptible("nothing was evaluated"), twin_errors(), pool:
        # The command line loads twin only when it is needed.
        from fantwin.twin.export.onnx_twin import OnnxTwin  # noqa: PLC0415
        from fantwin.twin.report.assessment import assess  # noqa: PLC0415
        from fantwin.twin.report.content import SpeedUnit, summary_of  # noqa: PLC0415
        from fantwin.twin.report.recording_sums import common_extent  # noqa: PLC0415

        loaded = OnnxTwin(twin)
        known = list(pool.map(partial(_known_of, part=part), recordings, "reading"))
        about, extent = joined([data for data, _ in known]), common_extent([extent for _, extent in known])
        report_damage(about)
        work = partial(_sums_of, part=part, twin=twin, extent=extent, grids=grids)
        sums, *on_grids = reduce(_added, pool.map(work, recordings, "evaluating"))
        unit = SpeedUnit(about.speed_unit, about.rad_s_per_unit)
        summary = summary_of(loaded, sums, extent, data_cards(about), unit, part.fans, about.labels)
        assessment = assess(summary)
    result = as_json(
        summary, assessment, [(grid, of.evaluation()) for grid, of in zip(grids, on_grids, strict=True)], about
    )
    lines = (result["headline"], sentence(result, result["speed_unit"]), _fan_table(result))
    grid_tables = [_grid_table(result)] if grids else []
    pool.end_with(result, *lines, *grid_tables, warnings=result["warnings"], json_output=json_output)


def _known_of(path: Path, part: Part) -> tuple[TrainingData, Extent]:
    """What must be known of all recordings before one is evaluated; without the samples."""
    from fantwin.twin.report.recording_sums import extent_of  # noqa: PLC0415

    data = read_recording_data(path, part)
    with twin_errors():
        return replace(data, runs=[]), extent_of(data.runs)


def _sums_of(path: Path, part: Part, twin: Path, extent: Extent, grids: Sequence[Grid]) -> list[Any]:
    """The RecordingSums of one recording, and its FigureSums on each of the other grids."""
    from fantwin.twin.build import evaluation_sums, runs_of_twin  # noqa: PLC0415
    from fantwin.twin.evaluation.resampling import on_grid  # noqa: PLC0415
    from fantwin.twin.export.onnx_twin import OnnxTwin  # noqa: PLC0415
    from fantwin.twin.report.recording_sums import recording_sums  # noqa: PLC0415

    with twin_errors():
        loaded, runs = OnnxTwin(twin), read_recording_data(path, part).runs
        on_grids = [evaluation_sums(loaded, on_grid(runs, grid), part.fans) for grid in grids]
        return [recording_sums(runs_of_twin(loaded, runs, part.fans), extent), *on_grids]


def _added(sums: list[Any], others: list[Any]) -> list[Any]:
    return [one + other for one, other in zip(sums, others, strict=True)]


def as_json(
    summary: Summary, assessment: Assessment, on_grids: Sequence[tuple[Grid, Evaluation]], about: TrainingData
) -> dict[str, Any]:
    """The result as JSON fields; speeds in the recordings' own unit, None where a figure is undefined."""
    scale = about.rad_s_per_unit

    def figures_of(evaluation: Evaluation) -> dict[str, Any]:
        by_fan = zip(about.fans, evaluation.per_fan, strict=True)
        return figures_in(evaluation.pooled, scale) | {
            "fans": [
                {"fan": number, "name": about.names.name(number)} | figures_in(fan, scale) for number, fan in by_fan
            ]
        }

    result = figures_of(summary.evaluation)
    for its, fan in zip(result["fans"], summary.fans, strict=True):
        its["residual"] = residual_json(fan.residual, scale)
    return result | {
        "speed_unit": about.speed_unit,
        "expected_coverage_2_sigma": EXPECTED_COVERAGE,
        "assessment": assessment.level,
        "headline": assessment.headline,
        "warnings": [*about.outliers, *assessment.warnings],
        "grids": [{"rate": grid} | figures_of(evaluation) for grid, evaluation in on_grids],
    }


def residual_json(analysis: ResidualAnalysis, rad_s_per_unit: float) -> dict[str, Any]:
    """One fan's residual analysis as JSON fields, the mean in the unit of the recordings."""
    found = vars(analysis) | {"mean": analysis.mean_rad_s / rad_s_per_unit}
    found |= {name: getattr(analysis, name) for name in ("white", "cross_over_bound", "cross_peak_lag_s")}
    return {name: _plain(value) for name, value in found.items() if name != "mean_rad_s"}


def _plain(value: Any) -> Any:
    """Arrays as lists, and None for what is not finite."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


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
    figures = (f"rmse\n{unit}", f"max error\n{unit}", "R2", f"one step\n{unit}")
    tests = (f"in ±2σ\n({EXPECTED_COVERAGE:.1%})", "white p", "cross\n/ bound")
    table = table_of(["fan"], (*figures, *tests), padding=0)  # narrow: numbers are whole on a terminal of 80 columns
    for figures in result["fans"]:
        residual = figures["residual"]
        tests = (_probability(residual["ljung_box_p"]), shown(residual["cross_over_bound"], ".1f", "-"))
        table.add_row(escape(fan_cell(figures["fan"], figures["name"])), *_cells(figures), *tests)
    if len(result["fans"]) > 1:
        table.add_row("all", *_cells(result), "", "")
    return table


def _grid_table(result: dict[str, Any]) -> Table:
    """Figures of all fans together on the recorded grid and on the others."""
    unit = result["speed_unit"]
    figures = ("samples", f"rmse\n{unit}", f"max error\n{unit}", "R2", f"one step\n{unit}", "in ±2σ")
    table = table_of(["grid"], figures, padding=0)
    for grid in ({"rate": None} | result, *result["grids"]):
        rate = grid["rate"]
        name = "recorded" if rate is None else rate if rate == "irregular" else f"{rate:g} Hz"
        table.add_row(name, str(grid["samples"]), *_cells(grid))
    return table


def _cells(figures: dict[str, Any]) -> tuple[str, ...]:
    formats = {"rmse": ".4g", "max_error": ".4g", "r2": ".4f", "one_step_rmse": ".4g", "coverage_2_sigma": ".1%"}
    return tuple(shown(figures[name], form, "-") for name, form in formats.items())


def _probability(value: float | None) -> str:
    return "<0.001" if value is not None and value < 0.001 else shown(value, ".3f", "-")

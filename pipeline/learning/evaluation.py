"""How well a twin follows recordings, as JSON fields; recordings are read one by one, wherever the work is done."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial, reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fantwin.pipeline.learning.drops_found import static_words
from fantwin.pipeline.learning.training_data import (
    Part,
    TrainingData,
    data_cards,
    joined,
    read_recording_data,
    twin_errors,
)
from fantwin.pipeline.replay.offline.healthy_runs import MapRecordings

if TYPE_CHECKING:
    from fantwin.twin.evaluation.accuracy import Evaluation, Figures
    from fantwin.twin.evaluation.resampling import Grid
    from fantwin.twin.evaluation.residual_analysis import ResidualAnalysis
    from fantwin.twin.report.assessment import Assessment
    from fantwin.twin.report.content import Summary
    from fantwin.twin.report.recording_sums import Extent

EXPECTED_COVERAGE = math.erf(math.sqrt(2.0))
"""share of a normal distribution within two standard deviations"""


def evaluated(
    twin: Path, recordings: Sequence[Path], part: Part, each: MapRecordings, grids: Sequence[Grid] = ()
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """The result, and a line for each recording of which something could not be read. each: does the work on each
    recording. grids: others than the recorded one.

    Raises:
        UserError: a recording or the twin cannot be used, or they do not fit.
    """
    with twin_errors():
        from fantwin.twin.export.onnx_twin import OnnxTwin  # noqa: PLC0415  twin takes a while to load
        from fantwin.twin.report.assessment import assess  # noqa: PLC0415
        from fantwin.twin.report.content import SpeedUnit, summary_of  # noqa: PLC0415
        from fantwin.twin.report.recording_sums import common_extent  # noqa: PLC0415

        loaded = OnnxTwin(twin)
        known = list(each(partial(_known_of, part=part), recordings, "reading"))
        about, extent = joined([data for data, _ in known]), common_extent([extent for _, extent in known])
        work = partial(_sums_of, part=part, twin=twin, extent=extent, grids=grids)
        sums, *on_grids = reduce(_added, each(work, recordings, "evaluating"))
        unit = SpeedUnit(about.speed_unit, about.rad_s_per_unit)
        summary = summary_of(loaded, sums, extent, data_cards(about), unit, part.fans, about.labels)
        of_grids: list[tuple[Grid, Evaluation]] = [
            (grid, of.evaluation()) for grid, of in zip(grids, on_grids, strict=True)
        ]
        result = as_json(summary, assess(summary), of_grids, about)
        return result | {"static": static_words(twin, about.speed_unit)}, about.damage


def figures_in(figures: Figures, rad_s_per_unit: float) -> dict[str, float | int | None]:
    """Figures with speeds in the given unit; None where a figure is undefined or infinite."""
    values = {
        "rmse": figures.rmse_rad_s / rad_s_per_unit,
        "max_error": figures.max_error_rad_s / rad_s_per_unit,
        "r2": figures.r2,
        "one_step_rmse": figures.one_step_rmse_rad_s / rad_s_per_unit,
        "coverage_2_sigma": figures.coverage_2_sigma,
        "tacho_floor": figures.floor_rad_s / rad_s_per_unit,
    }
    return {name: value if math.isfinite(value) else None for name, value in values.items()} | {
        "samples": figures.samples
    }


def _known_of(path: Path, part: Part) -> tuple[TrainingData, Extent]:
    """What must be known of all recordings before one is evaluated; without the samples."""
    from fantwin.twin.report.recording_sums import extent_of  # noqa: PLC0415

    data = read_recording_data(path, part)
    with twin_errors():
        return replace(data, runs=[]), extent_of(data.runs)


def _sums_of(path: Path, part: Part, twin: Path, extent: Extent, grids: Sequence[Grid]) -> list[Any]:
    """The RecordingSums of one recording, and its FigureSums on each of the other grids."""
    from fantwin.twin.build import evaluation_sums, runs_of_twin  # noqa: PLC0415
    from fantwin.twin.errors import TwinError  # noqa: PLC0415
    from fantwin.twin.evaluation.resampling import on_grid  # noqa: PLC0415
    from fantwin.twin.export.onnx_twin import OnnxTwin  # noqa: PLC0415
    from fantwin.twin.report.recording_sums import recording_sums  # noqa: PLC0415

    with twin_errors():
        loaded, data = OnnxTwin(twin), read_recording_data(path, part)
        of_twin = runs_of_twin(loaded, data.runs, part.fans)
        if mistake := loaded.card.other_order([data.names.name(fan) for fan in data.fans], of_twin.rows):
            raise TwinError(f"{path}: {mistake}")
        on_grids = [evaluation_sums(loaded, on_grid(data.runs, grid), part.fans) for grid in grids]
        return [recording_sums(of_twin, extent), *on_grids]


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

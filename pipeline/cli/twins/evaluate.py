"""`fantwin evaluate`: how well a twin follows recordings."""

from __future__ import annotations

import math
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
from fantwin.pipeline.cli.twins.figures import sentence, shown
from fantwin.pipeline.errors import UsageError
from fantwin.pipeline.learning.evaluation import EXPECTED_COVERAGE, evaluated
from fantwin.pipeline.learning.training_data import Part, twin_errors
from fantwin.schemas.fan_names import fan_cell

if TYPE_CHECKING:
    from fantwin.twin.evaluation.resampling import Grid


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
        result, damage = evaluated(twin, recordings, part, pool.map, grids)
    report_damage(damage)
    figures = sentence(result, result["speed_unit"])
    lines = (*filter(None, (result["headline"], result["static"], figures)), _fan_table(result))
    grid_tables = [_grid_table(result)] if grids else []
    pool.end_with(result, *lines, *grid_tables, warnings=result["warnings"], json_output=json_output)


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
    caption = (
        "one step: corrected at each sample. white p: how probable the error is as noise. cross / bound: beyond ±2 the "
        "error follows the command."
    )
    table = table_of(
        ["fan"], (*figures, *tests), padding=0, caption=caption
    )  # narrow: numbers are whole on a terminal of 80 columns
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

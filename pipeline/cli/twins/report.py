"""`fantwin report`: how well a twin follows recordings, as one HTML page; without a twin, what the fans are."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape
from rich.table import Table

from fantwin.pipeline.cli.in_parallel import JobsOption, RecordingsInParallel, SkipBadOption
from fantwin.pipeline.cli.options import JsonOption, fan_numbers, recorded_names
from fantwin.pipeline.cli.printing import table_of
from fantwin.pipeline.cli.progress import interruptible, training_progress, working
from fantwin.pipeline.cli.twins.data_options import (
    FansOption,
    FromOption,
    IgnoreOption,
    ToOption,
    TrayOption,
    WindowOption,
    check_writable,
    ignored_columns,
    recordings_argument,
    report_damage,
    show_hints,
)
from fantwin.pipeline.cli.twins.figures import closed_loop_sentence, sentence
from fantwin.pipeline.errors import UsageError
from fantwin.pipeline.extras import require
from fantwin.pipeline.files import write_whole
from fantwin.pipeline.learning.drops_found import drops_found
from fantwin.pipeline.learning.evaluation import figures_in
from fantwin.pipeline.learning.training_data import Part, TrainingData, data_cards, read_training_data, twin_errors
from fantwin.schemas.fan_names import fan_cell

if TYPE_CHECKING:
    from fantwin.twin.fitting.identification import Identification
    from fantwin.twin.fitting.reference_choice import AtReference


def report(
    files: Annotated[
        list[Path],
        recordings_argument(
            metavar="[TWIN.onnx] REC.mcap...",
            help="A twin, as `fantwin train` makes it, and recordings; or recordings alone.",
        ),
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="PAGE.html", help="Page to write. Default: report.html."),
    ] = None,
    from_s: FromOption = 0.0,
    to_s: ToOption = math.inf,
    tray: TrayOption = None,
    fans: FansOption = None,
    window_s: WindowOption = None,
    ignore: IgnoreOption = None,
    jobs: JobsOption = None,
    skip_bad: SkipBadOption = False,
    json_output: JsonOption = False,
) -> None:
    """Compare the free run of a twin with recordings on an HTML page, or identify the fans of recordings.

    With a twin, the page contains the figures of `fantwin evaluate`, an assessment in words, what raises an alarm, fit
    and error over time, histogram and whiteness of the residual, its cross-correlation with the command, static curve,
    parameters with 95 % intervals and the model card.

    Without a twin, J, alpha and C_D of J w' + alpha w + C_D w|w| = command are found for each fan, and the lag of its
    command, with 95 % intervals. A warning names what the recordings do not determine, and why.

    Example: fantwin report TWIN.onnx held-out.mcap -o report.html

    Example: fantwin report REC.mcap --json
    """
    recordings = [file for file in files if file.suffix != ".onnx"]
    twins = [file for file in files if file.suffix == ".onnx"]
    if not recordings or len(twins) > 1:
        raise UsageError("name recordings, and at most one twin: fantwin report [TWIN.onnx] REC.mcap...")
    part = Part(
        tray,
        fan_numbers(fans, recorded_names(recordings, tray)),
        from_s,
        to_s,
        tuple(window_s or ()),
        ignored_columns(ignore),
    )
    pool = RecordingsInParallel(jobs, skip_bad)
    if twins:
        if window_s or ignore:
            raise UsageError("--window and --ignore are for recordings without a twin: a twin has its own tachos")
        _write_page(twins[0], recordings, output or Path("report.html"), part, pool, json_output=json_output)
    elif output:
        raise UsageError(f"{output}: a page is about a twin: name TWIN.onnx before the recordings")
    else:
        show_fans(recordings, part, pool, json_output=json_output)


def _write_page(
    twin: Path, recordings: list[Path], output: Path, part: Part, pool: RecordingsInParallel, *, json_output: bool
) -> None:
    require("a report", "report")
    with twin_errors():
        from fantwin.twin.export.onnx_twin import OnnxTwin  # noqa: PLC0415  the command line loads twin only when it is needed
        from fantwin.twin.report.assessment import assess, level_of  # noqa: PLC0415
        from fantwin.twin.report.content import SpeedUnit, report_content  # noqa: PLC0415
        from fantwin.twin.report.page import report_page  # noqa: PLC0415

        loaded = OnnxTwin(twin)
        check_writable(output, ".html")
        with pool:
            training_data = read_training_data(recordings, part, pool.map)
        report_damage(training_data.damage)
        unit = SpeedUnit(training_data.speed_unit, training_data.rad_s_per_unit)
        with working(f"drawing {output}"):
            content = report_content(
                loaded, training_data.runs, data_cards(training_data), unit, part.fans, training_data.labels
            )
            assessment = assess(content)
            drops = drops_found(twin, training_data.rad_s_per_unit)
            calibrate = f"fantwin calibrate {twin} HEALTHY.mcap... --false-alarms-per-day X"
            alarms = [drop.line(unit.name) for drop in drops] or [f"alarms are not calibrated: {calibrate}"]
            page = report_page(content, assessment, alarms)
    write_whole(output, page.encode())
    warnings = [*training_data.outliers, *assessment.warnings]
    pooled = figures_in(content.evaluation.pooled, training_data.rad_s_per_unit)
    by_fan = [
        {
            "fan": fan.number,
            "name": training_data.names.name(fan.number),
            **figures_in(fan.figures, training_data.rad_s_per_unit),
            "sigma": fan.sigma_rad_s / training_data.rad_s_per_unit,
            "assessment": level_of(fan, content),
        }
        for fan in content.fans
    ]
    found = {"report": str(output), "bytes": len(page.encode()), "assessment": assessment.level}
    found |= {"headline": assessment.headline, **pooled, "speed_unit": unit.name, "fans": by_fan}
    found |= {"drops_found": [drop.model_dump() for drop in drops], "warnings": warnings}
    lines = (f"{output}: {assessment.headline}", *(f"  {line}" for line in (sentence(pooled, unit.name), *alarms)))
    pool.end_with(found, *lines, warnings=warnings, json_output=json_output)


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
            training_data = read_training_data(recordings, part, pool.map)
        report_damage(training_data.damage)
        if not json_output:
            show_hints(training_data.hints)
        with training_progress(training_data) as start, twin_errors(training_data):
            found = identify_at_reference(training_data.runs, progress=start(""))
    result = fans_as_json(found, training_data)
    notes = [f"allows for {result['allows_for']}"] if result["allows_for"] else []
    if loops := result["closed_loop"]:
        notes.append(closed_loop_sentence(training_data.names.labels(loops)))
    warnings = [f"warning: {warning}" for warning in result["warnings"]]
    pool.end_with(result, _table(result), *notes, warnings=warnings, json_output=json_output)


def fans_as_json(at_reference: AtReference, training_data: TrainingData) -> dict[str, Any]:
    """The result as JSON fields; None where a figure is undefined.

    Rows and columns of a covariance are in the order of `parameters`; those of a lag that was not found are zero.
    """
    from fantwin.twin.models.physics import PARAMETER_NAMES  # noqa: PLC0415

    found, conditions = at_reference.identification, at_reference.conditions
    fans = [
        {
            "fan": training_data.fans[fan],
            "name": training_data.names.name(training_data.fans[fan]),
            **dict(zip(PARAMETER_NAMES, found.parameters[fan].tolist(), strict=True)),
            **{f"{name}_95": _interval(found, fan, k) for k, name in enumerate(PARAMETER_NAMES)},
            "covariance": found.covariance[fan].tolist(),
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
        "closed_loop": training_data.numbers_where(found.closed_loop.tolist()),
        "hints": list(training_data.hints),
    }


def _interval(found: Identification, fan: int, index: int) -> list[float] | None:
    """None for a parameter that was not estimated: a lag that was not found, or one that the fit drove to its bound."""
    return found.interval_95[fan, index].tolist() if found.covariance[fan, index, index] > 0.0 else None


def _table(result: dict[str, Any]) -> Table:
    """A row for each fan, the half width of each interval below its value."""
    mechanical = [name for name in result["parameters"] if name != "lag_s"]
    units = "; ".join(f"{name} in {result['units'][name]}" for name in mechanical)
    columns = (*mechanical, "lag\nms", "time\nconst. s", f"rmse\n{result['speed_unit']}")
    caption = f"{units}. ± is half a 95 % interval; the time constant is that at the median speed."
    if any(fan[f"{name}_95"] is None for fan in result["fans"] for name in mechanical):
        caption += " -: the fit drove the value to its bound, which has no interval."
    table = table_of(["fan"], columns, pad_edge=False, caption=caption)
    table.columns[0].no_wrap = False  # a long name must not cut the numbers
    for fan in result["fans"]:
        values = [_with_interval(fan[name], fan[f"{name}_95"]) for name in mechanical]
        figures = (f"{fan['time_constant_s']:.3g}", f"{fan['rmse']:.4g}")
        table.add_row(escape(fan_cell(fan["fan"], fan["name"])), *values, _lag(fan), *figures)
    return table


def _lag(fan: dict[str, Any]) -> str:
    if fan["lag_s_95"] is None:
        return "none seen"
    low, high = fan["lag_s_95"]
    return _with_interval(1e3 * fan["lag_s"], [1e3 * low, 1e3 * high])


def _with_interval(value: float, interval: list[float] | None) -> str:
    return f"{value:.4g}\n{f'± {(interval[1] - interval[0]) / 2:.1g}' if interval else '-'}"

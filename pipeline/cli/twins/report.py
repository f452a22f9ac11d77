"""`fantwin report`: how well a twin follows recordings, as one HTML page; without a twin, what the fans are."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated

import typer

from fantwin.pipeline.cli.options import JsonOption, fan_numbers
from fantwin.pipeline.cli.progress import working
from fantwin.pipeline.cli.recordings_in_parallel import JobsOption, RecordingsInParallel, SkipBadOption
from fantwin.pipeline.cli.twins.drops_found import drop_lines, drops_found
from fantwin.pipeline.cli.twins.fan_parameters import show_fans
from fantwin.pipeline.cli.twins.figures import figures_in, sentence
from fantwin.pipeline.cli.twins.training_data import (
    FansOption,
    FromOption,
    IgnoreOption,
    Part,
    ToOption,
    TrayOption,
    WindowOption,
    check_writable,
    data_cards,
    ignored_columns,
    read_training_data,
    twin_errors,
)
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.extras import require
from fantwin.pipeline.recordings.remote import matching, recording_path


def report(
    files: Annotated[
        list[Path],
        typer.Argument(
            parser=recording_path,
            callback=matching,
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
    part = Part(tray, fans, from_s, to_s, tuple(window_s or ()), ignored_columns(ignore))
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
            training_data = read_training_data(recordings, part, pool)
        unit = SpeedUnit(training_data.speed_unit, training_data.rad_s_per_unit)
        with working(f"drawing {output}"):
            content = report_content(
                loaded, training_data.runs, data_cards(training_data), unit, fan_numbers(part.fans)
            )
            assessment = assess(content)
            drops = drops_found(twin, training_data.rad_s_per_unit)
            alarms = drop_lines(drops, unit.name) or ["alarms are not calibrated: fantwin calibrate"]
            page = report_page(content, assessment, alarms)
    try:
        output.write_text(page, encoding="utf-8")
    except OSError as error:
        raise UserError(f"{output}: cannot be written: {error.strerror}; name another file with -o") from error
    warnings = [*training_data.outliers, *assessment.warnings]
    pooled = figures_in(content.evaluation.pooled, training_data.rad_s_per_unit)
    if json_output:
        by_fan = [
            {
                "fan": fan.number,
                **figures_in(fan.figures, training_data.rad_s_per_unit),
                "sigma": fan.sigma_rad_s / training_data.rad_s_per_unit,
                "assessment": level_of(fan),
            }
            for fan in content.fans
        ]
        result = {
            "report": str(output),
            "bytes": len(page.encode()),
            "assessment": assessment.level,
            "headline": assessment.headline,
        }
        found = {"speed_unit": unit.name, "fans": by_fan, "drops_found": [drop.as_json() for drop in drops]}
        typer.echo(json.dumps({**result, **pooled, **found, "warnings": warnings} | pool.as_json()))
    else:
        typer.echo(f"{output}: {assessment.headline}")
        typer.echo(f"  {sentence(pooled, unit.name)}")
        for line in alarms:
            typer.echo(f"  {line}")
        for warning in warnings:
            typer.echo(warning, err=True)
    pool.end()

"""`fantwin report`: how well a twin follows recordings, as one HTML page."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated

import typer

from fantwin.pipeline.cli.options import JsonOption, fan_numbers
from fantwin.pipeline.cli.progress import working
from fantwin.pipeline.cli.recordings_in_parallel import RecordingsInParallel
from fantwin.pipeline.cli.twins.drops_found import drop_lines, drops_found
from fantwin.pipeline.cli.twins.figures import figures_in, sentence
from fantwin.pipeline.cli.twins.training_data import (
    FansOption,
    FromOption,
    Part,
    RecordingsArgument,
    ToOption,
    TrayOption,
    check_writable,
    data_cards,
    read_training_data,
    twin_errors,
)
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.extras import require


def report(
    twin: Annotated[Path, typer.Argument(metavar="TWIN.onnx", help="The twin, as `fantwin train` makes it.")],
    recordings: RecordingsArgument,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="PAGE.html", help="Page to write.")] = Path(
        "report.html"
    ),
    from_s: FromOption = 0.0,
    to_s: ToOption = math.inf,
    tray: TrayOption = None,
    fans: FansOption = None,
    json_output: JsonOption = False,
) -> None:
    """Compare the free run of a twin with recordings, and write the result as one self-contained HTML page.

    The page contains the figures of `fantwin evaluate`, an assessment in words, what raises an alarm, fit and error
    over time, histogram and whiteness of the residual, its cross-correlation with the command, static curve, parameters
    with 95 % intervals and the model card.

    Example: fantwin report TWIN.onnx held-out.mcap -o report.html
    """
    require("a report", "report")
    with twin_errors():
        from fantwin.twin.export.onnx_twin import OnnxTwin  # noqa: PLC0415  the command line loads twin only when it is needed
        from fantwin.twin.report.assessment import assess, level_of  # noqa: PLC0415
        from fantwin.twin.report.content import SpeedUnit, report_content  # noqa: PLC0415
        from fantwin.twin.report.page import report_page  # noqa: PLC0415

        loaded = OnnxTwin(twin)
        check_writable(output, ".html")
        training_data = read_training_data(recordings, Part(tray, fans, from_s, to_s), RecordingsInParallel(jobs=1))
        unit = SpeedUnit(training_data.speed_unit, training_data.rad_s_per_unit)
        with working(f"drawing {output}"):
            content = report_content(loaded, training_data.runs, data_cards(training_data), unit, fan_numbers(fans))
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
        typer.echo(json.dumps({**result, **pooled, **found, "warnings": warnings}))
        return
    typer.echo(f"{output}: {assessment.headline}")
    typer.echo(f"  {sentence(pooled, unit.name)}")
    for line in alarms:
        typer.echo(f"  {line}")
    for warning in warnings:
        typer.echo(warning, err=True)

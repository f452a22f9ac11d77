"""`fantwin report`: how well a twin follows recordings, as one page to read, print and pass on."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli.options import JsonOption, fan_numbers
from pipeline.cli.progress import working
from pipeline.cli.twins.figures import figures_in, sentence
from pipeline.cli.twins.training_data import (
    FansOption,
    FromOption,
    RecordingsArgument,
    ToOption,
    TrayOption,
    check_writable,
    data_cards,
    model_maker,
    read_material,
)
from pipeline.errors import UserError


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
    """Run a twin freely over recordings and write what comes of it as one HTML page that needs nothing else.

    It holds the figures of `fantwin evaluate` with a verdict in words, fit and error over time, histogram, whiteness,
    cross-correlation with the command, static curve, parameters with 95 % intervals and the model card.

    Example: fantwin report TWIN.onnx held-out.mcap -o report.html
    """
    with model_maker():
        from twin.export.onnx_twin import OnnxTwin  # noqa: PLC0415  the command line loads twin only when it is needed
        from twin.report.content import SpeedUnit, report_content  # noqa: PLC0415
        from twin.report.page import report_page  # noqa: PLC0415
        from twin.report.verdict import judge, level_of  # noqa: PLC0415

        loaded = OnnxTwin(twin)
        check_writable(output, ".html")
        material = read_material(recordings, tray, fans, from_s, to_s)
        unit = SpeedUnit(material.speed_unit, material.rad_s_per_unit)
        with working(f"drawing {output}"):
            content = report_content(loaded, material.runs, data_cards(material), unit, fan_numbers(fans))
            judged = judge(content)
            page = report_page(content, judged)
    try:
        output.write_text(page, encoding="utf-8")
    except OSError as error:
        raise UserError(f"{output}: cannot be written: {error.strerror}; name another file with -o") from error
    warnings = [*material.outliers, *judged.warnings]
    pooled = figures_in(content.evaluation.pooled, material.rad_s_per_unit)
    if json_output:
        by_fan = [
            {
                "fan": fan.number,
                **figures_in(fan.figures, material.rad_s_per_unit),
                "sigma": fan.sigma_rad_s / material.rad_s_per_unit,
                "verdict": level_of(fan),
            }
            for fan in content.fans
        ]
        told = {
            "report": str(output),
            "bytes": len(page.encode()),
            "verdict": judged.level,
            "headline": judged.headline,
        }
        typer.echo(json.dumps({**told, **pooled, "speed_unit": unit.name, "fans": by_fan, "warnings": warnings}))
        return
    typer.echo(f"{output}: {judged.headline}")
    typer.echo(f"  {sentence(pooled, unit.name)}")
    for warning in warnings:
        typer.echo(warning, err=True)

"""`fantwin evaluate`: how well a twin follows recordings."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Annotated

import typer

from pipeline.commands.model_maker import (
    FansOption,
    FromOption,
    RecordingsArgument,
    ToOption,
    TrayOption,
    figures_in,
    model_maker,
    read_material,
    sentence,
)
from pipeline.commands.options import JsonOption


def evaluate(
    twin: Annotated[Path, typer.Argument(metavar="TWIN.onnx", help="The twin, as `fantwin train` makes it.")],
    recordings: RecordingsArgument,
    from_s: FromOption = 0.0,
    to_s: ToOption = math.inf,
    tray: TrayOption = None,
    fans: FansOption = None,
    json_output: JsonOption = False,
) -> None:
    """Run a twin freely over recordings and compare it with what was measured, in the recording's own units.

    The free run gets one initial speed and then the commands alone. The one-step error is given beside it; it says
    little, because it is corrected at each sample.

    Example: fantwin evaluate TWIN.onnx held-out.mcap --json
    """
    with model_maker():
        from twin.build import evaluate as evaluate_twin  # noqa: PLC0415  the command line loads twin only when needed

        material = read_material(recordings, tray, fans, from_s, to_s)
        evaluation = evaluate_twin(twin, material.runs)
    pooled = figures_in(evaluation.pooled, material.rad_s_per_unit)
    by_fan = [figures_in(figures, material.rad_s_per_unit) for figures in evaluation.per_fan]
    if json_output:
        typer.echo(json.dumps({**pooled, "speed_unit": material.speed_unit, "fans": by_fan}))
        return
    typer.echo(sentence(pooled, material.speed_unit))
    if len(by_fan) > 1:
        for fan, figures in enumerate(by_fan):
            typer.echo(f"  fan {fan}: {sentence(figures, material.speed_unit)}")

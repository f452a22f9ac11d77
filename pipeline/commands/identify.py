"""`fantwin identify`: the physical parameters of the fans in recordings."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

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
    model_maker,
    read_material,
)
from pipeline.commands.options import JsonOption

if TYPE_CHECKING:
    from twin.identification import Identification

PARAMETERS = ("J", "alpha", "C_D")


def identify(
    recordings: RecordingsArgument,
    from_s: FromOption = 0.0,
    to_s: ToOption = math.inf,
    tray: TrayOption = None,
    fans: FansOption = None,
    json_output: JsonOption = False,
) -> None:
    """Find J, alpha and C_D of J w' + alpha w + C_D w|w| = command for each fan, with 95 % intervals.

    w is in rad/s and the command in its own unit, so the parameters are in that unit too: only their ratios are
    mechanical.

    Example: fantwin identify REC.mcap --json
    """
    with model_maker():
        from twin.identification import identify as identify_fans  # noqa: PLC0415  loads twin only when it is needed

        material = read_material(recordings, tray, fans, from_s, to_s)
        found = identify_fans(material.runs)
    if json_output:
        typer.echo(json.dumps(account(found, material)))
        return
    table = Table("fan")
    for header in (*PARAMETERS, "time constant s", f"rmse {material.speed_unit}"):
        table.add_column(header, no_wrap=header in PARAMETERS, justify="right")
    for fan, of_fan in enumerate(account(found, material)["fans"]):
        parameters = (f"{of_fan[name]:.4g} ± {_half_width(of_fan[f'{name}_95']):.1g}" for name in PARAMETERS)
        table.add_row(str(fan), *parameters, f"{of_fan['time_constant_s']:.3g}", f"{of_fan['rmse']:.4g}")
    Console().print(table)
    for warning in found.warnings:
        typer.echo(warning, err=True)


def account(found: Identification, material: Material) -> dict[str, Any]:
    """What a machine is told of an identification."""
    fans = [
        {
            **dict(zip(PARAMETERS, found.parameters[fan].tolist(), strict=True)),
            **{f"{name}_95": found.interval_95[fan, k].tolist() for k, name in enumerate(PARAMETERS)},
            "time_constant_s": float(found.time_constant_s[fan]),
            "lambda_per_s": float(found.lambda_per_s[fan]),
            "rmse": float(found.rmse_rad_s[fan]) / material.rad_s_per_unit,
        }
        for fan in range(len(found.parameters))
    ]
    return {"fans": fans, "speed_unit": material.speed_unit, "warnings": list(found.warnings)}


def _half_width(interval: list[float]) -> float:
    return (interval[1] - interval[0]) / 2

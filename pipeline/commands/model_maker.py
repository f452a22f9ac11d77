"""What the commands that build and judge twins share: recordings as runs, errors in one line, people's own units."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import typer

from pipeline.commands.options import fan_numbers
from pipeline.errors import UserError
from pipeline.runs_of_recording import RecordedRun, read_runs
from pipeline.table import RAD_S_PER_TABLE_UNIT

if TYPE_CHECKING:
    from twin.evaluation import Figures
    from twin.runs import Run

RecordingsArgument: TypeAlias = Annotated[
    list[Path], typer.Argument(metavar="REC.mcap...", help="Recordings; each counts its seconds from its own start.")
]
FromOption: TypeAlias = Annotated[float, typer.Option("--from", help="Use each recording from this second on.")]
ToOption: TypeAlias = Annotated[float, typer.Option("--to", help="Use each recording up to this second.")]
TrayOption: TypeAlias = Annotated[str | None, typer.Option(help="Which tray, where a recording has several.")]
FansOption: TypeAlias = Annotated[str | None, typer.Option(help="Only these fans, counted from 0, e.g. 0,2.")]

_EXTRA_MODULES = ("onnx", "scipy", "torch")


@dataclass(frozen=True, eq=False)
class Material:
    """Runs for the model maker, and the unit in which people are shown their speeds."""

    runs: list[Run]
    recorded: list[RecordedRun]
    speed_unit: str

    @property
    def rad_s_per_unit(self) -> float:
        """One of the people's unit in rad/s."""
        return RAD_S_PER_TABLE_UNIT[self.speed_unit]


def read_material(
    recordings: Sequence[Path], tray: str | None, fans: str | None, from_s: float, to_s: float
) -> Material:
    """The runs of several recordings. What is damaged in them is told on stderr.

    Raises:
        UserError: a recording cannot be used, or they are not in one unit.
    """
    from twin.runs import Run  # noqa: PLC0415  the command line loads twin only when it is needed

    recorded: list[RecordedRun] = []
    units: dict[str, Path] = {}
    for path in recordings:
        found = read_runs(path, tray, fan_numbers(fans), from_s, to_s)
        if found.damage:
            typer.echo(found.damage, err=True)
        recorded += found.runs
        units.setdefault(found.speed_unit, path)
    if len(units) > 1:
        said = " and ".join(f"{unit} ({path})" for unit, path in units.items())
        raise UserError(f"recordings in different units, {said}: give those of one unit")
    (unit,) = units
    if unit not in RAD_S_PER_TABLE_UNIT:
        raise UserError(f"{units[unit]}: unknown unit of speed {unit!r}; known: {', '.join(RAD_S_PER_TABLE_UNIT)}")
    with model_maker():
        runs = [Run(run.path.stem, run.t_s, run.command, run.speed_rad_s) for run in recorded]
    return Material(runs, recorded, unit)


@contextmanager
def model_maker() -> Iterator[None]:
    """Around calls of the model maker: its errors, and a missing extra, become one line."""
    try:
        from twin.errors import TwinError  # noqa: PLC0415

        try:
            yield
        except TwinError as error:
            raise UserError(str(error)) from error
    except ModuleNotFoundError as error:
        if error.name is None or error.name.split(".")[0] not in _EXTRA_MODULES:
            raise
        raise UserError(f"this needs the extra `train` ({error.name}): pip install 'fantwin[train]'") from error


def figures_in(figures: Figures, rad_s_per_unit: float) -> dict[str, float | int | None]:
    """Figures for people and machines: speeds in a unit of theirs, None where a figure is undefined or infinite."""
    values = {
        "rmse": figures.rmse_rad_s / rad_s_per_unit,
        "max_error": figures.max_error_rad_s / rad_s_per_unit,
        "r2": figures.r2,
        "one_step_rmse": figures.one_step_rmse_rad_s / rad_s_per_unit,
        "coverage_2_sigma": figures.coverage_2_sigma,
    }
    return {name: value if math.isfinite(value) else None for name, value in values.items()} | {
        "samples": figures.samples
    }


def sentence(figures: dict[str, Any], unit: str) -> str:
    """Figures in a line."""

    def shown(name: str, digits: str) -> str:
        return "undefined" if figures[name] is None else format(figures[name], digits)

    return (
        f"free run: rmse {shown('rmse', '.4g')} {unit}, max error {shown('max_error', '.4g')} {unit}, "
        f"R2 {shown('r2', '.4f')}, {shown('coverage_2_sigma', '.1%')} within 2 sigma; "
        f"one step: rmse {shown('one_step_rmse', '.4g')} {unit}; {figures['samples']} samples"
    )

"""`fantwin train`: recordings of healthy fans become a twin."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from pipeline.commands.model_maker import (
    FansOption,
    FromOption,
    Material,
    RecordingsArgument,
    ToOption,
    TrayOption,
    figures_in,
    model_maker,
    read_material,
    sentence,
)
from pipeline.commands.options import JsonOption
from pipeline.errors import UserError

if TYPE_CHECKING:
    from twin.build import TrainedTwin
    from twin.card import DataCard
    from twin.training import Progress as ProgressCallback


Model: TypeAlias = Literal["physical", "narx", "neural-ode", "hybrid"]
Trainer: TypeAlias = Literal["levenberg-marquardt", "adam"]
NetworkInputs: TypeAlias = Literal["speed,command", "speed"]


def train(
    recordings: RecordingsArgument,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="TWIN.onnx", help="Twin to write.")],
    model: Annotated[Model, typer.Option(help="Which model.")] = "hybrid",
    validate: Annotated[
        list[Path] | None,
        typer.Option(metavar="REC.mcap", help="Healthy recording to judge by and not to fit on. Repeatable."),
    ] = None,
    from_s: FromOption = 0.0,
    to_s: ToOption = math.inf,
    validate_from_s: Annotated[float, typer.Option("--validate-from", help="As --from, of --validate.")] = 0.0,
    validate_to_s: Annotated[float, typer.Option("--validate-to", help="As --to, of --validate.")] = math.inf,
    tray: TrayOption = None,
    fans: FansOption = None,
    name: Annotated[str | None, typer.Option(help="Of the twin; without it, that of the file.")] = None,
    seed: Annotated[int, typer.Option(help="The same seed and recordings give the same twin.")] = 0,
    trainer: Annotated[Trainer, typer.Option(help="adam is the published recipe.")] = "levenberg-marquardt",
    iterations: Annotated[int | None, typer.Option(min=1, help="At most; without it, as fits the trainer.")] = None,
    network_inputs: Annotated[
        NetworkInputs, typer.Option(help="Of the hybrid's and the neural ODE's network.")
    ] = "speed,command",
    command_unit: Annotated[str, typer.Option(help="For the card, e.g. %.")] = "",
    json_output: JsonOption = False,
) -> None:
    """Learn a twin of healthy fans and write it, with its card, as an ONNX file.

    The band of the twin rests on the free-run error over --validate; without it, on that over the training part,
    which flatters.

    Example: fantwin train healthy-1.mcap healthy-2.mcap --validate healthy-3.mcap --model hybrid -o TWIN.onnx
    """
    with model_maker():
        from twin.build import train_twin  # noqa: PLC0415  the command line loads twin only when it is needed

        material = read_material(recordings, tray, fans, from_s, to_s)
        held_out = read_material(validate, tray, fans, validate_from_s, validate_to_s) if validate else None
        with _progress(material.rad_s_per_unit, material.speed_unit) as progress:
            trained = train_twin(
                material.runs,
                held_out.runs if held_out else [],
                model,
                name=name or output.stem,
                seed=seed,
                trainer=trainer,
                max_iterations=iterations,
                network_inputs=tuple(network_inputs.split(",")),
                command_unit=command_unit,
                data=_data(material),
                progress=progress,
            )
        try:
            output.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(
                f"{output.parent}: cannot be made: {error.strerror}; name another folder with -o"
            ) from error
        trained.save(output)
    told = account(trained, material, output)
    if json_output:
        typer.echo(json.dumps(told))
        return
    typer.echo(f"{output}: {model} of {told['fans']} fan(s), {told['network_parameters']} network parameters")
    typer.echo(f"  {told['judged_on']} data, {sentence(told, material.speed_unit)}")
    for warning in told["warnings"]:
        typer.echo(warning, err=True)


def account(trained: TrainedTwin, material: Material, output: Path) -> dict[str, Any]:
    """What a machine is told of a training; figures in the recordings' own units."""
    card = trained.card
    return {
        "twin": str(output),
        "model": card.kind,
        **figures_in(trained.validation.pooled, material.rad_s_per_unit),
        "judged_on": card.validation.source,
        "speed_unit": material.speed_unit,
        "sigma": [sigma / material.rad_s_per_unit for sigma in card.sigma_rad_s],
        "fans": card.fans,
        "network_parameters": card.network.parameter_count,
        "iterations": card.training.iterations,
        "duration_s": card.training.duration_s,
        "warnings": list(trained.identification.warnings),
    }


def _data(material: Material) -> list[DataCard]:
    """What the twin was trained on, for its card: one entry a file."""
    from twin.card import DataCard  # noqa: PLC0415

    samples: dict[Path, int] = {}
    for run in material.recorded:
        samples[run.path] = samples.get(run.path, 0) + len(run.t_s)
    fans = material.runs[0].fans
    return [
        DataCard(name=path.name, sha256=hashlib.sha256(path.read_bytes()).hexdigest(), fans=fans, samples=count)
        for path, count in samples.items()
    ]


@contextmanager
def _progress(rad_s_per_unit: float, unit: str) -> Iterator[ProgressCallback]:
    """A bar on stderr that goes when all is done; without a terminal it stays silent."""
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total}"))
    with Progress(*columns, TimeElapsedColumn(), console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("identifying", total=None)

        def show(done: int, at_most: int, rmse_rad_s: float) -> None:
            said = f"free-run rmse {rmse_rad_s / rad_s_per_unit:.4g} {unit}"
            bar.update(task, completed=done, total=at_most, description=said)

        yield show

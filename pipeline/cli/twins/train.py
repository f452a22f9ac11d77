"""`fantwin train`: recordings of healthy fans become a twin."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import typer

from pipeline.cli.options import JsonOption
from pipeline.cli.progress import training_progress
from pipeline.cli.twins.figures import figures_in, sentence, shown
from pipeline.cli.twins.training_data import (
    FansOption,
    FromOption,
    Material,
    RecordingsArgument,
    ToOption,
    TrayOption,
    check_writable,
    data_cards,
    model_maker,
    read_held_out,
    read_material,
)

if TYPE_CHECKING:
    from twin.build import TrainedTwin


Trainer: TypeAlias = Literal["levenberg-marquardt", "adam"]
Physics: TypeAlias = Literal["fixed", "refined"]
NetworkInputs: TypeAlias = Literal["speed,command", "speed"]


def train(
    recordings: RecordingsArgument,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="TWIN.onnx", help="Twin to write.")],
    model: Annotated[str, typer.Option(help="Kind of model: physical, narx, neural-ode or hybrid.")] = "hybrid",
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
    iterations: Annotated[
        int | None, typer.Option(min=1, help="At most, of the start that goes on; without it, as fits the trainer.")
    ] = None,
    network_inputs: Annotated[
        NetworkInputs, typer.Option(help="Of the hybrid's and the neural ODE's network.")
    ] = "speed,command",
    physics: Annotated[
        Physics, typer.Option(help="Of a hybrid: refined with its network, or fixed as identified.")
    ] = "refined",
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
        from twin.kinds import find_kind  # noqa: PLC0415

        find_kind(model)
        check_writable(output, ".onnx")
        material = read_material(recordings, tray, fans, from_s, to_s)
        held_out = read_held_out(material, validate, tray, fans, validate_from_s, validate_to_s) if validate else None
        with training_progress(material) as start:
            trained = train_twin(
                material.runs,
                held_out.runs if held_out else [],
                model,
                name=name or output.stem,
                seed=seed,
                trainer=trainer,
                max_iterations=iterations,
                network_inputs=tuple(network_inputs.split(",")),
                physics=physics,
                command_unit=command_unit,
                fan_numbers=material.fans,
                data=data_cards(material),
                validation_data=data_cards(held_out) if held_out else (),
                progress=start(""),
            )
        trained.save(output)
    told = account(trained, material, output)
    if json_output:
        typer.echo(json.dumps(told))
        return
    typer.echo(f"{output}: {model} of {told['fans']} fan(s), {told['network_parameters']} network parameters")
    typer.echo(f"  {told['judged_on']} data, {sentence(told, material.speed_unit)}")
    typer.echo(f"  {balance_sentence(told)}")
    for warning in told["warnings"]:
        typer.echo(warning, err=True)


def balance_sentence(told: dict[str, Any]) -> str:
    """How still the torque balance of healthy fans is, in a line."""
    lowest, highest = (shown(sigma(told["balance_sigma"])) for sigma in (min, max))
    spread = lowest if lowest == highest else f"{lowest} to {highest}"
    chosen: list[str] = told["balance_source"]
    sources = ", ".join(f"{chosen.count(source)} fan(s) by {source}" for source in dict.fromkeys(chosen))
    unit = told["command_unit"] or "of the command"
    return f"torque balance: healthy sigma {spread} {unit}; coefficients of {sources}"


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
        "balance_sigma": list(card.balance.sigma_command),
        "balance_source": list(card.balance.source),
        "command_unit": card.command_unit,
        "fans": card.fans,
        "network_parameters": card.network.parameter_count,
        "iterations": card.training.iterations,
        "duration_s": card.training.duration_s,
        "warnings": material.named(trained.identification.warnings),
    }

"""`fantwin train`: recordings of healthy fans become a twin."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

import typer

from fantwin.pipeline.cli.networks_in_parallel import NetworksInParallel
from fantwin.pipeline.cli.options import JsonOption
from fantwin.pipeline.cli.progress import interruptible, training_progress
from fantwin.pipeline.cli.recordings_in_parallel import RecordingsInParallel, SchedulerOption, SkipBadOption
from fantwin.pipeline.cli.twins.figures import figures_in, sentence, shown
from fantwin.pipeline.cli.twins.training_data import (
    FansOption,
    FromOption,
    IgnoreOption,
    Part,
    RecordingsArgument,
    ToOption,
    TrainingData,
    TrayOption,
    ValidateFromOption,
    ValidateOption,
    ValidateToOption,
    WindowOption,
    check_writable,
    data_cards,
    ignored_columns,
    read_held_out,
    read_training_data,
    show_hints,
    twin_errors,
)
from fantwin.pipeline.extras import require_torch

if TYPE_CHECKING:
    from fantwin.schemas.reference_conditions import ReferenceConditions
    from fantwin.twin.finishing import TrainedTwin
    from fantwin.twin.networks import ForEachNetwork
    from fantwin.twin.progress import Progress


Trainer: TypeAlias = Literal["levenberg-marquardt", "adam"]
Physics: TypeAlias = Literal["fixed", "refined"]
NetworkInputs: TypeAlias = Literal["speed,command", "speed"]


NETWORKS = 4
"""with so many, twins hardly depend on the seed: docs/reference/benchmarks.md"""


@dataclass(frozen=True)
class TrainingSettings:
    """How a twin is trained; see the options of the command."""

    model: str = "hybrid"
    seed: int = 0
    trainer: Trainer = "levenberg-marquardt"
    iterations: int | None = None
    network_inputs: NetworkInputs = "speed,command"
    physics: Physics = "refined"
    networks: int | None = None
    command_unit: str = ""


DEFAULT_SETTINGS = TrainingSettings()


def train(
    recordings: RecordingsArgument,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="TWIN.onnx", help="Twin to write.")],
    model: Annotated[str, typer.Option(help="Kind of model: physical, narx, neural-ode or hybrid.")] = "hybrid",
    validate: ValidateOption = None,
    from_s: FromOption = 0.0,
    to_s: ToOption = math.inf,
    validate_from_s: ValidateFromOption = 0.0,
    validate_to_s: ValidateToOption = math.inf,
    tray: TrayOption = None,
    fans: FansOption = None,
    window_s: WindowOption = None,
    ignore: IgnoreOption = None,
    name: Annotated[str | None, typer.Option(help="Name of the twin. Default: the name of the file.")] = None,
    seed: Annotated[int, typer.Option(help="The same seed and recordings give the same twin.")] = 0,
    trainer: Annotated[Trainer, typer.Option(help="adam, the published one, needs PyTorch.")] = "levenberg-marquardt",
    iterations: Annotated[
        int | None, typer.Option(min=1, help="Maximum iterations of each network. Default: depends on the trainer.")
    ] = None,
    network_inputs: Annotated[
        NetworkInputs, typer.Option(help="Inputs of the network (hybrid, neural ODE).")
    ] = "speed,command",
    physics: Annotated[
        Physics, typer.Option(help="Hybrid: physics refined with the network, or fixed as identified.")
    ] = "refined",
    networks: Annotated[
        int | None,
        typer.Option(
            help="Networks to train and average (hybrid, neural ODE). Default: "
            f"{NETWORKS}, and 1 where they cannot be averaged."
        ),
    ] = None,
    command_unit: Annotated[str, typer.Option(help="Unit of the command, for the card, e.g. %.")] = "",
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs",
            "-j",
            min=1,
            help="Recordings to read, and networks to train, at a time. Default: one for each core.",
        ),
    ] = None,
    scheduler: SchedulerOption = None,
    skip_bad: SkipBadOption = False,
    json_output: JsonOption = False,
) -> None:
    """Train a twin of healthy fans and write it, with its card, as an ONNX file.

    The width of the band is the free-run error over --validate. Without --validate it is the error over the training
    data, which is too optimistic.

    Ctrl-C ends training without a twin, with exit code 130.

    Example: fantwin train healthy-1.mcap healthy-2.mcap --validate healthy-3.mcap --model hybrid -o TWIN.onnx
    """
    if trainer == "adam":
        require_torch("--trainer adam")
    not_written = "no twin was written; --iterations N ends after N iterations of each network and writes one"
    pool = RecordingsInParallel(jobs, scheduler, skip_bad)
    with interruptible(not_written), twin_errors():
        check_writable(output, ".onnx")
        part = Part(tray, fans, from_s, to_s, tuple(window_s or ()), ignored_columns(ignore))
        validation_part = replace(part, from_s=validate_from_s, to_s=validate_to_s)
        with pool:
            training_data = read_training_data(recordings, part, pool)
            held_out = read_held_out(training_data, validate, validation_part, pool) if validate else None
        if not json_output:
            show_hints(training_data.hints)
        with training_progress(training_data) as start, NetworksInParallel(jobs) as each_network:
            trained = fit_twin(
                training_data,
                held_out,
                name or output.stem,
                TrainingSettings(model, seed, trainer, iterations, network_inputs, physics, networks, command_unit),
                start(""),
                each_network,
            )
        trained.save(output)
    result = as_json(trained, training_data, output)
    if json_output:
        typer.echo(json.dumps(result | pool.as_json()))
    else:
        _print(result, training_data, trained.card.conditions)
    pool.end()


def _print(result: dict[str, Any], training_data: TrainingData, conditions: ReferenceConditions | None) -> None:
    networks = f"{result['network_parameters']} network parameters"
    typer.echo(f"{result['twin']}: {result['model']} of {result['fans']} fan(s), {networks}")
    typer.echo(f"  {result['evaluated_on']} data, {sentence(result, training_data.speed_unit)}")
    typer.echo(f"  {balance_sentence(result)}")
    if conditions:
        columns = f"column{'s' * (len(conditions.needed) > 1)} {' and '.join(conditions.needed)}"
        typer.echo(f"  allows for {conditions.in_words}, and needs the {columns}")
    for warning in result["warnings"]:
        typer.echo(warning, err=True)


def fit_twin(
    training_data: TrainingData,
    held_out: TrainingData | None,
    name: str,
    settings: TrainingSettings = DEFAULT_SETTINGS,
    progress: Progress | None = None,
    each_network: ForEachNetwork | None = None,
) -> TrainedTwin:
    """A twin of what was read. held_out: on which its weights are chosen and its band is measured. each_network: who
    trains its networks; None: this process, one after another.

    Raises:
        TwinError: the data do not suffice.
    """
    from fantwin.twin.build import train_twin  # noqa: PLC0415  the command line loads twin only when it is needed
    from fantwin.twin.kinds import find_kind  # noqa: PLC0415
    from fantwin.twin.networks import one_after_another  # noqa: PLC0415
    from fantwin.twin.progress import unreported  # noqa: PLC0415

    can_average = find_kind(settings.model).averages_networks and settings.trainer == "levenberg-marquardt"
    return train_twin(
        training_data.runs,
        held_out.runs if held_out else [],
        settings.model,
        name=name,
        seed=settings.seed,
        trainer=settings.trainer,
        max_iterations=settings.iterations,
        network_inputs=tuple(settings.network_inputs.split(",")),
        physics=settings.physics,
        networks=settings.networks if settings.networks is not None else NETWORKS if can_average else 1,
        each_network=each_network or one_after_another,
        command_unit=settings.command_unit,
        fan_numbers=training_data.fans,
        data=data_cards(training_data),
        validation_data=data_cards(held_out) if held_out else (),
        progress=progress or unreported,
    )


def balance_sentence(result: dict[str, Any]) -> str:
    """One line on the torque balance: its healthy standard deviation, and the source of its coefficients."""
    lowest, highest = (shown(sigma(result["balance_sigma"])) for sigma in (min, max))
    sigmas = lowest if lowest == highest else f"{lowest} to {highest}"
    chosen: list[str] = result["balance_source"]
    sources = ", ".join(f"{chosen.count(source)} fan(s) by {source}" for source in dict.fromkeys(chosen))
    unit = result["command_unit"] or "of the command"
    return f"torque balance: healthy sigma {sigmas} {unit}; coefficients of {sources}"


def as_json(trained: TrainedTwin, training_data: TrainingData, output: Path) -> dict[str, Any]:
    """The result as JSON fields; figures in the recordings' own units."""
    card = trained.card
    return {
        "twin": str(output),
        "model": card.kind,
        **figures_in(trained.validation.pooled, training_data.rad_s_per_unit),
        "evaluated_on": card.validation.source,
        "speed_unit": training_data.speed_unit,
        "sigma": [sigma / training_data.rad_s_per_unit for sigma in card.sigma_rad_s],
        "balance_sigma": list(card.balance.sigma_command),
        "balance_source": list(card.balance.source),
        "command_unit": card.command_unit,
        "allows_for": card.conditions.in_words if card.conditions else "",
        "fans": card.fans,
        "network_parameters": card.network.parameter_count,
        "iterations": card.training.iterations,
        "duration_s": card.training.duration_s,
        "warnings": training_data.with_fan_numbers(trained.identification.warnings),
        "hints": list(training_data.hints),
    }

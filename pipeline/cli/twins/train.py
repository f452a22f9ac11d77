"""`fantwin train`: recordings of healthy fans become a twin, or several side by side."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fantwin.pipeline.cli.in_parallel import JobsOption, RecordingsInParallel, SkipBadOption
from fantwin.pipeline.cli.options import JsonOption, fan_numbers, recorded_names
from fantwin.pipeline.cli.progress import interruptible, training_progress
from fantwin.pipeline.cli.twins.data_options import (
    FansOption,
    FromOption,
    IgnoreOption,
    RecordingsArgument,
    TestOption,
    ToOption,
    TrayOption,
    ValidateOption,
    WindowOption,
    check_writable,
    ignored_columns,
    report_damage,
    show_hints,
)
from fantwin.pipeline.cli.twins.figures import closed_loop_sentence, sentence, shown
from fantwin.pipeline.cli.twins.side_by_side import Data, train_side_by_side
from fantwin.pipeline.errors import UsageError
from fantwin.pipeline.extras import require_torch
from fantwin.pipeline.files import write_whole
from fantwin.pipeline.learning.drops_found import static_words
from fantwin.pipeline.learning.evaluation import figures_in
from fantwin.pipeline.learning.fitting import DEFAULT_SETTINGS, NETWORKS, Trainer, TrainingSettings, fit_twin
from fantwin.pipeline.learning.training_data import (
    Part,
    TrainingData,
    data_cards,
    read_held_out,
    read_training_data,
    twin_errors,
)

if TYPE_CHECKING:
    from fantwin.schemas.reference_conditions import ReferenceConditions
    from fantwin.twin.finishing import TrainedTwin
    from fantwin.twin.kinds import ModelKind
    from fantwin.twin.progress import Progress


def train(
    recordings: RecordingsArgument,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="TWIN.onnx", help="Twin to write; a folder for several models.")
    ],
    model: Annotated[
        str,
        typer.Option(
            help="Kind of model: physical, narx, neural-ode, hybrid, hybrid-w (its network sees no command), static "
            "(of samples too far apart to show the motion). "
            "Several with commas, or all: they are trained side by side."
        ),
    ] = DEFAULT_SETTINGS.model,
    type_twin: Annotated[
        Path | None,
        typer.Option(
            "--type", metavar="TYPE.onnx", help="A hybrid twin of other fans of the type, whose network is kept."
        ),
    ] = None,
    validate: ValidateOption = None,
    test: TestOption = None,
    from_s: FromOption = 0.0,
    to_s: ToOption = math.inf,
    tray: TrayOption = None,
    fans: FansOption = None,
    window_s: WindowOption = None,
    ignore: IgnoreOption = None,
    name: Annotated[str | None, typer.Option(help="Name of the twin. Default: the name of the file.")] = None,
    seed: Annotated[int, typer.Option(help="The same seed and recordings give the same twin.")] = 0,
    trainer: Annotated[
        Trainer, typer.Option(help="adam, the published one, needs PyTorch.")
    ] = DEFAULT_SETTINGS.trainer,
    iterations: Annotated[
        int | None, typer.Option(min=1, help="Maximum iterations of each network. Default: depends on the model.")
    ] = None,
    networks: Annotated[
        int | None,
        typer.Option(
            help="Networks to train and average (hybrid, neural ODE). Default: "
            f"{NETWORKS}, and 1 where they cannot be averaged or several models are compared."
        ),
    ] = None,
    command_unit: Annotated[str, typer.Option(help="Unit of the command, for the card, e.g. %.")] = "",
    jobs: JobsOption = None,
    skip_bad: SkipBadOption = False,
    json_output: JsonOption = False,
) -> None:
    """Train a twin of healthy fans and write it, with its card, as an ONNX file.

    The width of the band is the free-run error over --validate. Without --validate it is the error over the training
    data, which is too optimistic.

    With several models, the best has the smallest free-run error over --test; without it, over --validate.

    With --type, a twin of more fans of a type is made from a few minutes of each, in seconds: what the fans did not
    show of their own physics is taken as typical of the type, and the band is as wide as that requires. A fan that is
    not of the type, or has a fault, is named in a warning.

    Ctrl-C ends training without a twin, with exit code 130.

    Example: fantwin train healthy-1.mcap healthy-2.mcap --validate healthy-3.mcap -o TWIN.onnx

    Example: fantwin train healthy.mcap --validate other.mcap --test third.mcap --model all -o twins

    Example: fantwin train new-tray.mcap --type type.onnx -o new-tray.onnx
    """
    given = TrainingSettings(model, seed, trainer, iterations, networks, command_unit)
    part = Part(
        tray,
        fan_numbers(fans, recorded_names(recordings, tray)),
        from_s,
        to_s,
        tuple(window_s or ()),
        ignored_columns(ignore),
    )
    if type_twin and (given != DEFAULT_SETTINGS or window_s or ignore):
        raise UsageError("--type keeps the network of the type: leave out the options of a model and of its training")
    not_written = "no twin was written; --iterations N ends after N iterations of each network and writes one"
    if trainer == "adam":
        require_torch("--trainer adam")
    pool = RecordingsInParallel(jobs, skip_bad)
    with interruptible("no twin was written" if type_twin else not_written), twin_errors():
        chosen = _chosen(model)
        if len(chosen) > 1:
            data = partial(_read, recordings, validate, test, part, pool)
            if networks is not None or trainer != DEFAULT_SETTINGS.trainer:
                raise UsageError(
                    "--networks and --trainer are for one model: models are compared with one network each, "
                    "trained alike"
                )
            train_side_by_side(chosen, data, output, pool, given, json_output=json_output)
            return
        if test:
            raise UsageError("--test is for several models; `fantwin evaluate` judges one: fantwin evaluate TWIN.onnx")
        if type_twin:
            from fantwin.twin.export.onnx_twin import OnnxTwin  # noqa: PLC0415  loads twin only when it is needed

            OnnxTwin(type_twin)  # what is no twin is said before recordings are read
        check_writable(output, ".onnx")
        training_data, held_out, _ = _read(recordings, validate, None, part, pool)
        if not (json_output or type_twin):
            show_hints(training_data.hints)
        settings = replace(given, model=chosen[0].name)
        named = name or output.stem
        with training_progress(training_data) as start, pool:
            if type_twin:
                trained = _place(type_twin, training_data, held_out, named, start(""))
            else:
                trained = fit_twin(training_data, held_out, named, settings, start(""), pool.each_network)
        write_whole(output, trained.onnx())
    result = as_json(trained, training_data, output) | {"static": static_words(output, training_data.speed_unit)}
    if type_twin:
        result |= {"of_type": trained.card.training.of_type}
    lines = _lines(result, training_data, trained.card.conditions)
    pool.end_with(result, *lines, warnings=result["warnings"], json_output=json_output)


def _read(
    recordings: Sequence[Path],
    validate: Sequence[Path] | None,
    test: Sequence[Path] | None,
    part: Part,
    pool: RecordingsInParallel,
) -> Data:
    """The data of training, of validation and of a test of several models."""
    with pool:
        training_data = read_training_data(recordings, part, pool.map)
        others = [read_held_out(training_data, paths, part, pool.map) if paths else None for paths in (validate, test)]
    for data in filter(None, (training_data, *others)):
        report_damage(data.damage)
    return training_data, others[0], others[1]


def _chosen(names: str) -> list[ModelKind]:
    from fantwin.twin.kinds import KINDS  # noqa: PLC0415  loads twin only when it is needed

    by_name = {kind.name: kind for kind in KINDS}
    of_motion = [name for name, kind in by_name.items() if kind.knows_motion]
    wanted = of_motion if names == "all" else [name.strip() for name in names.split(",")]
    for name in wanted:
        if name not in by_name:
            raise UsageError(f"--model {name}: no such model; known: {', '.join(by_name)}, all")
    return [by_name[name] for name in dict.fromkeys(wanted)]


def _place(
    type_twin: Path, training_data: TrainingData, held_out: TrainingData | None, name: str, progress: Progress
) -> TrainedTwin:
    from fantwin.twin.twin_of_type import place_twin  # noqa: PLC0415  loads twin only when it is needed

    return place_twin(
        type_twin,
        training_data.runs,
        held_out.runs if held_out else [],
        name=name,
        fan_numbers=training_data.fans,
        fan_names=[training_data.names.name(fan) for fan in training_data.fans],
        data=data_cards(training_data),
        validation_data=data_cards(held_out) if held_out else (),
        progress=progress,
    )


def _lines(
    result: dict[str, Any], training_data: TrainingData, conditions: ReferenceConditions | None
) -> Iterator[str]:
    networks = "speed over command" if result["static"] else f"{result['network_parameters']} network parameters"
    of = f"the type of {result['of_type']}" if "of_type" in result else networks
    yield f"{result['twin']}: {result['model']} of {result['fans']} fan(s), {of}"
    yield f"  {result['evaluated_on']} data, {sentence(result, training_data.speed_unit)}"
    yield f"  {result['static'] or balance_sentence(result)}"
    if conditions:
        columns = f"column{'s' * (len(conditions.needed) > 1)} {' and '.join(conditions.needed)}"
        yield f"  allows for {conditions.in_words}, and needs the {columns}"
    if result["closed_loop"]:
        yield f"  {closed_loop_sentence(training_data.names.labels(result['closed_loop']))}"


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
        "closed_loop": training_data.numbers_where(card.closed_loop),
        "hints": list(training_data.hints),
    }

"""`fantwin place`: a twin of more fans of a type, from a few minutes of their running and the twin of other fans."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from fantwin.pipeline.cli.options import JsonOption
from fantwin.pipeline.cli.progress import interruptible, training_progress
from fantwin.pipeline.cli.recordings_in_parallel import JobsOption, RecordingsInParallel, SchedulerOption, SkipBadOption
from fantwin.pipeline.cli.twins.figures import sentence
from fantwin.pipeline.cli.twins.train import as_json, balance_sentence
from fantwin.pipeline.cli.twins.training_data import (
    FansOption,
    FromOption,
    Part,
    RecordingsArgument,
    ToOption,
    TrayOption,
    ValidateFromOption,
    ValidateOption,
    ValidateToOption,
    check_writable,
    data_cards,
    read_held_out,
    read_training_data,
    twin_errors,
)


def place(
    type_twin: Annotated[
        Path, typer.Argument(metavar="TYPE.onnx", help="A hybrid twin of other fans of the same type (fantwin train).")
    ],
    recordings: RecordingsArgument,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="TWIN.onnx", help="Twin to write.")],
    validate: ValidateOption = None,
    from_s: FromOption = 0.0,
    to_s: ToOption = math.inf,
    validate_from_s: ValidateFromOption = 0.0,
    validate_to_s: ValidateToOption = math.inf,
    tray: TrayOption = None,
    fans: FansOption = None,
    name: Annotated[str | None, typer.Option(help="Name of the twin. Default: the name of the file.")] = None,
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
    skip_bad: SkipBadOption = False,
    json_output: JsonOption = False,
) -> None:
    """Make a twin of more fans of a type, from a few minutes of each and the twin of other fans of the type.

    The network stays that of the type, so this takes seconds, and the fans need not be moved over their whole range:
    what they did not show of their own physics is taken as typical of the type. The band is as wide as that requires.

    A fan that is not of the type, or has a fault, is named in a warning.

    Example: fantwin place type.onnx new-tray.mcap --validate new-tray-2.mcap -o new-tray.onnx
    """
    pool = RecordingsInParallel(jobs, scheduler, skip_bad)
    with interruptible("no twin was written"), twin_errors():
        # The command line loads twin only when it is needed.
        from fantwin.twin.export.onnx_twin import OnnxTwin  # noqa: PLC0415
        from fantwin.twin.placing import place_twin  # noqa: PLC0415

        OnnxTwin(type_twin)  # what is no twin is said before recordings are read
        check_writable(output, ".onnx")
        part = Part(tray, fans, from_s, to_s)
        validation_part = replace(part, from_s=validate_from_s, to_s=validate_to_s)
        with pool:
            training_data = read_training_data(recordings, part, pool)
            held_out = read_held_out(training_data, validate, validation_part, pool) if validate else None
        with training_progress(training_data) as start:
            placed = place_twin(
                type_twin,
                training_data.runs,
                held_out.runs if held_out else [],
                name=name or output.stem,
                fan_numbers=training_data.fans,
                data=data_cards(training_data),
                validation_data=data_cards(held_out) if held_out else (),
                progress=start(""),
            )
        placed.save(output)
    result = as_json(placed, training_data, output) | {"of_type": placed.card.training.of_type}
    if json_output:
        typer.echo(json.dumps(result | pool.as_json()))
    else:
        typer.echo(f"{output}: {result['fans']} fan(s) of the type of {result['of_type']}")
        typer.echo(f"  {result['evaluated_on']} data, {sentence(result, training_data.speed_unit)}")
        typer.echo(f"  {balance_sentence(result)}")
        for warning in result["warnings"]:
            typer.echo(warning, err=True)
    pool.end()

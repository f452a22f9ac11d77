"""`fantwin compare`: all models trained on the same recordings, side by side."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from fantwin.pipeline.cli.options import JsonOption, make_folder
from fantwin.pipeline.cli.progress import interruptible, training_progress
from fantwin.pipeline.cli.recordings_in_parallel import JobsOption, RecordingsInParallel, SchedulerOption, SkipBadOption
from fantwin.pipeline.cli.twins.figures import figures_in, shown
from fantwin.pipeline.cli.twins.training_data import (
    FansOption,
    FromOption,
    Part,
    RecordingsArgument,
    ToOption,
    TrainingData,
    TrayOption,
    ValidateFromOption,
    ValidateToOption,
    WindowOption,
    data_cards,
    read_held_out,
    read_training_data,
    twin_errors,
)
from fantwin.pipeline.errors import UsageError, UserError
from fantwin.pipeline.recordings.remote import matching, recording_path

if TYPE_CHECKING:
    from fantwin.twin.comparison import Candidate, Contender, Source

SOURCE_HEADER = {"held-out": "held\nout", "test": "test\nrmse"}
SOURCE_MEANING = {
    "test": "the test recordings, which took no part in training",
    "held-out": "the held-out recordings, which stopped training; --test takes unused ones",
    "training": "the training recordings, which is too optimistic; use --validate and --test",
}


def compare(
    recordings: RecordingsArgument,
    validate: Annotated[
        list[Path] | None,
        typer.Option(
            parser=recording_path,
            callback=matching,
            metavar="REC.mcap",
            help="Held-out healthy recording: stops training, not fitted. Repeatable.",
        ),
    ] = None,
    test: Annotated[
        list[Path] | None,
        typer.Option(
            parser=recording_path,
            callback=matching,
            metavar="REC.mcap",
            help="Healthy recording for the comparison, unused in training. Repeatable.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="FOLDER", help="Write twins and comparison.json here."),
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(help="Only these, separated by commas: physical, narx, neural-ode, hybrid, hybrid-w."),
    ] = None,
    from_s: FromOption = 0.0,
    to_s: ToOption = math.inf,
    validate_from_s: ValidateFromOption = 0.0,
    validate_to_s: ValidateToOption = math.inf,
    test_from_s: Annotated[float, typer.Option("--test-from", help="Like --from, for --test.")] = 0.0,
    test_to_s: Annotated[float, typer.Option("--test-to", help="Like --to, for --test.")] = math.inf,
    tray: TrayOption = None,
    fans: FansOption = None,
    window_s: WindowOption = None,
    seed: Annotated[int, typer.Option(help="The same seed and recordings give the same twins.")] = 0,
    iterations: Annotated[
        int | None, typer.Option(min=1, help="Maximum iterations. Default: depends on the model.")
    ] = None,
    command_unit: Annotated[str, typer.Option(help="Unit of the command, for the cards, e.g. %.")] = "",
    jobs: JobsOption = None,
    scheduler: SchedulerOption = None,
    skip_bad: SkipBadOption = False,
    json_output: JsonOption = False,
) -> None:
    """Train physical, NARX, neural ODE and both hybrids on the same recordings and print them side by side.

    The best model has the smallest free-run error over --test; without --test, over --validate.

    Example: fantwin compare healthy-1.mcap healthy-2.mcap --validate healthy-3.mcap --test healthy-4.mcap -o twins
    """
    not_compared = f"no comparison; the twins that were finished are in {output}" if output else "no comparison"
    pool = RecordingsInParallel(jobs, scheduler, skip_bad)
    with interruptible(not_compared), twin_errors():
        from fantwin.twin.comparison import best, contend, source_of  # noqa: PLC0415  loads twin only when it is needed

        chosen = _chosen(model)
        part = Part(tray, fans, from_s, to_s, tuple(window_s or ()))
        validation_part = replace(part, from_s=validate_from_s, to_s=validate_to_s)
        test_part = replace(part, from_s=test_from_s, to_s=test_to_s)
        with pool:
            training_data = read_training_data(recordings, part, pool)
            held_out = read_held_out(training_data, validate, validation_part, pool) if validate else None
            untouched = read_held_out(training_data, test, test_part, pool) if test else None
        folder = make_folder(output) if output else None
        validation_runs, test_runs = (part.runs if part else [] for part in (held_out, untouched))
        data, validation_data = data_cards(training_data), data_cards(held_out) if held_out else ()
        contenders = []
        with training_progress(training_data) as start:
            for candidate in chosen:
                contender = contend(
                    candidate,
                    training_data.runs,
                    validation_runs,
                    test_runs,
                    seed=seed,
                    max_iterations=iterations,
                    command_unit=command_unit,
                    fan_numbers=training_data.fans,
                    data=data,
                    validation_data=validation_data,
                    progress=start(candidate.title),
                )
                if folder and contender.twin:
                    contender.twin.save(_file(folder, candidate))
                contenders.append(contender)
        winner = best(contenders)
    source = source_of(validation_runs, test_runs)
    result = {
        "speed_unit": training_data.speed_unit,
        "evaluated_on": source,
        "best": winner.candidate.name,
        "models": [as_json(contender, training_data, folder) for contender in contenders],
        "warnings": training_data.with_fan_numbers(winner.twin.identification.warnings if winner.twin else []),
    }
    if folder:
        _write(folder / "comparison.json", json.dumps(result, indent=2) + "\n")
    if json_output:
        typer.echo(json.dumps(result | pool.as_json()))
    else:
        _print(result, folder)
    pool.end()


def _print(result: dict[str, Any], folder: Path | None) -> None:
    source: Source = result["evaluated_on"]
    Console().print(table(result))
    typer.echo(f"* best: smallest free-run rmse over {SOURCE_MEANING[source]}.")
    if floor := next(
        its["figures"][source]["tacho_floor"] for its in result["models"] if its["model"] == result["best"]
    ):
        typer.echo(f"The tacho alone would leave a perfect model an rmse of {shown(floor)} {result['speed_unit']}.")
    if folder:
        typer.echo(f"{folder}: the twins and comparison.json")
    for its in result["models"]:
        if its["invalid_reason"]:
            typer.echo(f"{its['title']}: not trained: {its['invalid_reason']}", err=True)
    for warning in result["warnings"]:
        typer.echo(warning, err=True)


def as_json(contender: Contender, training_data: TrainingData, folder: Path | None) -> dict[str, Any]:
    """The result as JSON fields; figures in the recordings' own units, null where there are none."""
    candidate, twin, each = contender.candidate, contender.twin, training_data.rad_s_per_unit
    result: dict[str, Any] = {
        "model": candidate.name,
        "title": candidate.title,
        "invalid_reason": contender.invalid_reason or None,
    }
    if twin is None:
        return result
    parts = {"training": contender.training, "held-out": contender.held_out, "test": contender.test}
    return result | {
        "physical_parameters": contender.physical_parameters,
        "network_parameters": twin.card.network.parameter_count,
        "training_s": twin.card.training.duration_s,
        "iterations": twin.card.training.iterations,
        "sigma": [sigma / each for sigma in twin.card.sigma_rad_s],
        "training_rmse": contender.training_rmse_rad_s / each,
        "figures": {name: figures_in(part.pooled, each) for name, part in parts.items() if part},
        "twin": str(_file(folder, candidate)) if folder else None,
    }


def table(result: dict[str, Any]) -> Table:
    """The models side by side: all figures over the data that decide the comparison, the rmse over all data."""
    source, unit = result["evaluated_on"], result["speed_unit"]
    sources = [name for name in ("held-out", "test") if any(name in m.get("figures", {}) for m in result["models"])]
    rows = Table(box=box.SIMPLE_HEAD, padding=0, caption=f"rmse and error in {unit}", caption_justify="left")
    rows.add_column("model", no_wrap=True)
    rmse = (SOURCE_HEADER[name] for name in sources)
    for header in ("para-\nmeters", "train\nrmse", *rmse, "max\nerror", "R2", "in\n±2σ", "1-step\nrmse", "train\ns"):
        rows.add_column(header, justify="right", no_wrap=True)
    for its in result["models"]:
        if its["invalid_reason"]:
            rows.add_row(escape(its["title"]), *("-" for _ in rows.columns[1:]))
            continue
        figures, is_best = its["figures"][source], its["model"] == result["best"]
        rows.add_row(
            escape(its["title"] + (" *" if is_best else "")),
            " + ".join(str(its[part]) for part in ("physical_parameters", "network_parameters") if its[part]),
            shown(its["training_rmse"]),
            *(shown(its["figures"][name]["rmse"]) for name in sources),
            shown(figures["max_error"]),
            shown(figures["r2"], ".4f"),
            shown(figures["coverage_2_sigma"], ".1%"),
            shown(figures["one_step_rmse"]),
            f"{its['training_s']:.1f}",
            style="bold" if is_best else "",
        )
    return rows


def _chosen(names: str | None) -> list[Candidate]:
    from fantwin.twin.comparison import all_candidates  # noqa: PLC0415

    by_name = {candidate.name: candidate for candidate in all_candidates()}
    wanted = list(by_name) if names is None else [name.strip() for name in names.split(",")]
    for name in wanted:
        if name not in by_name:
            raise UsageError(f"--model {name}: no such model; known: {', '.join(by_name)}")
    return [by_name[name] for name in dict.fromkeys(wanted)]


def _file(folder: Path, candidate: Candidate) -> Path:
    return folder / f"{candidate.name}.onnx"


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}; name another folder with -o") from error

"""`fantwin compare`: all models trained on the same recordings, side by side."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from pipeline.cli.options import JsonOption
from pipeline.cli.progress import training_progress
from pipeline.cli.twins.figures import figures_in, shown
from pipeline.cli.twins.training_data import (
    FansOption,
    FromOption,
    Material,
    RecordingsArgument,
    ToOption,
    TrayOption,
    data_cards,
    made_folder,
    model_maker,
    read_held_out,
    read_material,
)
from pipeline.errors import UserError

if TYPE_CHECKING:
    from twin.comparison import Candidate, Contender

SOURCE_HEADER = {"held-out": "held\nout", "test": "test\nrmse"}
SOURCE_SAID = {
    "test": "the test recordings, which took no part in training",
    "held-out": "the held-out recordings, which training did not fit but was stopped by: --test gives untouched ones",
    "training": "the training recordings, which flatters: --validate and --test give others",
}


def compare(
    recordings: RecordingsArgument,
    validate: Annotated[
        list[Path] | None,
        typer.Option(metavar="REC.mcap", help="Healthy recording to stop training by and not to fit on. Repeatable."),
    ] = None,
    test: Annotated[
        list[Path] | None,
        typer.Option(metavar="REC.mcap", help="Healthy recording that takes no part in training. Repeatable."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FOLDER", help="Keep the twins and comparison.json here.")
    ] = None,
    model: Annotated[
        str | None,
        typer.Option(help="Only these: physical, narx, neural-ode, hybrid, hybrid-w, with commas between them."),
    ] = None,
    from_s: FromOption = 0.0,
    to_s: ToOption = math.inf,
    validate_from_s: Annotated[float, typer.Option("--validate-from", help="As --from, of --validate.")] = 0.0,
    validate_to_s: Annotated[float, typer.Option("--validate-to", help="As --to, of --validate.")] = math.inf,
    test_from_s: Annotated[float, typer.Option("--test-from", help="As --from, of --test.")] = 0.0,
    test_to_s: Annotated[float, typer.Option("--test-to", help="As --to, of --test.")] = math.inf,
    tray: TrayOption = None,
    fans: FansOption = None,
    seed: Annotated[int, typer.Option(help="The same seed and recordings give the same twins.")] = 0,
    iterations: Annotated[
        int | None, typer.Option(min=1, help="At most, of the start that goes on; without it, as fits the model.")
    ] = None,
    command_unit: Annotated[str, typer.Option(help="For the cards, e.g. %.")] = "",
    json_output: JsonOption = False,
) -> None:
    """Train physical, NARX, neural ODE and both hybrids on the same recordings and print them side by side.

    The best is the one with the smallest free-run error over --test, or else over --validate.

    Example: fantwin compare healthy-1.mcap healthy-2.mcap --validate healthy-3.mcap --test healthy-4.mcap -o twins
    """
    with model_maker():
        from twin.comparison import best, contend, source_of  # noqa: PLC0415  loads twin only when it is needed

        chosen = _chosen(model)
        material = read_material(recordings, tray, fans, from_s, to_s)
        held_out = read_held_out(material, validate, tray, fans, validate_from_s, validate_to_s) if validate else None
        untouched = read_held_out(material, test, tray, fans, test_from_s, test_to_s) if test else None
        folder = made_folder(output) if output else None
        validation_runs, test_runs = (part.runs if part else [] for part in (held_out, untouched))
        data, validation_data = data_cards(material), data_cards(held_out) if held_out else ()
        contenders = []
        with training_progress(material) as start:
            for candidate in chosen:
                contender = contend(
                    candidate,
                    material.runs,
                    validation_runs,
                    test_runs,
                    seed=seed,
                    max_iterations=iterations,
                    command_unit=command_unit,
                    fan_numbers=material.fans,
                    data=data,
                    validation_data=validation_data,
                    progress=start(candidate.title),
                )
                if folder and contender.twin:
                    contender.twin.save(_file(folder, candidate))
                contenders.append(contender)
        winner = best(contenders)
    source = source_of(validation_runs, test_runs)
    told = {
        "speed_unit": material.speed_unit,
        "judged_on": source,
        "best": winner.candidate.name,
        "models": [account(contender, material, folder) for contender in contenders],
        "warnings": material.named(winner.twin.identification.warnings if winner.twin else []),
    }
    if folder:
        _write(folder / "comparison.json", json.dumps(told, indent=2) + "\n")
    if json_output:
        typer.echo(json.dumps(told))
        return
    Console().print(table(told))
    typer.echo(f"* best: smallest free-run rmse over {SOURCE_SAID[source]}.")
    if folder:
        typer.echo(f"{folder}: the twins and comparison.json")
    for its in told["models"]:
        if its["invalid_reason"]:
            typer.echo(f"{its['said']}: not trained: {its['invalid_reason']}", err=True)
    for warning in told["warnings"]:
        typer.echo(warning, err=True)


def account(contender: Contender, material: Material, folder: Path | None) -> dict[str, Any]:
    """What a machine is told of one model; figures in the recordings' own units, null where there are none."""
    candidate, twin, each = contender.candidate, contender.twin, material.rad_s_per_unit
    told: dict[str, Any] = {
        "model": candidate.name,
        "said": candidate.title,
        "invalid_reason": contender.invalid_reason or None,
    }
    if twin is None:
        return told
    parts = {"training": contender.training, "held-out": contender.held_out, "test": contender.test}
    return told | {
        "physical_parameters": contender.physical_parameters,
        "network_parameters": twin.card.network.parameter_count,
        "training_s": twin.card.training.duration_s,
        "iterations": twin.card.training.iterations,
        "sigma": [sigma / each for sigma in twin.card.sigma_rad_s],
        "training_rmse": contender.training_rmse_rad_s / each,
        "figures": {name: figures_in(part.pooled, each) for name, part in parts.items() if part},
        "twin": str(_file(folder, candidate)) if folder else None,
    }


def table(told: dict[str, Any]) -> Table:
    """The models side by side. Only the rmse is given for the data that they are not judged by."""
    source, unit = told["judged_on"], told["speed_unit"]
    sources = [name for name in ("held-out", "test") if any(name in m.get("figures", {}) for m in told["models"])]
    rows = Table(box=box.SIMPLE_HEAD, padding=0, caption=f"rmse and error in {unit}", caption_justify="left")
    rows.add_column("model", no_wrap=True)
    rmse = (SOURCE_HEADER[name] for name in sources)
    for header in ("para-\nmeters", "train\nrmse", *rmse, "max\nerror", "R2", "in\n±2σ", "1-step\nrmse", "train\ns"):
        rows.add_column(header, justify="right", no_wrap=True)
    for its in told["models"]:
        if its["invalid_reason"]:
            rows.add_row(escape(its["said"]), *("-" for _ in rows.columns[1:]))
            continue
        figures, is_best = its["figures"][source], its["model"] == told["best"]
        rows.add_row(
            escape(its["said"] + (" *" if is_best else "")),
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
    from twin.comparison import all_candidates  # noqa: PLC0415

    by_name = {candidate.name: candidate for candidate in all_candidates()}
    wanted = list(by_name) if names is None else [name.strip() for name in names.split(",")]
    for name in wanted:
        if name not in by_name:
            raise UserError(f"--model {name}: no such model; known: {', '.join(by_name)}")
    return [by_name[name] for name in dict.fromkeys(wanted)]


def _file(folder: Path, candidate: Candidate) -> Path:
    return folder / f"{candidate.name}.onnx"


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror}; name another folder with -o") from error

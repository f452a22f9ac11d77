"""`fantwin train` of several models on the same recordings, side by side."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

from rich.markup import escape
from rich.table import Table

from fantwin.pipeline.cli.in_parallel import RecordingsInParallel
from fantwin.pipeline.cli.printing import table_of
from fantwin.pipeline.cli.progress import training_progress
from fantwin.pipeline.cli.twins.figures import closed_loop_sentence, shown
from fantwin.pipeline.errors import UsageError
from fantwin.pipeline.files import make_folder, write_whole
from fantwin.pipeline.learning.evaluation import figures_in
from fantwin.pipeline.learning.fitting import TrainingSettings, fit_twin
from fantwin.pipeline.learning.training_data import TrainingData

if TYPE_CHECKING:
    from fantwin.twin.comparison import Contender
    from fantwin.twin.kinds import ModelKind

Data: TypeAlias = tuple[TrainingData, TrainingData | None, TrainingData | None]
"""of training, of validation and of the test"""
SOURCE_HEADER = {"held-out": "held\nout", "test": "test\nrmse"}
SOURCE_MEANING = {
    "test": "the test recordings, which took no part in training",
    "held-out": "the held-out recordings, which stopped training; --test takes unused ones",
    "training": "the training recordings, which is too optimistic; use --validate and --test",
}


def train_side_by_side(
    chosen: Sequence[ModelKind],
    read: Callable[[], Data],
    folder: Path,
    pool: RecordingsInParallel,
    settings: TrainingSettings,
    *,
    json_output: bool,
) -> None:
    """Train several models on the same recordings, print them side by side, and write the twins and comparison.json.

    settings: of each, but for the kind of model.

    Raises:
        UserError: the recordings cannot be used, or the folder cannot be written.
        typer.Exit: recordings were skipped.
    """
    from fantwin.twin.comparison import best, contend, source_of  # noqa: PLC0415  loads twin only when it is needed

    if folder.suffix == ".onnx":
        raise UsageError(f"{folder}: several models are several twins: name a folder with -o")
    training_data, *others = read()
    make_folder(folder)
    validation_runs, test_runs = (part.runs if part else [] for part in others)
    contenders = []
    with training_progress(training_data) as start:
        for kind in chosen:
            own = replace(settings, model=kind.name, networks=1)
            train = partial(fit_twin, training_data, others[0], kind.title, own, start(kind.title))
            contender = contend(kind, train, training_data.runs, test_runs, training_data.fans)
            if contender.twin:
                write_whole(_file(folder, kind), contender.twin.onnx())
            contenders.append(contender)
    winner = best(contenders)
    source = source_of(validation_runs, test_runs)
    result = {
        "speed_unit": training_data.speed_unit,
        "evaluated_on": source,
        "best": winner.kind.name,
        "models": [as_json(contender, training_data, folder) for contender in contenders],
        "warnings": training_data.with_fan_numbers(winner.twin.identification.warnings if winner.twin else []),
    }
    content = json.dumps(result, indent=2) + "\n"
    write_whole(folder / "comparison.json", content.encode(), "; name another folder with -o")
    lines = [f"* best: smallest free-run rmse over {SOURCE_MEANING[source]}."]
    if floor := next(m["figures"][source]["tacho_floor"] for m in result["models"] if m["model"] == result["best"]):
        lines.append(f"The tacho alone would leave a perfect model an rmse of {shown(floor)} {result['speed_unit']}.")
    if winner.twin and (loops := training_data.numbers_where(winner.twin.card.closed_loop)):
        lines.append(closed_loop_sentence(training_data.names.labels(loops)))
    lines.append(f"{folder}: the twins and comparison.json")
    failed = (f"{m['title']}: not trained: {m['invalid_reason']}" for m in result["models"] if m["invalid_reason"])
    warnings = (*failed, *result["warnings"])
    pool.end_with(result, table(result), *lines, warnings=warnings, json_output=json_output)


def as_json(contender: Contender, training_data: TrainingData, folder: Path) -> dict[str, Any]:
    """The result as JSON fields; figures in the recordings' own units, null where there are none."""
    kind, twin, each = contender.kind, contender.twin, training_data.rad_s_per_unit
    result: dict[str, Any] = {
        "model": kind.name,
        "title": kind.title,
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
        "twin": str(_file(folder, kind)),
    }


def table(result: dict[str, Any]) -> Table:
    """The models side by side: all figures over the data that decide the comparison, the rmse over all data."""
    source, unit = result["evaluated_on"], result["speed_unit"]
    sources = [name for name in ("held-out", "test") if any(name in m.get("figures", {}) for m in result["models"])]
    rmse = (SOURCE_HEADER[name] for name in sources)
    columns = ("para-\nmeters", "train\nrmse", *rmse, "max\nerror", "R2", "in\n±2σ", "1-step\nrmse", "train\ns")
    rows = table_of(["model"], columns, padding=0, caption=f"rmse and error in {unit}")
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


def _file(folder: Path, kind: ModelKind) -> Path:
    return folder / f"{kind.name}.onnx"

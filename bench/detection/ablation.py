"""What each part of the scorer's model is worth: small sets of the bench without it, a row each, in one table.

Every set is calibrated and judged without the part (bench.detection.mechanisms), on the same predictions; the first
row is the decision as it is. Results are kept: what is there is not made again.

Example: python -m bench.detection.ablation --keep /tmp/ablation --without wander --without lags
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import typer

sys.path.insert(0, str(Path(__file__).parents[2]))

from bench.detection.ablation_parts import Part, RackPart, RosaPart, SimulatedPart
from bench.detection.mechanisms import MECHANISMS
from bench.detection.rack_recordings import LEARNING, RackData
from bench.detection.simulated_tables import Sizes
from bench.detection.without import LIST, NOTHING, UnknownMechanismError, list_mechanisms, mechanism, without
from bench.printing import JsonOption, progress, show

SETS = ("simulated", "rack", "rosa")
OVERVIEW = {
    "simulated": ("found", "delay s", "VUS-PR", "false"),
    "rack": ("found", "delay s", "false a fan, day"),
    "rosa": ("found", "delay s", "false", "beside"),
}
NOTES = {
    "simulated": "simulated: found above 1 sigma; median delay of steps from 3 sigma; alarms that no fault explains",
    "rack": "rack: found and median delay; false alarms of fans without a fault; alarms of a fault that was found",
    "rosa": "rosa: found and median delay; false alarms on held-out healthy runs; beside: outside of events",
}


def main(
    keep: Annotated[Path, typer.Option(help="Folder for predictions and rows; what is there is not made again.")],
    without_names: Annotated[
        list[str] | None,
        typer.Option(
            "--without", help="A part to leave out, or `list` for their names; repeatable. Default: all, in turn."
        ),
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(help="simulated, rack or rosa; repeatable. Default: all three.")
    ] = None,
    fans: Annotated[int, typer.Option(help="Simulated fans, in trays of 50.")] = 50,
    runs: Annotated[int, typer.Option(help="Healthy runs.")] = 12,
    calibration_days: Annotated[float, typer.Option(help="Healthy fan-days to calibrate on, simulated.")] = 0.25,
    declared_days: Annotated[float, typer.Option(help="Declared time between false alarms, simulated.")] = 30.0,
    fault_runs: Annotated[int, typer.Option(help="Faults of every simulated fan, each in a run of its own.")] = 4,
    racks: Annotated[int, typer.Option(help="Racks that are judged.")] = 4,
    rack_data: Annotated[
        Path | None, typer.Option(help="The --keep of a bench of racks, to use its recordings; else made in --keep.")
    ] = None,
    rack_count: Annotated[int, typer.Option(help="Racks that were recorded there; 0: as many as are judged.")] = 0,
    report_hz: Annotated[float, typer.Option(help="Reports of the racks a second.")] = 10.0,
    learn: Annotated[str, typer.Option(help=f"What racks learn from: {', '.join(LEARNING)}.")] = "15 minutes",
    test_hours: Annotated[float, typer.Option(help="Length of the test of a rack.")] = 6.0,
    folds: Annotated[int, typer.Option(help="Of the rosa rig, of 8.")] = 2,
    workers: Annotated[int, typer.Option(help="Processes.", min=1, max=2)] = 2,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 1,
    json_output: JsonOption = False,
) -> None:
    """Print one table: a row for each part that was left out."""
    if without_names and LIST in without_names:
        list_mechanisms()
        return
    if unknown := [name for name in only or () if name not in SETS]:
        raise SystemExit(f"--only {unknown[0]!r}: give one of {', '.join(SETS)}")
    if learn not in LEARNING:
        raise SystemExit(f"--learn {learn!r}: give one of {', '.join(LEARNING)}")
    try:
        names = [NOTHING, *(mechanism(name).name for name in without_names or [one.name for one in MECHANISMS])]
    except UnknownMechanismError as error:
        raise SystemExit(str(error)) from error
    sizes = Sizes(fans, declared_days, calibration_days, 0.0, runs, fault_runs, 60.0, seed)
    data = RackData(rack_data or keep, rack_count or racks, report_hz, 3600.0 * test_hours, seed)
    every: dict[str, Part] = {
        "simulated": SimulatedPart(sizes),
        "rack": RackPart(data, learn, racks),
        "rosa": RosaPart(folds),
    }
    parts = {name: every[name] for name in SETS if not only or name in only}
    for part in parts.values():
        folder = keep / part.name
        folder.mkdir(parents=True, exist_ok=True)
        part.prepare(folder, progress)
    _make(keep, parts, names, workers)
    show(_tables(keep, parts, names), _notes(parts), as_json=json_output)


def one_cell(part: Part, folder: Path, name: str) -> dict[str, Any]:
    """The figures of a set without a part of the model, kept in the folder; CPU time beside them."""
    kept = folder / f"without-{name}.json"
    if not kept.exists():
        began_s = time.process_time()
        with without(name):
            figures = part.figures(folder)
        figures["CPU s"] = round(time.process_time() - began_s)
        unfinished = kept.with_suffix(".part")
        unfinished.write_text(json.dumps(figures))
        unfinished.replace(kept)
    found: dict[str, Any] = json.loads(kept.read_text())
    return found


def _make(keep: Path, parts: dict[str, Part], names: Sequence[str], workers: int) -> None:
    """The cells that are not there yet, row by row."""
    with ProcessPoolExecutor(workers, mp_context=get_context("fork")) as pool:
        jobs = {
            pool.submit(one_cell, part, keep / part.name, name): f"{part_name} without {name}"
            for name in names
            for part_name, part in parts.items()
        }
        for number, job in enumerate(as_completed(jobs)):
            progress(f"{number + 1} of {len(jobs)}: {jobs[job]}, {job.result()['CPU s']} CPU s")


def _tables(keep: Path, parts: dict[str, Part], names: Sequence[str]) -> dict[str, list[dict[str, Any]]]:
    """All sets in one table, and the other figures of each."""
    cells = {
        (part_name, name): one_cell(part, keep / part.name, name) for part_name, part in parts.items() for name in names
    }
    overview = [
        {"without": name}
        | {
            f"{part_name}: {column}": cells[part_name, name][column]
            for part_name in parts
            for column in OVERVIEW[part_name]
        }
        for name in names
    ]
    return {"without each part of the model": overview} | {
        part_name: [{"without": name} | _without(cells[part_name, name], OVERVIEW[part_name]) for name in names]
        for part_name in parts
    }


def _without(cells: dict[str, Any], columns: Sequence[str]) -> dict[str, Any]:
    return {column: value for column, value in cells.items() if column not in columns}


def _notes(parts: dict[str, Part]) -> list[str]:
    return [NOTES[name] for name in parts] + [f"{name}: {part.name}" for name, part in parts.items()]


if __name__ == "__main__":
    typer.run(main)

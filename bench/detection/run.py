"""The whole decision beside other ways to decide: false alarms, delays, misses and causes where the truth is known.

Simulated: 200 fans that differ, days that differ, twins learned from data; one false alarm of a fan in 30 days
declared, and all methods calibrated on the same healthy runs; then other healthy days, and five strengths of each kind
of fault, in open loop and under a speed loop. Racks: simulated 4-pin fans with counting tachos under a thermostat; each
rack is learned and judged by the documented commands, beside what its tachos can show at all. Measured: the rosa rig,
by the public commands, twins from healthy runs alone. Every figure is of runs that nothing was learned from.
"""

from __future__ import annotations

import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import typer

sys.path.insert(0, str(Path(__file__).parents[2]))

from bench.detection.measured import measured_tables
from bench.detection.ours import NAME
from bench.detection.rack_recordings import LEARNING, RackData
from bench.detection.rack_tables import RACK_NOTES, rack_tables
from bench.detection.racks import RATES_HZ
from bench.detection.simulated_tables import (
    Sizes,
    cause_rows,
    healthy_rows,
    kind_rows,
    method_rows,
    prepared,
    scored_faults,
)
from bench.detection.without import LIST, UnknownMechanismError, list_mechanisms, mechanism, without
from bench.printing import JsonOption, progress, show
from fantwin.pipeline.errors import UserError
from fantwin.scoring.calibration.calibration import daily_interval


def main(
    only: Annotated[
        str, typer.Option(help="simulated, measured or rack; without it, the first two: racks take hours.")
    ] = "",
    fans: Annotated[int, typer.Option(help="Simulated fans, in trays of 50.")] = 200,
    declared_days: Annotated[float, typer.Option(help="Declared time between false alarms of a fan, in days.")] = 30.0,
    calibration_days: Annotated[float, typer.Option(help="Healthy fan-days to calibrate on.")] = 25.0,
    healthy_days: Annotated[float, typer.Option(help="Other healthy fan-days, to count false alarms in.")] = 50.0,
    runs: Annotated[
        int, typer.Option(help="Number of healthy runs that these fan-days are divided into, each on its own day.")
    ] = 8,
    fault_runs: Annotated[
        int, typer.Option(help="Faults of every fan, each in a run of its own, in which one fan in five has one.")
    ] = 20,
    fault_after_s: Annotated[
        float, typer.Option(help="Faults begin this long after the start of a run, or up to half a minute later.")
    ] = 60.0,
    extrapolate: Annotated[
        bool, typer.Option(help="Calibrate also where the healthy fan-days cannot show the rate.")
    ] = True,
    others: Annotated[
        bool, typer.Option(help="Other methods as well; without, the simulated part is ours alone.")
    ] = True,
    libraries: Annotated[bool, typer.Option(help="PyOD and river as well.")] = True,
    seed: Annotated[int, typer.Option(help="Seed of all random numbers.")] = 1,
    racks: Annotated[int, typer.Option(help="Simulated racks of four fans.")] = 50,
    judged: Annotated[int, typer.Option(help="Number of them that learn and are judged; 0 for all.")] = 0,
    healthy_racks: Annotated[int, typer.Option(help="Number that are judged without faults, too; -1 for all.")] = -1,
    report_hz: Annotated[
        list[float] | None, typer.Option(help="Reports of the racks a second; repeatable. Default: 2, 10 and 100.")
    ] = None,
    learn: Annotated[
        list[str] | None,
        typer.Option(help="15 minutes, one night or three nights; repeatable. Default: the first and the last."),
    ] = None,
    test_hours: Annotated[
        float, typer.Option(help="Length of the test of a rack; a fault lasts a 24th of it, clogging grows in 180 s.")
    ] = 24.0,
    keep: Annotated[
        Path | None, typer.Option(help="Folder for recordings, twins and results of racks; what is there is not made.")
    ] = None,
    workers: Annotated[int, typer.Option(help="Processes that learn and judge racks.")] = 2,
    without_names: Annotated[
        list[str] | None,
        typer.Option(
            "--without", help="Leave a part of the model out of calibration and judging; repeatable; `list`: names."
        ),
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Print the tables of the simulated and of the measured part."""
    left_out = without_names or []
    if LIST in left_out:
        list_mechanisms()
        return
    began_s = time.monotonic()
    tables: dict[str, list[dict[str, Any]]] = {}
    notes: list[str] = []
    with ExitStack() as left:
        try:
            left.enter_context(without(*left_out))
        except UnknownMechanismError as error:
            raise SystemExit(str(error)) from error
        if only == "rack":
            rates, amounts = report_hz or RATES_HZ, learn or ["15 minutes", "three nights"]
            if unknown := [name for name in amounts if name not in LEARNING]:
                raise SystemExit(f"--learn {unknown[0]!r}: give one of {', '.join(LEARNING)}")
            with tempfile.TemporaryDirectory() as folder:
                for rate_hz in rates:
                    data = RackData(keep or Path(folder), racks, rate_hz, 3600.0 * test_hours, seed, tuple(left_out))
                    tables |= rack_tables(data, amounts, judged or racks, healthy_racks, workers, progress)
            notes += RACK_NOTES
        elif only != "measured":
            sizes = Sizes(fans, declared_days, calibration_days, healthy_days, runs, fault_runs, fault_after_s, seed)
            with tempfile.TemporaryDirectory() as folder:
                _simulated(Path(folder), sizes, extrapolate, others, others and libraries, tables, notes)
        if only not in ("simulated", "rack"):
            measured, reported = measured_tables(progress, libraries=libraries)
            tables |= measured
            notes += reported
    notes += [f"without {mechanism(name).what}" for name in left_out]
    notes.append(f"all of it took {(time.monotonic() - began_s) / 60:.1f} min")
    show(tables, notes, as_json=json_output)


def _simulated(
    folder: Path,
    sizes: Sizes,
    extrapolate: bool,
    others: bool,
    libraries: bool,
    tables: dict[str, list[dict[str, Any]]],
    notes: list[str],
) -> None:
    try:
        bench = prepared(folder, sizes, extrapolate=extrapolate, others=others, libraries=libraries, progress=progress)
    except UserError as error:
        raise SystemExit(f"each twin is calibrated on the running of its tray: {error}") from error
    tables["simulated, healthy running of other days"] = healthy_rows(bench, sizes, progress)
    faulty = scored_faults(bench, sizes, progress)
    tables["simulated faults, by method"] = method_rows(faulty, bench)
    tables["simulated faults by kind and strength"] = kind_rows(faulty, NAME)
    tables["causes reported first, command moving"] = cause_rows(faulty, NAME, is_moved=True)
    tables["causes reported first, command held"] = cause_rows(faulty, NAME, is_moved=False)
    found, fan_hours = (sum(getattr(one, name) for one in bench.calibrations) for name in ("found", "fan_hours"))
    low, high = (sizes.declared_days * figure for figure in daily_interval(found, fan_hours))
    factors = ", ".join(f"{one.limit_factor:.3g}" for one in bench.calibrations)
    notes += [
        f"declared: one false alarm of a fan in {sizes.declared_days:g} days; in calibration {found}, which is "
        f"{low:.2g} to {high:.2g} (95 %), in {fan_hours / 24:.3g} fan-days; limits by theory times {factors}"
        + (", a target" if any(one.is_target for one in bench.calibrations) else ""),
    ]
    if not bench.calibration:
        return
    notes += [
        f"all other limits: no more than {bench.calibration.allowed} excursions on the same fan-days; '+-2 sigma, as "
        "published' and 'CUSUM, textbook limit' have their own",
        "PyOD scores one fan in 3, river one in 13; delays: median and quartiles of what was found",
    ]


if __name__ == "__main__":
    typer.run(main)

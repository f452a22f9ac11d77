"""The first month of racks without a twin under `fantwin up`: versions, rates, faults found and false alarms.

The cores of the stages are fed with the lines of the racks, as fast as they go (bench.detection.rack_site). Fans wear;
their filter clogs and is changed; their firmware changes their speeds; and they have faults, which are repaired after
some hours.

    python -m bench.detection.first_month --racks 5 --days 30 --keep FOLDER

All racks are simulated in one process, in minutes, and each is watched in a process of its own. After each of its days
a rack writes what became of it to FOLDER, where a month that was interrupted goes on; `--show` prints the tables of the
days that all racks have had so far. A rack takes some five hours of a core, by what a third of its first day took:
`--only 1,2` watches two of them, and the tables are of the racks whose file `rackN.json` is in FOLDER.
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import chain
from multiprocessing import get_context
from multiprocessing.context import SpawnProcess
from multiprocessing.queues import Queue
from pathlib import Path
from queue import Full
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from bench.detection.plant import START_NS
from bench.detection.rack_days import reports_by_days
from bench.detection.rack_scoring import Episode
from bench.detection.rack_site import DAY_NS, RackMonth, RackSite
from bench.detection.racks import (
    BLOCK,
    DAY_S,
    FAULT_KINDS,
    ON_AFTER_S,
    ON_BEFORE_S,
    RACK_FANS,
    SIZES,
    Racks,
    racks,
    run_of,
)
from fantwin.schemas.messages import Array, Raw
from fantwin.schemas.units import NS_PER_S
from fantwin.simulation.faults import Fault

QUEUED_BLOCKS = 2000
"""that wait for a rack at most: of twenty fans, 0.3 GB"""
LOOK_S = 10.0
"""how often to look whether a rack that takes no more blocks is still alive"""
FAULTS_PER_WEEK = 2.0
"""of all racks together"""
REPAIRED_AFTER_S = 8 * 3600.0
FIRST_FAULT_DAY = 2.0
FILTER_PER_DAY, FILTER_CHANGED = 0.001, 0.4
"""share of the speed of all fans that a clogging filter takes a day, until it is changed: share of the time"""
WEAR_PER_DAY = 0.001
"""the same of each eighth fan"""
FIRMWARE, FIRMWARE_FACTOR = 2.0 / 3.0, 1.04
"""from that share of the time on, all fans turn faster by this factor"""
AFTER_FAULT_S = 1800.0
"""an alarm that begins so soon after a fault of its fan belongs to it"""


def ageing(columns: int, days: float) -> Any:
    """The slow changes of the fans; see racks.Ageing."""
    wears = (np.arange(columns) % (2 * RACK_FANS)) == 0

    def factor(t_s: float) -> Array:
        day = t_s / DAY_S
        filter_days = day if day < FILTER_CHANGED * days else day - FILTER_CHANGED * days
        all_fans = (1.0 - FILTER_PER_DAY * filter_days) * (FIRMWARE_FACTOR if day >= FIRMWARE * days else 1.0)
        return all_fans * np.where(wears, 1.0 - WEAR_PER_DAY * day, 1.0)

    return factor


def month_faults(of: Racks) -> list[Fault]:
    """Kinds in turn, on random fans at random times; each begins while its fan is on, and no two overlap."""
    rng = np.random.default_rng([of.seed, 5])
    days = of.seconds / DAY_S
    count = round(FAULTS_PER_WEEK * max(0.0, days - FIRST_FAULT_DAY) / 7.0)
    starts_d = np.linspace(FIRST_FAULT_DAY, days - 0.5, count + 1)[:-1] if count else []
    found = []
    for number, start_d in enumerate(starts_d):
        column = int(rng.integers(of.columns))
        candidates_s = (start_d + rng.uniform(0.0, 0.5)) * DAY_S + np.arange(0.0, 7200.0)
        around_s = np.arange(-ON_BEFORE_S, ON_AFTER_S, 1.0)
        on = of.thermostat.is_on(candidates_s[:, np.newaxis] + around_s, column).all(axis=1)
        start_s = float(rng.choice(candidates_s[on]))
        kind = list(FAULT_KINDS)[number % len(FAULT_KINDS)]
        found.append(Fault(kind, column, start_s, start_s + REPAIRED_AFTER_S, SIZES.get(kind)))
    return found


def run(of: Racks, watched: Sequence[int], rate_hz: float, noted: int, folder: Path, console: Console) -> None:
    """Let the racks live; what becomes of those that are watched is in files of the folder. noted: of the changes that
    operators make, these first ones are commissioned."""
    days = of.seconds / DAY_S
    of_racks: dict[int, tuple[Queue[Raw | None], SpawnProcess]] = {}
    context = get_context("spawn")
    for rack in watched:
        queue: Queue[Raw | None] = context.Queue(QUEUED_BLOCKS)
        given = folder, run_of(rack), (FILTER_CHANGED * days, FIRMWARE * days)[:noted], queue
        process = context.Process(target=_live, args=given, name=run_of(rack), daemon=True)
        process.start()
        of_racks[rack] = queue, process
    began_s, shown_day = time.monotonic(), -1
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("simulating all days", total=1.0)
        months = reports_by_days(
            of,
            rate_hz,
            month_faults(of),
            ageing(of.columns, days),
            lambda share: progress.update(task, completed=share),
        )
        first = next(months)
    console.print(f"all days are simulated, {time.monotonic() - began_s:.0f} s")
    for number, blocks in enumerate(chain([first], months)):
        for rack, (queue, process) in of_racks.items():
            _put(queue, process, blocks[rack])
        day = int(number * BLOCK / rate_hz / DAY_S)
        if day > shown_day:
            shown_day = day
            console.print(f"lines up to day {day} are out, {time.monotonic() - began_s:.0f} s")
    for queue, process in of_racks.values():
        _put(queue, process, None)
        process.join()
        if process.exitcode:
            raise SystemExit(f"{process.name} ended with status {process.exitcode}: see above")
    console.print(f"{time.monotonic() - began_s:.0f} s")


def _put(queue: Queue[Raw | None], process: SpawnProcess, raw: Raw | None) -> None:
    while True:
        try:
            queue.put(raw, timeout=LOOK_S)
            return
        except Full:
            if not process.is_alive():
                raise SystemExit(f"{process.name} ended with status {process.exitcode}: see above") from None


def _live(folder: Path, name: str, changed_days: Sequence[float], blocks: Queue[Raw | None]) -> None:
    """One rack, in a process of its own."""
    RackSite(folder, name, changed_days).live(iter(blocks.get, None), folder)


def found(of: Racks, folder: Path) -> dict[str, Any]:
    """What became of the racks that have a file in the folder, in the days that each of them has had.

    Raises:
        SystemExit: there is no such file.
    """
    files = {rack: folder / f"{run_of(rack)}.json" for rack in range(of.count)}
    months = {rack: RackMonth.read(file) for rack, file in files.items() if file.exists()}
    if not months:
        raise SystemExit(f"{folder}: no rack has had a day yet")
    days = min(month.days for month in months.values())
    until_ns = START_NS + days * DAY_NS
    alarms = {rack: [each for each in month.alarms if each.raised_ns < until_ns] for rack, month in months.items()}
    faults = [fault for fault in month_faults(of) if fault.start_s < days * DAY_S and fault.fan // RACK_FANS in months]
    caught = [_caught(fault, alarms) for fault in faults]
    own = {id(alarm) for each in caught for alarm in each}
    by_day: list[dict[str, Any]] = []
    for day in range(days):
        first_ns, last_ns = START_NS + day * DAY_NS, START_NS + (day + 1) * DAY_NS
        raised = [each for of_rack in alarms.values() for each in of_rack if first_ns <= each.raised_ns < last_ns]
        by_day.append(
            {
                "day": day,
                "fan_days_judged": sum(month.judged_fan_days.get(day, 0.0) for month in months.values()),
                "promised": Counter(_promise(month, day) for month in months.values()),
                "in_force": [month.in_force[day] for month in months.values()],
                "false_alarms": sum(id(each) not in own for each in raised),
                "alarms": len(raised),
            }
        )
    return {
        "by_day": by_day,
        "faults": [
            {
                "kind": fault.kind,
                "rack": fault.fan // RACK_FANS,
                "fan": fault.fan % RACK_FANS,
                "day": fault.start_s / DAY_S,
                "found_after_s": (own_alarms[0].raised_ns - START_NS) / NS_PER_S - fault.start_s
                if own_alarms
                else None,
                "alarms": len(own_alarms),
            }
            for fault, own_alarms in zip(faults, caught, strict=True)
        ],
        "versions": [[version.model_dump() for version in month.versions] for month in months.values()],
        "learned_from_faults": sum(_is_learned(fault, months[fault.fan // RACK_FANS]) for fault in faults),
        "false": [
            {"rack": rack, "day": (each.raised_ns - START_NS) / DAY_NS, **vars(each)}
            for rack, of_rack in alarms.items()
            for each in of_rack
            if id(each) not in own
        ],
        "learning_s": [month.learning_s for month in months.values()],
        "problems": [month.problems for month in months.values()],
    }


def _promise(month: RackMonth, day: int) -> str:
    version = next((each for each in month.versions if each.name == month.in_force[day]), None)
    return "none" if version is None else "target" if version.is_target else "declared"


def _caught(fault: Fault, of_racks: Mapping[int, list[Episode]]) -> list[Episode]:
    first_ns = START_NS + round(fault.start_s * NS_PER_S)
    last_ns = START_NS + round((fault.stop_s + AFTER_FAULT_S) * NS_PER_S)
    rack, fan = divmod(fault.fan, RACK_FANS)
    return [each for each in of_racks[rack] if each.fan == fan and first_ns <= each.raised_ns < last_ns]


def _is_learned(fault: Fault, month: RackMonth) -> bool:
    """Whether a version that took over was learned from more than a minute of a fault."""
    first_ns = START_NS + round((fault.start_s + 60.0) * NS_PER_S)
    last_ns = START_NS + round(fault.stop_s * NS_PER_S)
    taken = [version for version in month.versions if version.outcome == "taken"]
    return any(since < last_ns and until > first_ns for version in taken for since, until in version.learned_spans)


def tables(figures: dict[str, Any], console: Console) -> None:
    """Print what was found."""
    table = Table("day", "fan-days judged", "promise: none, target, declared", "false alarms", "all alarms", box=None)
    for row in figures["by_day"]:
        promised = ", ".join(str(row["promised"].get(word, 0)) for word in ("none", "target", "declared"))
        table.add_row(
            str(row["day"]), f"{row['fan_days_judged']:.2f}", promised, str(row["false_alarms"]), str(row["alarms"])
        )
    console.print(table)
    faults = Table("fault", "rack, fan", "day", "found after", "alarms", box=None)
    for each in figures["faults"]:
        after = each["found_after_s"]
        faults.add_row(
            each["kind"],
            f"{each['rack'] + 1}, {each['fan']}",
            f"{each['day']:.1f}",
            "not found" if after is None else f"{after:.1f} s",
            str(each["alarms"]),
        )
    console.print(faults)
    outcomes = Counter(f"{v['how']}, {v['outcome']}" for versions in figures["versions"] for v in versions)
    console.print(
        f"versions: {dict(outcomes)}; faults that a version was learned from: {figures['learned_from_faults']}"
    )
    took = [each for site in figures["learning_s"] for each in site]
    if took:
        console.print(f"learning: {len(took)} times, {sum(took):.0f} s of one core, the longest {max(took):.0f} s")


def _numbers(text: str) -> list[int]:
    """Racks by number, counted from 0."""
    return [int(word) - 1 for word in text.split(",")]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--racks", type=int, default=5)
    parser.add_argument("--days", type=int, default=30)
    parser.add_argument("--seed", type=int, default=50)
    parser.add_argument("--report-hz", type=float, default=2.0)
    parser.add_argument("--keep", type=Path, required=True, help="folder for what is learned and the figures")
    parser.add_argument("--only", type=_numbers, help="the racks to watch, from 1; default: all")
    parser.add_argument(
        "--noted", type=int, choices=(0, 1, 2), default=2, help="1: operators commission fans after the filter only"
    )
    parser.add_argument("--show", action="store_true", help="only print the tables of what is in FOLDER")
    given = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the processes of the racks end with this one
    console = Console(soft_wrap=True, highlight=False)
    given.keep.mkdir(parents=True, exist_ok=True)
    of = racks(given.racks, given.days * DAY_S, given.seed, fans_seed=given.seed)
    if not given.show:
        run(of, given.only or range(given.racks), given.report_hz, given.noted, given.keep, console)
    figures = found(of, given.keep)
    (given.keep / "found.json").write_text(json.dumps(figures, indent=1))
    tables(figures, console)


if __name__ == "__main__":
    main()

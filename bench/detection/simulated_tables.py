"""The simulated part of the bench: healthy running for long, then faults, scored by all methods; as rows of tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.detection.campaigns import Healthy, Watch, calibrate, everyday, predictions, watched
from bench.detection.competitors import plain_methods
from bench.detection.faulty import FAULTY_ONE_IN, Campaign, Cell, campaign
from bench.detection.libraries import library_methods
from bench.detection.methods import Calibration, Method
from bench.detection.metrics import (
    Outcome,
    RaisedAlarm,
    confusion,
    false_alarms,
    outcomes,
    rate,
    share,
    vus_pr,
)
from bench.detection.ours import NAME, HealthyBins, Scorer
from bench.detection.plant import RATE_HZ
from bench.detection.severities import KINDS
from bench.detection.simulated import Fleet, stage, trained_fleet, tray_number
from fantwin.schemas.messages import Prediction
from fantwin.scoring.calibration.calibration import Calibration as TwinCalibration

FITTING_S = 300.0
LONGEST_BUFFER_S = 2.0
BUFFERS = 11
VUS_EVENTS = 600
Progress = Callable[[str], None]
Rows = list[dict[str, Any]]


@dataclass(frozen=True)
class Sizes:
    """How much is simulated. Days are those of fans; declared_days: between two false alarms of a fan."""

    fans: int
    declared_days: float
    calibration_days: float
    healthy_days: float
    runs: int
    fault_runs: int
    fault_after_s: float
    seed: int

    def seconds(self, fan_days: float) -> float:
        """Length of each run."""
        return fan_days * 86_400.0 / self.fans / self.runs


@dataclass
class Bench:
    """All methods compared, calibrated."""

    fleet: Fleet
    methods: list[Method]
    calibrated: list[Path]
    calibrations: list[TwinCalibration]
    """calibrations of these twins"""
    calibration: Calibration | None
    """of the other methods, if there are any"""

    def watches(self, *, keep_scores: bool) -> dict[str, Watch]:
        """A new watch for each, ours first."""
        ours = Watch(self._scorer, keep_scores=keep_scores)
        others = {
            method.name: Watch(lambda _run, fans, m=method: m.detector(fans), keep_scores=keep_scores)
            for method in self.methods
        }
        return {NAME: ours, **others}

    def every(self, name: str) -> int:
        """The method scores one fan in this many."""
        return next((method.every for method in self.methods if method.name == name), 1)

    def _scorer(self, run: str, _fans: int) -> Scorer:
        return Scorer(stage("scorer", self.calibrated[tray_number(run)]))


def prepared(
    folder: Path, sizes: Sizes, *, extrapolate: bool, others: bool, libraries: bool, progress: Progress
) -> Bench:
    """Train the twins, fit and calibrate all methods on the same healthy runs.

    Raises:
        UserError: the healthy running is too short for a declared rate this low.
    """
    fleet = trained_fleet(folder, sizes.fans, sizes.seed, progress)
    per_hour = 1.0 / (24.0 * sizes.declared_days)
    methods = plain_methods(RATE_HZ, per_hour) if others else []
    if libraries:
        progress("fitting the libraries")
        methods += library_methods(RATE_HZ, _fitting(fleet, sizes.seed + 1000, progress), few_fans=True)
    kept = kept_bins(folder, fleet)
    seconds = sizes.seconds(sizes.calibration_days)
    progress(f"calibration: {sizes.calibration_days:g} fan-days in {sizes.runs} runs of {seconds / 60:.0f} min")
    stream = predictions(fleet, everyday(fleet, sizes.runs, sizes.seed + 2000), seconds, progress)
    calibration = calibrate(methods, _keeping(kept, stream), per_hour)
    progress("calibrating the twins")
    twins = [folder / f"calibrated-{twin.name}" for twin in fleet.twins]
    calibrations = [
        healthy.calibrate(1.0 / sizes.declared_days, twin, extrapolate=extrapolate)
        for healthy, twin in zip(kept, twins, strict=True)
    ]
    return Bench(fleet, methods, twins, calibrations, calibration)


def kept_bins(folder: Path, fleet: Fleet) -> list[HealthyBins]:
    """Folder in which the healthy runs of each tray are kept."""
    return [HealthyBins(folder / f"healthy-{twin.stem}", twin) for twin in fleet.twins]


def _fitting(fleet: Fleet, seed: int, progress: Progress) -> list[list[Prediction]]:
    runs: dict[str, list[Prediction]] = {}
    for run, block in predictions(fleet, everyday(fleet, 1, seed), FITTING_S, progress):
        runs.setdefault(run, []).append(block)
    return list(runs.values())


def _keeping(kept: Sequence[HealthyBins], stream: Iterator[tuple[str, Prediction]]) -> Iterator[tuple[str, Prediction]]:
    for run, block in stream:
        kept[tray_number(run)].take(run, block)
        yield run, block


def healthy_rows(bench: Bench, sizes: Sizes, progress: Progress) -> Rows:
    """False alarms in healthy running of other days."""
    seconds = sizes.seconds(sizes.healthy_days)
    progress(f"healthy running: {sizes.healthy_days:g} fan-days in {sizes.runs} runs of {seconds / 60:.0f} min")
    plant = everyday(bench.fleet, sizes.runs, sizes.seed + 3000)
    watches = watched(bench.watches(keep_scores=False), predictions(bench.fleet, plant, seconds, progress))
    return [_healthy_row(name, watch.healthy(), sizes.declared_days) for name, watch in watches.items()]


def _healthy_row(name: str, healthy: Healthy, declared_days: float) -> dict[str, Any]:
    periods = healthy.fan_hours / 24.0 / declared_days
    return {
        "method": name,
        "false alarms": len(healthy.alarms),
        "fan-days": healthy.fan_hours / 24.0,
        "an hour": len(healthy.alarms) / healthy.fan_hours,
        f"a fan in {declared_days:g} days (95 %)": str(rate(len(healthy.alarms), periods)),
        "share of time in alarm": healthy.in_alarm_hours / healthy.fan_hours,
    }


@dataclass(frozen=True)
class Faulty:
    """A campaign of faults, scored."""

    shown: Campaign
    watches: dict[str, Watch]

    def outcomes(self, name: str, every: int = 1) -> list[tuple[Cell, Outcome]]:
        """The outcomes of the events of fans that the method scores."""
        pairs = [
            (cell, event)
            for cell, event in zip(self.shown.cells, self.shown.events, strict=True)
            if event.fan % every == 0
        ]
        found = outcomes((event for _, event in pairs), self.watches[name].alarms)
        return [(cell, outcome) for (cell, _), outcome in zip(pairs, found, strict=True)]

    def false_alarms(self, name: str) -> list[RaisedAlarm]:
        """Alarms that no fault explains."""
        return false_alarms(self.watches[name].alarms, self.shown.events)

    def volume(self, name: str, every: int) -> float:
        """VUS-PR, the mean over faulty fans, each in its own run."""
        events = [event for event in self.shown.events if event.fan % every == 0]
        volumes = []
        for event in events[:: max(1, len(events) // VUS_EVENTS)]:
            t_ns = self.watches[name].times_ns(event.run)
            score = self.watches[name].scores(event.run)[:, event.fan]
            longest = LONGEST_BUFFER_S * 1e9 / float(t_ns[1] - t_ns[0])
            buffers = np.linspace(0, longest, BUFFERS).astype(int).tolist()
            volumes.append(vus_pr((t_ns >= event.start_ns) & (t_ns <= event.end_ns), score, buffers))
        return float(np.mean(volumes))


def scored_faults(bench: Bench, sizes: Sizes, progress: Progress) -> Faulty:
    """Score faulty runs by all methods."""
    shown = campaign(bench.fleet, sizes.fault_runs, sizes.fault_after_s, sizes.seed + 4000)
    progress(f"faults: {len(shown.events)} in {FAULTY_ONE_IN * sizes.fault_runs} runs of {shown.seconds:.0f} s")
    stream = predictions(bench.fleet, shown.plant, shown.seconds, progress)
    return Faulty(shown, watched(bench.watches(keep_scores=True), stream))


def method_rows(faulty: Faulty, bench: Bench) -> Rows:
    """All methods beside one another."""
    rows = []
    for name in faulty.watches:
        every = bench.every(name)
        pairs = faulty.outcomes(name, every)
        above = [one for cell, one in pairs if not cell.kind.sizes and cell.strength > 1.0]
        at_one = [one for cell, one in pairs if not cell.kind.sizes and cell.strength == 1.0]
        steps = [one.delay_s for cell, one in pairs if is_large_step(cell) and one.is_found]
        rows.append(
            {
                "method": name,
                "faults": len(pairs),
                "found above 1 sigma (95 %)": str(share(sum(one.is_found for one in above), len(above))),
                "at 1 sigma": np.mean([one.is_found for one in at_one]).item(),
                "delay of steps from 3 sigma, s": quartiles(steps),
                "false": len(faulty.false_alarms(name)),
                "VUS-PR": faulty.volume(name, every),
            }
        )
    return rows


def is_large_step(cell: Cell) -> bool:
    """A step of three sigma or more."""
    return cell.kind.is_step and not cell.kind.sizes and cell.strength >= 3.0


def quartiles(delays_s: Sequence[float]) -> str:
    """Median, and the quartiles."""
    if not delays_s:
        return "-"
    low, middle, high = np.quantile(delays_s, (0.25, 0.5, 0.75))
    return f"{middle:.2f} ({low:.2f} .. {high:.2f})"


def kind_rows(faulty: Faulty, name: str) -> Rows:
    """The results of a method for each kind and strength."""
    pairs = faulty.outcomes(name)
    rows = []
    for kind in KINDS:
        for strength in sorted({cell.strength for cell, _ in pairs if cell.kind == kind}):
            row: dict[str, Any] = {
                "fault": kind.name,
                "effect": f"{strength:g}" + (" (size)" if kind.sizes else " sigma"),
            }
            for loop, is_looped in (("open", False), ("loop", True)):
                of = [
                    one
                    for cell, one in pairs
                    if cell.kind == kind and cell.strength == strength and cell.is_looped == is_looped
                ]
                hits = [one.delay_s for one in of if one.is_found]
                row[f"{loop}: found"] = f"{len(hits)} of {len(of)}"
                row[f"{loop}: delay s"] = quartiles(hits)
            rows.append(row)
    return rows


def cause_rows(faulty: Faulty, name: str, *, is_moved: bool) -> Rows:
    """The confusion matrix of faults above 1 sigma (and of those with sizes of their own) that a method has found."""
    pairs = faulty.outcomes(name)
    chosen = [one for cell, one in pairs if cell.is_moved == is_moved and (cell.kind.sizes or cell.strength > 1.0)]
    table = confusion(chosen)
    reported = sorted({cause for row in table.values() for cause in row})
    return [
        {
            "true cause": cause,
            **{one.replace("_", " "): row[one] for one in reported},
            "right (95 %)": str(share(row[cause], row.total())),
        }
        for cause, row in sorted(table.items())
    ]

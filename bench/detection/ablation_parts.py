"""The small sets that parts of the model are judged on: what they need once, and the figures of one row.

`prepare` writes twins and predictions, which no part of the scorer changes, into a folder; `figures` calibrates and
judges them with what is left of the model at that time.
"""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from bench.detection.campaigns import Watch, everyday, predictions, watched
from bench.detection.faulty import FAULTY_ONE_IN, Campaign, campaign
from bench.detection.judging import (
    calibrate_twin,
    judged,
    keep_predictions,
    read_predictions,
    scorer_of,
    write_predictions,
)
from bench.detection.measured import (
    ALARMS_PER_HOUR,
    FOLDER,
    Measured,
    Scored,
    Tally,
    add_scored,
    folds,
    imported,
    train_twin,
)
from bench.detection.metrics import RaisedAlarm, rate
from bench.detection.ours import NAME, HealthyBins, Scorer
from bench.detection.rack_campaign import RackResult
from bench.detection.rack_limits import Facts
from bench.detection.rack_recordings import FAULTY, RackData
from bench.detection.rack_scoring import DECLARED_PER_DAY, Judged, trained
from bench.detection.rack_tables import beside, found_faults, hours_in_faults
from bench.detection.racks import FAULT_KINDS, events, run_of
from bench.detection.simulated import FANS_SEED, Fleet, stage, trained_fleet, tray_number
from bench.detection.simulated_tables import Faulty, Sizes, is_large_step, kept_bins
from fantwin.schemas.messages import Prediction
from fantwin.simulation.plant import tray_of_fans

Progress = Callable[[str], None]
NO_FACTS = Facts(float("nan"), float("nan"))


class Part(Protocol):
    """One set of data."""

    @property
    def name(self) -> str:
        """Of its folder: other sizes have another name."""
        ...

    def prepare(self, folder: Path, progress: Progress) -> None:
        """Write what all rows need; what is there is not made again."""
        ...

    def figures(self, folder: Path) -> dict[str, Any]:
        """The cells of a row."""
        ...


@dataclass(frozen=True)
class SimulatedPart:
    """The fleet of `--only simulated`, smaller."""

    sizes: Sizes

    @property
    def name(self) -> str:
        """See Part."""
        of = self.sizes
        faults = f"{of.fault_runs}x{FAULTY_ONE_IN}"
        return f"simulated-{of.fans}-{of.runs}-{of.calibration_days:g}-{of.declared_days:g}-{faults}-{of.seed}"

    def prepare(self, folder: Path, progress: Progress) -> None:
        """See Part."""
        index = folder / "healthy.pickle"
        if index.exists():
            return
        sizes = self.sizes
        fleet = trained_fleet(folder, sizes.fans, sizes.seed, progress)
        faulty: dict[str, list[Prediction]] = {}
        shown = self._campaign(fleet)
        progress(f"faults: {len(shown.events)} in {FAULTY_ONE_IN * sizes.fault_runs} runs of {shown.seconds:.0f} s")
        for run, block in predictions(fleet, shown.plant, shown.seconds, progress):
            faulty.setdefault(run, []).append(block)
        for run, blocks in faulty.items():
            write_predictions(blocks, _of_run(folder, run))
        healthy = kept_bins(folder, fleet)
        seconds = sizes.seconds(sizes.calibration_days)
        progress(f"healthy running: {sizes.calibration_days:g} fan-days in {sizes.runs} runs of {seconds / 60:.0f} min")
        plant = everyday(fleet, sizes.runs, sizes.seed + 2000)
        for run, block in predictions(fleet, plant, seconds, progress):
            healthy[tray_number(run)].take(run, block)
        for of_tray in healthy:
            of_tray.finish()
        index.write_bytes(pickle.dumps(healthy))

    def figures(self, folder: Path) -> dict[str, Any]:
        """See Part."""
        sizes = self.sizes
        healthy: list[HealthyBins] = pickle.loads((folder / "healthy.pickle").read_bytes())
        fleet = self._fleet(folder)
        shown = self._campaign(fleet)
        with tempfile.TemporaryDirectory() as made:
            twins = [Path(made) / twin.name for twin in fleet.twins]
            for of_tray, twin in zip(healthy, twins, strict=True):
                of_tray.calibrate(1.0 / sizes.declared_days, twin, extrapolate=True)
            watch = Watch(lambda run, _: Scorer(stage("scorer", twins[tray_number(run)])), keep_scores=True)
            watched({NAME: watch}, self._faulty(folder, shown))
        found = Faulty(shown, {NAME: watch})
        pairs = found.outcomes(NAME)
        above = [one for cell, one in pairs if not cell.kind.sizes and cell.strength > 1.0]
        steps = [one.delay_s for cell, one in pairs if is_large_step(cell) and one.is_found]
        return {
            "found": f"{sum(one.is_found for one in above)} of {len(above)}",
            "delay s": _median(steps),
            "VUS-PR": found.volume(NAME, 1),
            "false": len(found.false_alarms(NAME)),
        }

    def _fleet(self, folder: Path) -> Fleet:
        twins = sorted(folder.glob("tray*.onnx"), key=lambda path: int(path.stem.removeprefix("tray")))
        return Fleet(tray_of_fans(self.sizes.fans, FANS_SEED), tuple(twins))

    def _campaign(self, fleet: Fleet) -> Campaign:
        sizes = self.sizes
        return campaign(fleet, sizes.fault_runs, sizes.fault_after_s, sizes.seed + 4000)

    @staticmethod
    def _faulty(folder: Path, shown: Campaign) -> Iterator[tuple[str, Prediction]]:
        for run in dict.fromkeys(event.run for event in shown.events):
            for block in read_predictions(_of_run(folder, run)):
                yield run, block


@dataclass(frozen=True)
class RackPart:
    """Racks of `--only rack`: their tests with faults, whose other time counts false alarms."""

    data: RackData
    learning: str
    racks: int

    @property
    def name(self) -> str:
        """See Part."""
        data = self.data
        which = f"{data.count}-{data.seed}-{data.rate_hz:g}Hz-{data.test_s:g}s"
        return f"racks-{self.racks}-of-{which}-{self.learning.replace(' ', '-')}"

    def prepare(self, folder: Path, progress: Progress) -> None:
        """See Part."""
        data = self.data
        data.make(list(dict.fromkeys(("15 minutes", self.learning))), progress)
        for rack in range(self.racks):
            progress(f"rack {rack + 1} of {self.racks}")
            place = folder / run_of(rack)
            place.mkdir(exist_ok=True)
            twin = place / "twin.onnx"
            if not twin.exists():
                trained(data, rack, twin)
            for recording in (*data.learning(self.learning, rack), data.test(FAULTY, rack)):
                keep_predictions(recording, twin, place / f"{recording.stem}.pickle")

    def figures(self, folder: Path) -> dict[str, Any]:
        """See Part."""
        truth, false, hours = events(self.data.faults()), 0, 0.0
        delays: dict[str, list[float]] = {kind: [] for kind in FAULT_KINDS}
        alarms = right = 0
        for rack in range(self.racks):
            of_rack = [one for one in truth if one.run == run_of(rack)]
            made = self._judged(folder / run_of(rack), rack)
            false += beside(made, "", NAME, of_rack)[0]
            hours += made.fan_hours - hours_in_faults(of_rack)
            result = RackResult(rack, self.learning, made, None)
            for one in found_faults(result, of_rack, [NO_FACTS] * len(of_rack)):
                delays[one.event.kind].append(one.delay_s)
                alarms += one.alarms
                right += one.alarms > 0 and one.last_cause == one.event.cause
        found = [delay for of in delays.values() for delay in of if np.isfinite(delay)]
        return {
            "found": f"{len(found)} of {sum(map(len, delays.values()))}",
            "delay s": _median(found),
            "false a fan, day": f"{false}: {rate(false, hours / 24.0).value:.2g}",
            **{kind: _found(of) for kind, of in delays.items()},
            "alarms": round(alarms / max(len(found), 1), 1),
            "cause": f"{right}/{len(found)}",
        }

    def _judged(self, place: Path, rack: int) -> Judged:
        twin, test = place / "twin.onnx", self.data.test(FAULTY, rack)
        kept = [place / f"{path.stem}.pickle" for path in self.data.learning(self.learning, rack)]
        with tempfile.TemporaryDirectory() as made:
            limited = Path(made) / "twin.onnx"
            extrapolate = self.learning != "three nights"
            calibrate_twin(twin, limited, kept, DECLARED_PER_DAY, extrapolate=extrapolate)
            found = judged(scorer_of(test, limited), read_predictions(place / f"{test.stem}.pickle"))
        return Judged(fan_hours=found.fan_hours, ours=found.alarms)


@dataclass(frozen=True)
class RosaPart:
    """The rosa rig of `--only measured`, so many of its folds."""

    folds: int

    @property
    def name(self) -> str:
        """See Part."""
        return f"rosa-{self.folds}"

    def prepare(self, folder: Path, progress: Progress) -> None:
        """See Part."""
        index = folder / "runs.pickle"
        if not FOLDER.is_dir():
            raise SystemExit(f"{FOLDER}: not there; set FANTWIN_DATA (docs/how-to/datasets.md), or leave rosa out")
        if not index.exists():
            progress("rosa: importing")
            index.write_bytes(pickle.dumps(imported(FOLDER, folder)))
        runs = self._runs(folder)
        for number, (training, calibrating, held_out) in enumerate(folds(runs)[: self.folds]):
            progress(f"rosa: fold {number + 1} of {self.folds}")
            place = folder / f"fold{number}"
            place.mkdir(exist_ok=True)
            twin = place / "rosa.onnx"
            if not twin.exists():
                train_twin(training, twin)
            for run in (*calibrating, *held_out, *_faulty_runs(runs)):
                keep_predictions(run.recording, twin, place / f"{run.name}.pickle")

    def figures(self, folder: Path) -> dict[str, Any]:
        """See Part."""
        runs, tally = self._runs(folder), Tally()
        for number, (_, calibrating, held_out) in enumerate(folds(runs)[: self.folds]):
            scored = self._scored(folder / f"fold{number}", calibrating, [*held_out, *_faulty_runs(runs)])
            add_scored(tally, scored, held_out, runs)
        by_kind: dict[str, list[float]] = {}
        for one in tally.found:
            by_kind.setdefault(one.event.kind, []).append(one.delay_s)
        found = [one.delay_s for one in tally.found if one.is_found]
        return {
            "found": f"{len(found)} of {len(tally.found)}",
            "delay s": _median(found),
            "false": f"{len(tally.false)} in {tally.healthy_hours:.2f} h",
            **{kind: _found(by_kind[kind]) for kind in sorted(by_kind)},
            "beside": tally.beside_events,
            "VUS-PR": float(np.mean(tally.volumes)),
        }

    @staticmethod
    def _runs(folder: Path) -> list[Measured]:
        runs: list[Measured] = pickle.loads((folder / "runs.pickle").read_bytes())
        return runs

    @staticmethod
    def _scored(place: Path, calibrating: Sequence[Measured], judged_runs: Sequence[Measured]) -> Scored:
        scored = Scored()
        with tempfile.TemporaryDirectory() as made:
            limited = Path(made) / "rosa.onnx"
            kept = [place / f"{run.name}.pickle" for run in calibrating]
            calibrate_twin(place / "rosa.onnx", limited, kept, 24 * ALARMS_PER_HOUR, extrapolate=True)
            for run in judged_runs:
                found = judged(scorer_of(run.recording, limited), read_predictions(place / f"{run.name}.pickle"))
                scored.alarms[run.name] = [
                    RaisedAlarm(run.name, one.fan, one.raised_ns, one.cleared_ns) for one in found.alarms
                ]
                scored.hours[run.name] = found.fan_hours
                scored.scores[run.name] = (found.t_ns, found.score[:, 0])
        return scored


def _faulty_runs(runs: Sequence[Measured]) -> list[Measured]:
    return [run for run in runs if not run.is_healthy]


def _of_run(folder: Path, run: str) -> Path:
    return folder / f"{run.replace('/', '-')}.faulty.pickle"


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else float("nan")


def _found(delays_s: Sequence[float]) -> str:
    hits = [one for one in delays_s if np.isfinite(one)]
    return f"{len(hits)}/{len(delays_s)}" + (f" {np.median(hits):.2g} s" if hits else "")

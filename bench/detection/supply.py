"""What measured columns are worth: a supply that wanders and air that warms, with the columns and without.

Simulated dc fans under a moving command. For each seed, a hybrid twin is trained with no column, with the current and
with supply voltage and temperature, on the same run, and calibrated on two other runs. Printed are the free-run error
on another run, the false alarms of that run, and of runs with a fault of one fan the cause that is named first at the
last diagnosis.

    python -m bench.detection.supply [--seeds 3] [--seconds 300] [--model physical]
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from bench.detection.tray_run import run_of
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.pipeline.runtime.building import build_parts
from fantwin.pipeline.runtime.stage import Context, Core, load_stage
from fantwin.schemas.enums import Transition
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Grid, Prediction, Raw
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import NS_PER_S
from fantwin.simulation.faults import Fault
from fantwin.simulation.plant import Measured, Surroundings
from fantwin.simulation.tacho import NoisyTacho, TachoSettings
from fantwin.simulation.tray import TraySettings
from fantwin.twin.build import evaluate, train_twin
from fantwin.twin.runs import Run

FANS, RATE_HZ, NOISE_RAD_S = 3, 50.0, 4.0
EPOCH_NS = 1_700_000_000 * NS_PER_S
FAULTY = 1
PER_DAY = 1.0
"""false alarms of a fan that are declared"""
MEASURED: tuple[Measured, ...] = ("supply_voltage_v", "current_a", "temperature_c")
KNOWN: dict[str, tuple[Measured, ...]] = {
    "nothing": (),
    "current": ("current_a",),
    "supply, air": ("supply_voltage_v", "temperature_c"),
}
"""the columns that a twin and its scorer get, by what the tables call them"""
WANDERS = (0.05, 0.0)
STAGES = ("resampler", "twin_integrator", "scorer")


@dataclass(frozen=True)
class Case:
    """A fault of one fan, or none."""

    name: str
    kind: str = ""
    size: float = 0.0

    def faults(self, start_s: float) -> tuple[Fault, ...]:
        """From this time on."""
        return (Fault(self.kind, FAULTY, start_s, size=self.size),) if self.kind else ()


CASES = (
    Case("healthy"),
    Case("supply drop of 12 %", "supply", 0.88),
    Case("drag increase of 60 %", "inlet", 1.6),
    Case("touch of 0.6 V", "rotor", 0.6),
)


def simulated(seed: int, wander: float, seconds: float, faults: Sequence[Fault] = ()) -> Run:
    """A run with all columns."""
    settings = TraySettings(
        fans=FANS,
        rate_hz=RATE_HZ,
        duration_s=seconds,
        profile="prbs",
        seed=seed,
        fans_seed=7,
        tacho=TachoSettings(noise=NoisyTacho(NOISE_RAD_S)),
        faults=tuple(faults),
        surroundings=Surroundings(supply_wander=wander, temperature_swing_c=8.0, measured=MEASURED),
    )
    return run_of(settings)


def _with(names: Sequence[str], run: Run) -> Run:
    return replace(run, auxiliary={name: of for name, of in run.auxiliary.items() if name in names})


def calibrated(twin: Path, healthy: Sequence[Run]) -> Path:
    """The twin, calibrated on healthy runs by `fantwin calibrate`."""
    recordings = [twin.with_name(f"healthy-{number}.mcap") for number in range(len(healthy))]
    for recording, run in zip(recordings, healthy, strict=True):
        metadata = {"site": "bench", "trays": "tray", "speed_unit": "rad/s"}
        with RecordingWriter(recording, metadata, t_ns=EPOCH_NS, overwrite=True) as writer:
            for raw in _raws(run):
                writer.add_message(tray_key("bench", "tray", "raw"), raw, int(raw.host_receive_t_ns[-1]))
    output = twin.with_name(f"calibrated-{twin.name}")
    options = ["--false-alarms-per-day", str(PER_DAY), "--extrapolate", "-o", str(output)]
    words = ["-m", "fantwin", "calibrate", str(twin), *map(str, recordings), *options]
    done = subprocess.run([sys.executable, *words], check=False, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    return output


def alarms_of(run: Run, twin: Path) -> list[Alarm]:
    """What the chain from raw samples to alarms raises."""
    first, second, third = (_core(stage, twin) for stage in STAGES)
    found: list[Alarm] = []
    for raw in _raws(run):
        for grid in _of(Grid, first.step(raw)):
            for prediction in _of(Prediction, second.step(grid)):
                found += _of(Alarm, third.step(prediction))
    return found


def _of(kind: type[Any], messages: Any) -> Iterator[Any]:
    return (message for message in messages if isinstance(message, kind))


def _core(stage: str, twin: Path) -> Core:
    text = f'[[tray]]\nname = "tray"\nfans = {FANS}\ntwin = "{twin}"\n[resampler]\nrate_hz = {RATE_HZ:g}\n'
    config = parse_config(text, Path("/nowhere/fantwin.toml"), (), STAGES)
    context = Context(
        site=config.site,
        trays=config.trays,
        config=config.sections[stage],
        folder=config.folder,
        run_folder=config.run_folder,
        started_t_ns=EPOCH_NS,
    )
    (parts,) = build_parts(load_stage(stage), context).values()
    return parts.core


def _raws(run: Run, rows: int = 10) -> Iterator[Raw]:
    t_ns = EPOCH_NS + np.rint(run.t_s * NS_PER_S).astype(np.int64)
    for number, first in enumerate(range(0, len(t_ns), rows)):
        part = slice(first, first + rows)
        auxiliary: dict[str, Any] = {name: of[part].astype(np.float32) for name, of in run.auxiliary.items()}
        yield Raw(
            header=Header("bench", number, "tray"),
            fans=FANS,
            host_receive_t_ns=t_ns[part],
            command=run.command[part],
            speed_rad_s=run.speed_rad_s[part],
            **auxiliary,
        )


def cause_named(alarms: Sequence[Alarm], start_t_ns: int) -> str:
    """The cause that comes first in the last diagnosis of the faulty fan, once the fault is there."""
    of_fan = [alarm for alarm in alarms if alarm.fan == FAULTY and alarm.t_ns >= start_t_ns and alarm.causes]
    return of_fan[-1].causes[0].cause if of_fan else "no alarm"


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--model", choices=("hybrid", "physical"), default="hybrid")
    arguments = parser.parse_args()
    seconds = arguments.seconds
    errors: dict[tuple[float, str], list[float]] = {}
    false_alarms: Counter[tuple[float, str]] = Counter()
    named: dict[tuple[float, str, str], Counter[str]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(arguments.seeds):
            for wander in WANDERS:
                training, other = (simulated(100 * seed + k, wander, seconds) for k in (1, 2))
                for label, names in KNOWN.items():
                    as_known = [_with(names, run) for run in (training, other)]
                    twin = train_twin(as_known[:1], [], arguments.model, name=label)
                    rmse = evaluate(twin, as_known[1:]).pooled.rmse_rad_s
                    errors.setdefault((wander, label), []).append(float("nan") if rmse is None else rmse)
                    healthy = [simulated(100 * seed + k, wander, seconds) for k in (3, 4)]
                    known = [_with(names, run) for run in healthy]
                    path = calibrated(twin.save(Path(folder) / f"{label}.onnx"), known)
                    for number, case in enumerate(CASES):
                        start_s = seconds / 2
                        run = other
                        if case.kind:
                            run = simulated(100 * seed + 10 + number, wander, seconds, case.faults(start_s))
                        alarms = alarms_of(_with(names, run), path)
                        raised = [alarm for alarm in alarms if alarm.transition == Transition.RAISED]
                        if not case.kind:
                            false_alarms[wander, label] += len(raised)
                        start_t_ns = EPOCH_NS + round(start_s * NS_PER_S)
                        counts = named.setdefault((wander, label, case.name), Counter())
                        counts[cause_named(alarms, start_t_ns)] += 1
                print(f"\n== seed {seed} of {arguments.seeds}, so far; {seconds:g} s each")
                _print_tables(errors, false_alarms, named, (seed + 1) * FANS * seconds / 3600)


def _print_tables(
    errors: dict[tuple[float, str], list[float]],
    false_alarms: Counter[tuple[float, str]],
    named: dict[tuple[float, str, str], Counter[str]],
    fan_hours: float,
) -> None:
    print("free-run error on another run, rad/s (noise of the tacho included), mean of the seeds and range")
    for (wander, label), values in sorted(errors.items()):
        spread = f"({min(values):.2f} to {max(values):.2f})"
        print(f"  supply wanders {100 * wander:.0f} %, {label:11}: {np.mean(values):6.2f}  {spread}")
    print(f"false alarms in {fan_hours:.2f} fan hours of healthy running, {PER_DAY:g} a fan and day declared")
    for (wander, label), counts in sorted(false_alarms.items()):
        print(f"  supply wanders {100 * wander:.0f} %, {label:11}: {counts}")
    print("first cause of the faulty fan at its last diagnosis")
    for (wander, label, case), counts in sorted(named.items()):
        found = ", ".join(f"{count} {cause}" for cause, count in counts.most_common())
        print(f"  supply wanders {100 * wander:.0f} %, {label:11} {case:22}: {found}", flush=True)


if __name__ == "__main__":
    main()

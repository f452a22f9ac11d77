"""Twins and alarms of fans under the controllers of real ones: what each loop costs.

Every loop has a tray of DC fans, the same fans under each. Its twin is trained on ten minutes under that loop,
validated on ten more and calibrated on these and ten others, as `fantwin commission` without a sweep does it. Then come
healthy hours, and runs in which one fan in four has a fault from FAULT_AFTER_S on.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

sys.path.insert(0, str(Path(__file__).parents[2]))

from bench.detection.ours import HealthyBins
from bench.printing import progress
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.runtime.stage import Context, Core, load_stage
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm, Array, Grid, Prediction, Score
from fantwin.simulation.plant import tray_of_fans
from fantwin.twin.build import train_twin
from fantwin.twin.errors import TwinError
from tests.support.controlled_fans import LOOPS, Fault, runs_of, samples, tiled

RATE_HZ, FANS, FANS_SEED, START_NS = 5.0, 12, 7, 1_700_000_000_000_000_000
PERIOD_NS = round(1e9 / RATE_HZ)
TRAINING_S, FAULT_AFTER_S, FAULTY_S, ITERATIONS = 600.0, 200.0, 600.0, 6
FAULTS: dict[str, dict[str, Any]] = {
    "drag +10 %": {"drag": 1.1},
    "blade lost": {"drag": 0.8},
    "blocked": {"blocks": True},
    "supply -5 %": {"supply": 0.95},
    "bearing": {"brake_v": 0.6, "grows_s": 600.0},
}
RIGHT = {
    "drag +10 %": ("drag_up",),
    "blade lost": ("drag_down",),
    "blocked": ("blocked",),
    "supply -5 %": ("gain_down",),
    "bearing": ("friction_up",),
}


def stage(name: str, twin: Path) -> Core:
    """The core of a stage for one tray, as the replay builds it."""
    text = f'[resampler]\nrate_hz = {RATE_HZ}\n[[tray]]\nname = "tray"\nfans = {FANS}\n'
    config = parse_config(text, twin)
    tray = config.trays[0].model_copy(update={"twin": twin.resolve()})
    of = Context(
        site=config.site, trays=(tray,), config=config.sections[name], folder=config.folder,
        run_folder=config.run_folder, started_t_ns=START_NS, configuration_text=text,
    )  # fmt: skip
    return load_stage(name).build(of).core


class Predicted:
    """The predictions of one tray."""

    def __init__(self, twin: Path) -> None:
        self._core, self._row = stage("twin_integrator", twin), 0

    def take(self, command: Array, speed_rad_s: Array) -> Iterator[Prediction]:
        """Of a block."""
        t_ns = START_NS + PERIOD_NS * (self._row + np.arange(len(command)))
        self._row += len(command)
        valid = np.isfinite(speed_rad_s)
        grid = Grid(
            fans=FANS, period_ns=PERIOD_NS, t_ns=t_ns, command=command, speed_rad_s=speed_rad_s, valid=valid,
            invalid_reason=np.zeros(valid.shape, np.uint8),
        )  # fmt: skip
        return (one for one in self._core.step(grid) if isinstance(one, Prediction))


class Judged:
    """What the scorer says of one tray, and since when."""

    def __init__(self, twin: Path) -> None:
        self._predicted, self._scorer = Predicted(twin), stage("scorer", twin)
        self.fan_hours, self.raised = 0.0, dict[int, list[float]]()
        self.first: dict[int, str] = {}
        self.later: dict[int, str] = {}

    def take(self, command: Array, speed_rad_s: Array) -> None:
        """Judge a block."""
        for block in self._predicted.take(command, speed_rad_s):
            for message in self._scorer.step(block):
                if isinstance(message, Score):
                    self.fan_hours += np.isfinite(message.score).sum() / RATE_HZ / 3600.0
                elif isinstance(message, Alarm):
                    self._alarm(message)

    def _alarm(self, one: Alarm) -> None:
        if one.transition == Transition.RAISED:
            self.raised.setdefault(one.fan, []).append((one.t_ns - START_NS) / 1e9)
        if one.active and one.causes:
            cause = one.causes[0].cause
            if cause != "cannot_tell":
                self.first.setdefault(one.fan, cause)
            self.later[one.fan] = cause


def trained(loops: Sequence[str], folder: Path) -> dict[str, tuple[Path, dict[str, Any]]]:
    """The twin of each loop, calibrated, and what training said."""
    fans = tray_of_fans(FANS, FANS_SEED)
    training, validation, healthy = (runs_of(loops, fans, TRAINING_S, RATE_HZ, seed) for seed in (1, 2, 3))
    made = {}
    for loop in loops:
        progress(f"training under {loop}")
        name = loop.replace(" ", "-").replace(",", "")
        output = folder / f"{name}-calibrated.onnx"
        about = output.with_suffix(".json")
        if about.exists():
            made[loop] = output, json.loads(about.read_text())
            continue
        try:
            twin = train_twin([training[loop]], [validation[loop]], "hybrid", name=name, max_iterations=ITERATIONS)
        except TwinError as error:
            progress(f"{loop}: {error}")
            continue
        plain = twin.save(folder / f"{name}.onnx")
        bins = HealthyBins(folder / name, plain)
        for number, run in enumerate((validation[loop], healthy[loop])):
            predicted = Predicted(plain)
            for first in range(0, len(run.t_s), 512):
                for block in predicted.take(run.command[first : first + 512], run.speed_rad_s[first : first + 512]):
                    bins.take(f"run{number}", block)
        calibration = bins.calibrate(1.0, output, extrapolate=True)
        said = Counter(line.partition(": ")[2].partition(":")[0][:44] for line in twin.identification.warnings)
        other = twin.card.validation
        made[loop] = (
            output,
            {
                "rmse": other.rmse,
                "said": dict(said),
                "balance": Counter(twin.card.balance.source),
                "sigma": float(np.mean(twin.card.sigma_rad_s)),
                "limit": calibration.limit_factor,
            },
        )
        about.write_text(json.dumps(made[loop][1]))
    return made


def main(
    output: Annotated[Path, typer.Argument(help="JSON to write.")],
    loops: Annotated[str, typer.Option(help="With semicolons; default all.")] = ";".join(LOOPS),
    hours: Annotated[float, typer.Option(help="Healthy hours of each tray of 12 fans.")] = 2.0,
    folder: Annotated[Path, typer.Option(help="Of the twins; those in it are used again.")] = Path("loops-twins"),
    faults: Annotated[str, typer.Option(help="With semicolons.")] = ";".join(FAULTS),
) -> None:
    """Measure."""
    chosen = loops.split(";")
    found: dict[str, dict[str, Any]] = {}
    folder.mkdir(parents=True, exist_ok=True)
    twins = trained(chosen, folder)
    chosen = [loop for loop in chosen if loop in twins]
    many = tiled(tray_of_fans(FANS, FANS_SEED), len(chosen))
    found = {loop: {**twins[loop][1], "faults": {}} for loop in chosen}
    for kind in ("", *filter(None, faults.split(";"))):
        progress(kind or "healthy hours")
        is_faulty = np.arange(FANS) % 4 == 1
        seconds, what = 3600.0 * hours, []
        if kind:
            what = [Fault(np.tile(is_faulty, len(chosen)), FAULT_AFTER_S, **FAULTS[kind])]
            seconds = FAULT_AFTER_S + FAULTY_S
        judged = {loop: Judged(twins[loop][0]) for loop in chosen}
        for commands, speeds in samples(chosen, many, seconds, RATE_HZ, 50 + len(kind), faults=what):
            for loop, command, speed in zip(
                chosen, *(np.split(of, len(chosen), axis=1) for of in (commands, speeds)), strict=True
            ):
                judged[loop].take(command, speed)
        for loop, one in judged.items():
            if not kind:
                found[loop]["fan_hours"] = one.fan_hours
                found[loop]["false"] = dict(one.raised)
                found[loop]["false_causes"] = one.first
                continue
            faulty = np.flatnonzero(is_faulty).tolist()
            delays = [
                min((t for t in one.raised.get(fan, []) if t >= FAULT_AFTER_S), default=np.inf) - FAULT_AFTER_S
                for fan in faulty
            ]
            found[loop]["faults"][kind] = {
                "delays": delays,
                "first": [one.first.get(fan, "") for fan in faulty],
                "later": [one.later.get(fan, "") for fan in faulty],
                "false": {
                    fan: times[:3]
                    for fan, times in one.raised.items()
                    if fan not in faulty or min(times) < FAULT_AFTER_S
                },
            }
        output.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    typer.run(main)

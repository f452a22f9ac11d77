"""Parameters, twins and alarms of fans under the controllers of real ones: what each loop costs.

First, fans of known parameters are identified from ten minutes under each loop. Then twins are made and judged.
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
from fantwin.twin.fitting.identification import identify
from tests.support.controlled_fans import LOOPS, Fault, plain_fans, runs_of, samples, tiled, true_parameters

RATE_HZ, FANS, FANS_SEED, START_NS = 5.0, 12, 7, 1_700_000_000_000_000_000
PERIOD_NS = round(1e9 / RATE_HZ)
TRAINING_S, FAULT_AFTER_S, FAULTY_S, ITERATIONS = 600.0, 200.0, 600.0, 6
IS_FAULTY = np.arange(FANS) % 4 == 1
FAULTS: dict[str, dict[str, Any]] = {
    "drag +10 %": {"drag": 1.1},
    "blade lost": {"drag": 0.8},
    "blocked": {"blocks": True},
    "supply -5 %": {"supply": 0.95},
    "bearing": {"brake_v": 0.6, "grows_s": 600.0},
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
        """Return the predictions of a block."""
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
        self.last: dict[int, str] = {}

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
            self.last[one.fan] = cause


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


def identified(loops: Sequence[str]) -> dict[str, dict[str, Any]]:
    """How far J, alpha and C_D are from the truth: median and spread of their relative errors, and the share of fans
    off by more than two standard errors; or why there are none."""
    fans = plain_fans(8, FANS_SEED)
    true, found = true_parameters(fans), dict[str, dict[str, Any]]()
    many = [runs_of(loops, fans, TRAINING_S, 2.0 * RATE_HZ, seed) for seed in (11, 12)]
    for loop in loops:
        progress(f"identification under {loop}")
        try:
            each = [identify([runs[loop]]) for runs in many]
        except TwinError as error:
            found[loop] = {"refused": str(error)}
            continue
        errors = np.concatenate([one.parameters[:, :3] - true for one in each])
        beyond = np.abs(errors) > 2.0 * np.concatenate([one.standard_errors[:, :3] for one in each])
        shares = errors / np.tile(true, (len(each), 1))
        found[loop] = {
            "in a loop": float(np.mean([one.closed_loop for one in each])),
            "median": np.median(shares, axis=0).round(3).tolist(),
            "spread": shares.std(axis=0).round(3).tolist(),
            "beyond 2 s.e.": beyond.mean(axis=0).round(2).tolist(),
        }
    return found


def judged_runs(twins: dict[str, Path], kind: str, seconds: float) -> dict[str, Judged]:
    """A run under each loop, in which some fans have a fault. kind: empty for none."""
    loops = list(twins)
    what = [Fault(np.tile(IS_FAULTY, len(loops)), FAULT_AFTER_S, **FAULTS[kind])] if kind else []
    judged = {loop: Judged(twin) for loop, twin in twins.items()}
    many = tiled(tray_of_fans(FANS, FANS_SEED), len(loops))
    for both in samples(loops, many, seconds, RATE_HZ, 50 + len(kind), faults=what):
        for loop, command, speed in zip(loops, *(np.split(of, len(loops), axis=1) for of in both), strict=True):
            judged[loop].take(command, speed)
    return judged


def of_faults(one: Judged) -> dict[str, Any]:
    """Delays and causes of the faulty fans of a run, and the alarms of the others."""
    faulty = np.flatnonzero(IS_FAULTY).tolist()
    after = {fan: [t_s - FAULT_AFTER_S for t_s in times] for fan, times in one.raised.items()}
    return {
        "delays_s": [next((since_s for since_s in after.get(fan, []) if since_s >= 0.0), None) for fan in faulty],
        "first": [one.first.get(fan, "") for fan in faulty],
        "last": [one.last.get(fan, "") for fan in faulty],
        "false": {fan: times for fan, times in after.items() if fan not in faulty or times[0] < 0.0},
    }


def main(
    output: Annotated[Path, typer.Argument(help="JSON to write.")],
    loops: Annotated[str, typer.Option(help="With semicolons; default all.")] = ";".join(LOOPS),
    hours: Annotated[float, typer.Option(help="Healthy hours of each tray of 12 fans.")] = 2.0,
    folder: Annotated[Path, typer.Option(help="Of the twins; those in it are used again.")] = Path("loops-twins"),
    faults: Annotated[str, typer.Option(help="With semicolons.")] = ";".join(FAULTS),
    identification: Annotated[bool, typer.Option(help="Measure the parameters as well.")] = True,
) -> None:
    """Measure, and write after each part what was found."""
    chosen = loops.split(";")
    found: dict[str, Any] = {"identification": identified(chosen)} if identification else {}
    folder.mkdir(parents=True, exist_ok=True)
    made = trained(chosen, folder)
    twins = {loop: twin for loop, (twin, _) in made.items()}
    found["twins"] = {loop: about for loop, (_, about) in made.items()}
    for kind in ("", *filter(None, faults.split(";"))):
        progress(kind or "healthy hours")
        judged = judged_runs(twins, kind, FAULT_AFTER_S + FAULTY_S if kind else 3600.0 * hours)
        if kind:
            found[kind] = {loop: of_faults(one) for loop, one in judged.items()}
        else:
            found["healthy"] = {loop: {"fan_hours": one.fan_hours, "false": one.raised} for loop, one in judged.items()}
        output.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    typer.run(main)

"""The simulated fleet: 200 fans in four trays, their twins learned from data, and the stages beside them.

Twins are learned as a user's are: physics alone, from two minutes of each tray by hand in open loop, on the day for
which the fans' parameters hold, and two minutes more that are held out. Nothing of the truth goes into them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.detection.knobs import BY_HAND, Knobs
from bench.detection.plant import RATE_HZ, START_NS, TRAY_FANS, Plant
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.runtime.stage import Context, Core, load_stage
from fantwin.schemas.messages import Array, Grid, Prediction, Raw
from fantwin.simulation.plant import FanParameters, tray_of_fans
from fantwin.twin.build import train_twin
from fantwin.twin.runs import Run

FANS_SEED = 7
TRAINING_S = 120.0
ITERATIONS = 25  # of training a hybrid: by then its error is that of the tacho


@dataclass(frozen=True)
class Fleet:
    """The fans, (fans,) each, and the file of each tray's twin."""

    fans: FanParameters
    twins: tuple[Path, ...]

    @property
    def count(self) -> int:
        """How many fans there are."""
        return len(np.asarray(self.fans.J))

    def sigmas(self) -> tuple[Array, Array]:
        """(fans,) healthy standard deviations of the speed residual in rad/s, and of the torque balance."""
        predictions = [stage("twin_integrator", twin).step(_one_sample()) for twin in self.twins]
        found = [message for made in predictions for message in made if isinstance(message, Prediction)]
        return (
            np.concatenate([one.sigma_rad_s for one in found]),
            np.concatenate([one.torque_balance_sigma_command for one in found]),
        )


def trained_fleet(folder: Path, fans: int, seed: int, progress: Callable[[str], None]) -> Fleet:
    """Fans, and twins of them written to a folder. fans: a multiple of TRAY_FANS."""
    parameters = tray_of_fans(fans, FANS_SEED)
    recorded = [healthy_runs(parameters, seed + number, TRAINING_S) for number in (0, 1)]
    twins = []
    for number, (training, held_out) in enumerate(zip(*recorded, strict=True)):
        progress(f"training the twins of tray {number + 1} of {fans // TRAY_FANS}")
        name = f"tray{number + 1}"
        twin = train_twin([training], [held_out], "hybrid", name=name, max_iterations=ITERATIONS)
        twins.append(twin.save(folder / f"{name}.onnx"))
    return Fleet(parameters, tuple(twins))


def healthy_runs(fans: FanParameters, seed: int, seconds: float) -> list[Run]:
    """A healthy run by hand of each tray, as a model maker reads it."""
    columns = len(np.asarray(fans.J))
    plant = Plant(fans, 1, Knobs([BY_HAND] * columns, seed), seed, days=False)
    trays: list[list[Raw]] = [[] for _ in range(columns // TRAY_FANS)]
    for blocks in plant.blocks(seconds):
        for tray, block in zip(trays, blocks, strict=True):
            tray.append(block)
    return [
        Run(
            f"tray{number + 1}",
            np.arange(sum(len(block.command) for block in tray)) / RATE_HZ,
            np.concatenate([block.command for block in tray]),
            np.concatenate([block.speed_rad_s for block in tray]),
        )
        for number, tray in enumerate(trays)
    ]


def stage(name: str, twin: Path) -> Core:
    """The core of a stage for one tray, as the replay builds it."""
    text = f'[resampler]\nrate_hz = {RATE_HZ}\n[[tray]]\nname = "tray"\nfans = {TRAY_FANS}\n'
    config = parse_config(text, twin)
    tray = config.trays[0].model_copy(update={"twin": twin.resolve()})
    declared = load_stage(name)
    return declared.build(
        Context(
            site=config.site,
            trays=(tray,),
            config=config.sections[name],
            folder=config.folder,
            run_folder=config.run_folder,
            started_t_ns=START_NS,
            configuration_text=text,
        )
    ).core


class PredictionStages:
    """Resampler and twin integrator of one tray in one run."""

    def __init__(self, twin: Path) -> None:
        self._resampler = stage("resampler", twin)
        self._integrator = stage("twin_integrator", twin)

    def take(self, raw: Raw) -> Iterator[Prediction]:
        """The predictions for a block."""
        for grid in self._resampler.step(raw):
            assert isinstance(grid, Grid)
            for message in self._integrator.step(grid):
                if isinstance(message, Prediction):
                    yield message


def run_name(unit: int, trays: int) -> str:
    """The name of the run of a tray, from its index among the blocks of the plant."""
    return f"run{unit // trays + 1}/tray{unit % trays + 1}"


def tray_number(run: str) -> int:
    """The tray of a run with such a name, from 0."""
    return int(run.rpartition("tray")[2]) - 1


def _one_sample() -> Grid:
    nothing = np.zeros((1, TRAY_FANS))
    valid = np.ones((1, TRAY_FANS), np.bool_)
    t_ns = np.array([START_NS])
    return Grid(
        fans=TRAY_FANS, period_ns=10_000_000, t_ns=t_ns, command=nothing, speed_rad_s=nothing, valid=valid,
        invalid_reason=np.zeros((1, TRAY_FANS), np.uint8),
    )  # fmt: skip

"""Trains a twin on what was read from recordings, and calibrates it on healthy ones."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.learning.training_data import TrainingData, data_cards, twin_errors
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.replay.offline.calibration_of_twin import CalibratedTwin, calibrated
from fantwin.pipeline.replay.offline.healthy_runs import HealthyPart, HealthyRuns, MapRecordings
from fantwin.pipeline.replay.offline.kept_bins import KeptBins
from fantwin.scoring.calibration.calibration import Calibration

if TYPE_CHECKING:
    from fantwin.twin.finishing import TrainedTwin
    from fantwin.twin.network_training import ForEachNetwork
    from fantwin.twin.progress import Progress


Trainer: TypeAlias = Literal["levenberg-marquardt", "adam"]
"""repeated here, because twin takes a while to load"""
NETWORKS = 4
"""enough that twins hardly depend on the seed: docs/reference/benchmarks.md"""


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of a training: the options of `fantwin train` explain them."""

    model: str = "hybrid"
    seed: int = 0
    trainer: Trainer = "levenberg-marquardt"
    iterations: int | None = None
    networks: int | None = None
    command_unit: str = ""


DEFAULT_SETTINGS = TrainingSettings()


def fit_twin(
    training_data: TrainingData,
    held_out: TrainingData | None,
    name: str,
    settings: TrainingSettings = DEFAULT_SETTINGS,
    progress: Progress | None = None,
    each_network: ForEachNetwork | None = None,
) -> TrainedTwin:
    """Train a twin on what was read. held_out: chooses its weights and gives its band. each_network: runs the trainings
    of its networks; None: in this process, one after another.

    Raises:
        TwinError: the data do not suffice.
    """
    from fantwin.twin.build import train_twin  # noqa: PLC0415  the command line loads twin only when it is needed
    from fantwin.twin.errors import TwinError  # noqa: PLC0415
    from fantwin.twin.kinds import find_kind  # noqa: PLC0415
    from fantwin.twin.network_training import one_after_another  # noqa: PLC0415
    from fantwin.twin.progress import unreported  # noqa: PLC0415

    can_average = find_kind(settings.model).has_ode_network and settings.trainer == DEFAULT_SETTINGS.trainer
    try:
        return train_twin(
            training_data.runs,
            held_out.runs if held_out else [],
            settings.model,
            name=name,
            seed=settings.seed,
            max_iterations=settings.iterations,
            trainer=settings.trainer,
            networks=settings.networks if settings.networks is not None else NETWORKS if can_average else 1,
            each_network=each_network or one_after_another,
            command_unit=settings.command_unit,
            fan_numbers=training_data.fans,
            fan_names=[training_data.names.name(fan) for fan in training_data.fans],
            data=data_cards(training_data),
            validation_data=data_cards(held_out) if held_out else (),
            progress=progress or unreported,
        )
    except TwinError as error:
        raise TwinError(training_data.with_fan_numbers([str(error)])[-1]) from error


MOST_KEPT_BYTES = 1 << 30
"""room on the disk for bins between passes, shared evenly by the recordings; a bin takes about 120 bytes a fan, and 30
for each sample in it"""


def calibrated_on(
    healthy: Sequence[Path],
    part: HealthyPart,
    per_day: float,
    each: MapRecordings,
    *,
    extrapolate: bool,
    alarms_left_out: int = 0,
    progress: Callable[[str], None] = lambda _: None,
) -> CalibratedTwin:
    """Calibrate a twin. part: the twin, and what counts of each recording. per_day: false alarms of a fan a day.
    each: does the work on each recording. extrapolate, alarms_left_out: as of `calibrated`.

    Raises:
        UserError: the twin or a recording cannot be used, or the recordings are too short.
    """
    if load_tray_twin(part.twin).card.top_speed_rad_s <= 0.0:
        raise UserError(f"{part.twin}: its training data have no speed above zero (speed_range_rad_s): train it again")
    with TemporaryDirectory(prefix="fantwin-calibrate-") as folder:
        kept = KeptBins(Path(folder), MOST_KEPT_BYTES // len(healthy))
        runs = HealthyRuns(healthy, part, each, kept, progress)
        found = calibrated(runs, per_day, extrapolate=extrapolate, alarms_left_out=alarms_left_out)
        data = tuple({"name": path.name, "sha256": sha256, **_part(part)} for path, sha256 in runs.sha256().items())
    created = datetime.now(UTC).isoformat(timespec="seconds")
    return replace(found, calibration=found.calibration.model_copy(update={"data": data, "created": created}))


def _part(part: HealthyPart) -> dict[str, float | str]:
    """The part of each recording, for the card; empty for the whole."""
    wanted: dict[str, float | str] = {"from_s": part.from_s} if part.from_s > 0.0 else {}
    wanted |= {"to_s": part.to_s} if part.to_s < math.inf else {}
    return wanted | ({"tray": part.tray} if part.tray else {})


def with_calibration(twin: Path, calibration: Calibration, **entries: Any) -> bytes:
    """The file of a twin with a calibration, and other entries, in its card.

    Raises:
        UserError: the file is not a twin.
    """
    with twin_errors():
        from fantwin.twin.export.onnx_export import with_card_entries  # noqa: PLC0415  the command line loads twin only when needed

        entries["calibration"] = json.loads(calibration.model_dump_json())
        return with_card_entries(twin.read_bytes(), entries)

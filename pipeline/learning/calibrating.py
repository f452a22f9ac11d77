"""The calibration of a twin on healthy recordings, with what its card says of them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.learning.training_data import twin_errors
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.replay.offline.calibration_of_twin import CalibratedTwin, calibrated
from fantwin.pipeline.replay.offline.healthy_runs import HealthyPart, HealthyRuns, MapRecordings
from fantwin.pipeline.replay.offline.kept_bins import KeptBins
from fantwin.scoring.calibration.calibration import Calibration

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
    alarms_left_out: int,
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


def with_calibration(twin: Path, calibration: Calibration) -> bytes:
    """The file of a twin with a calibration in its card.

    Raises:
        UserError: the file is not a twin.
    """
    with twin_errors():
        from fantwin.twin.export.card_entries import with_card_entries  # noqa: PLC0415  the command line loads twin only when needed

        return with_card_entries(twin.read_bytes(), {"calibration": json.loads(calibration.model_dump_json())})

"""The scorer itself as a detector, and its calibration on predictions instead of recordings."""

from __future__ import annotations

import json
import pickle
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from bench.detection.methods import AlarmChange, MethodOutput
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.replay.offline.calibration_of_twin import calibrated
from fantwin.pipeline.replay.offline.healthy_runs import HealthyPart, HealthyRuns
from fantwin.pipeline.replay.offline.kept_bins import KeptBins, RecordedTray, TrayRun
from fantwin.pipeline.runtime.stage import Core
from fantwin.pipeline.tray_scoring.healthy_twin import modelled_fans
from fantwin.schemas.messages import Alarm, Array, Prediction, Score
from fantwin.scoring.calibration.calibration import Calibration
from fantwin.scoring.model.bins import Bin, Bins, bin_ns_of
from fantwin.twin.export.onnx_export import with_card_entries

NAME = "fantwin"
ROOM_BYTES = 1 << 40
"""room for the bins of a run"""


class Scorer:
    """The stage's core. Its score is how much speaks for a fault, over what an alarm takes."""

    def __init__(self, core: Core) -> None:
        self._core = core

    def take(self, block: Prediction) -> MethodOutput:
        """See methods.Detector."""
        scores: list[Array] = []
        changes: list[AlarmChange] = []
        for message in self._core.step(block):
            if isinstance(message, Score):
                scores.append(message.score)
            elif isinstance(message, Alarm):
                reported = tuple(one.cause for one in message.causes)
                changes.append(AlarmChange(message.fan, message.t_ns, message.active, reported))
        return MethodOutput(np.concatenate(scores), changes)


class HealthyBins:
    """Bins of healthy runs of one twin's tray, kept in files as `fantwin calibrate` keeps those of recordings."""

    def __init__(self, folder: Path, twin: Path) -> None:
        """folder: of its own, made where it is not there."""
        folder.mkdir(parents=True, exist_ok=True)
        self.folder, self.twin = folder, twin
        self._bins: dict[str, Bins] = {}
        self._runs: dict[str, TrayRun] = {}

    def take(self, run: str, block: Prediction) -> None:
        """Keep a block of a run, in order of time."""
        if run not in self._runs:
            twin = load_tray_twin(self.twin, block.fans)
            fans = modelled_fans(twin)
            bin_ns = bin_ns_of(block.period_ns, float(fans.held_s.min()))
            self._bins[run] = Bins(bin_ns, fans.top_rad_s, fans.reads_balance, twin.unseen_error)
            tray = RecordedTray(Path(run), run, block.fans, "rad/s")
            self._runs[run] = TrayRun(tray, bin_ns, block.period_ns, ())
        with self._file(run).open("ab") as file:
            pickle.dump(list(self._bins[run].take(block)), file)

    def finish(self) -> None:
        """End all runs. Only then can processes calibrate side by side."""
        for name, run in self._runs.items():
            if not self._file(name).exists():  # it has ended already
                continue
            of_run = TrayRun(run.tray, run.bin_ns, run.period_ns, self._read(name))
            for each in KeptBins(self.folder, ROOM_BYTES).keep(run.tray.path, [of_run]):
                deque(each.bins, 0)
            self._file(name).unlink()

    def calibrate(self, per_day: float, output: Path, *, extrapolate: bool) -> Calibration:
        """Write the twin with what `fantwin calibrate` finds.

        Raises:
            UserError: the runs are too short to show the rate.
        """
        self.finish()
        kept = KeptBins(self.folder, ROOM_BYTES)
        runs = HealthyRuns([run.tray.path for run in self._runs.values()], HealthyPart(self.twin), kept=kept)
        found = calibrated(runs, per_day, extrapolate=extrapolate).calibration
        entry = {"calibration": json.loads(found.model_dump_json())}
        output.write_bytes(with_card_entries(self.twin.read_bytes(), entry))
        return found

    def _read(self, run: str) -> Iterator[Bin]:
        with self._file(run).open("rb") as file:
            while True:
                try:
                    yield from pickle.load(file)
                except EOFError:
                    return

    def _file(self, run: str) -> Path:
        return self.folder / f"{run.replace('/', '-')}.pickle"

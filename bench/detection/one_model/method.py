"""The one model as a method of the bench: what it needs of a twin, and of healthy runs."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bench.detection.methods import AlarmChange, Detector, Method, MethodOutput
from bench.detection.one_model.alarms import Decision
from bench.detection.one_model.bins import Bins, bin_ns_of
from bench.detection.one_model.healthy import Priors
from bench.detection.one_model.learned import HealthyRuns
from bench.detection.one_model.operation import Fans
from pipeline.runtime.tray_twin import TrayTwin, load_tray_twin
from schemas.messages import Array, Prediction
from schemas.units import NS_PER_S

NAME = "one model"


@dataclass(kw_only=True)
class OneModel(Method):
    """A method that raises and clears its alarms itself."""

    decides: Callable[[int], Detector]

    def detector(self, fans: int) -> Detector:
        """See Method."""
        return self.decides(fans)


def one_model(twin: Path, alarms_per_hour: float, healthy: HealthyRuns | None = None) -> OneModel:
    """The method for the predictions of a twin. alarms_per_hour: declared, of a fan; healthy: runs of the same fans."""
    priors = healthy.priors if healthy else Priors()

    def decides(fans: int) -> OneModelDetector:
        return OneModelDetector(load_tray_twin(twin, fans), 3600.0 / alarms_per_hour, priors)

    return OneModel(NAME, lambda fans: Statistic(decides(fans)), is_fixed=True, decides=decides)


def healthy_runs(twin: Path, predictions: Iterable[tuple[str, Prediction]]) -> HealthyRuns:
    """What healthy runs of a twin's fans tell. predictions: with the name of their run."""
    runs: HealthyRuns | None = None
    for run, block in predictions:
        runs = runs or HealthyRuns(load_tray_twin(twin, block.fans))
        runs.take(run, block)
    return runs or HealthyRuns(load_tray_twin(twin))


class OneModelDetector:
    """The alarms of one run of a tray. Its score is the log of the statistic over that of the limit."""

    def __init__(self, twin: TrayTwin, declared_s: float, priors: Priors) -> None:
        """Begin a run. declared_s: between two false alarms of a fan."""
        self._twin, self._fans = twin, Fans.of_twin(twin)
        self._declared_s, self._priors = declared_s, priors
        self._bins: Bins | None = None
        self._decision: Decision | None = None
        self._score = np.full(twin.fans, np.nan)

    def take(self, block: Prediction) -> MethodOutput:
        """See Detector."""
        if self._bins is None or self._decision is None:
            bin_ns = bin_ns_of(block.period_ns, float(self._fans.held_s.min()))
            self._bins = Bins(bin_ns, self._fans.top_rad_s, self._twin.unseen_error)
            self._decision = Decision(self._fans, bin_ns, block.period_ns / NS_PER_S, self._declared_s, self._priors)
        score = np.repeat(self._score[np.newaxis], len(block.t_ns), axis=0)
        changes: list[AlarmChange] = []
        for one in self._bins.take(block):
            changes += [
                AlarmChange(change.fan, one.t_ns, change.raised, (change.cause,) if change.cause else ())
                for change in self._decision.take(one)
            ]
            statistic = self._decision.log_statistic
            self._score = np.where(np.isfinite(statistic), statistic / self._decision.log_limit, np.nan)
            score[block.t_ns >= one.t_ns - block.period_ns] = self._score
        return MethodOutput(score, changes)


class Statistic:
    """Only the score of a detector."""

    def __init__(self, detector: Detector) -> None:
        """Take the score of this detector."""
        self._detector = detector

    def take(self, block: Prediction) -> Array:
        """See Scores."""
        return self._detector.take(block).score

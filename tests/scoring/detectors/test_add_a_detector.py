"""The recipe of docs/architecture.md: a statistic is one file with its class and one row in the table of detectors."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import ClassVar

import numpy as np
import pytest

from schemas.enums import Statistic, Transition
from schemas.messages import Alarm, Array
from scoring.calibration.healthy_statistics import HealthyRun
from scoring.detectors import table
from scoring.detectors.alarm_units import AlarmUnits
from scoring.detectors.detector import (
    Detector,
    DetectorContext,
    DetectorInput,
    DetectorRow,
    Signal,
    SingleLimit,
)
from scoring.fan_scorer import FanScorer
from scoring.limits import Limits, Timing
from tests.support.calibrated_runs import calibrate
from tests.support.healthy_residuals import autoregressive, in_blocks, samples_of
from tests.support.scored_blocks import CALIBRATION, commissioned, core_of, feed, prediction_of, snapshot_of

# The contents of a new file in scoring/detectors/.


class PeakSettings(SingleLimit):
    """The settings of Peak."""


class Peak(Detector):
    """Toy statistic: the largest recent residual, which decays slowly."""

    settings = PeakSettings
    kept_of_a_sample: ClassVar[float] = 0.999

    def __init__(self, settings: PeakSettings, context: DetectorContext) -> None:
        self._limit = settings.limit
        self._peak = np.zeros(context.fans)

    def update(self, block: DetectorInput) -> Array:
        """See Detector."""
        ratios = np.zeros(block.valid.shape)
        for row in range(len(ratios)):
            now = np.where(block.valid[row], np.abs(block.standardised[row]), 0.0)
            kept = np.where(block.valid[row], self.kept_of_a_sample, 1.0)
            self._peak = np.maximum(kept * self._peak, now)
            ratios[row] = self._peak / self._limit
        return ratios

    def reset(self, fans: Array) -> None:
        """See Detector."""
        self._peak[fans] = 0.0

    @property
    def memory_s(self) -> float:
        """See Detector."""
        return 10.0

    def limit_sigmas(self, period_s: float) -> float:
        """See Detector."""
        return self._limit

    def columns(self) -> dict[str, Array]:
        """See ColumnState."""
        return {"peak": self._peak}

    @classmethod
    def text(cls, alarm: Alarm, source: Signal, units: AlarmUnits) -> str:
        """See Detector."""
        return f"peaks of the {source}, {alarm.score:.1f} times the limit"


# And its row. The number is one that schemas.messages.Statistic does not name yet.

ROW = DetectorRow("balance_peak", 100, "balance", Peak)


@pytest.fixture(autouse=True)
def one_more_row(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "DETECTORS", (*table.DETECTORS, ROW))


PEAK_ONLY = CALIBRATION | {"detectors": {"balance_peak": {"limit": 3.0}}}


def test_its_alarm_has_its_number_and_its_text() -> None:
    core = commissioned(core_of(calibration=PEAK_ONLY))
    scores, alarms = feed(core, [prediction_of(np.zeros(100), balance=np.where(np.arange(100) < 50, 0.0, 3.0))])
    (raised,) = [alarm for alarm in alarms if alarm.transition == Transition.RAISED]
    assert raised.statistic == Statistic(100)
    assert raised.message.startswith(f"fan 0: peaks of the balance, {raised.score:.1f} times the limit")
    assert (scores[0].statistic[60:] == 100).all()


def test_its_limit_is_in_the_card_and_scales_with_the_others() -> None:
    limits = Limits.model_validate(PEAK_ONLY)
    assert limits.detectors == {"balance_peak": PeakSettings(limit=3.0)}
    assert Limits.model_validate(json.loads(limits.model_dump_json())) == limits
    assert limits.times(2.0).detectors == {"balance_peak": PeakSettings(limit=6.0)}
    assert FanScorer(1, limits).persistent_limit_sigmas("balance", 0.01) == 1.0 + 3.0
    with pytest.raises(ValueError, match=r"balance_peak\.limit"):
        Limits.model_validate(PEAK_ONLY | {"detectors": {"balance_peak": {"limit": -1.0}}})


def test_its_state_is_in_the_snapshot_and_continues_to_the_bit() -> None:
    wide = PEAK_ONLY | {"detectors": {"balance_peak": {"limit": 30.0}}}
    first, rest = (np.random.default_rng(seed).normal(0.0, 0.5, 300) for seed in (1, 2))
    unbroken = commissioned(core_of(calibration=wide))
    feed(unbroken, [prediction_of(np.zeros(300), balance=first)])
    successor = core_of(calibration=wide)
    successor.restore(snapshot_of(unbroken))
    later = prediction_of(np.zeros(300), balance=rest, first=300)
    (expected,), _ = feed(unbroken, [later])
    (score,), _ = feed(successor, [later])
    assert score.score.tobytes() == expected.score.tobytes()
    state = json.loads(snapshot_of(successor).state_json)["scorer"]["detectors"]
    assert len(state["balance_peak"]["peak"]) == 1


def healthy() -> Iterator[HealthyRun]:
    for run in range(2):
        speed, balance = (autoregressive(6000, 5, 0.0, 10 * run + seed) for seed in (1, 2))
        yield HealthyRun(f"run {run}", 5, in_blocks(samples_of(speed, balance)))


def test_its_limit_is_calibrated_by_rarity_with_the_others() -> None:
    limits = calibrate(healthy, 200.0, Timing(), 1500.0)
    peak = limits.detectors["balance_peak"]
    assert isinstance(peak, PeakSettings)
    assert 2.0 < peak.limit < 6.0, "of white residuals of standard deviation one"
    assert limits.detectors.keys() == {row.name for row in table.calibrated_rows()}

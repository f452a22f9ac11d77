"""Scorer and the calibration in the card of its twin: the rate that it declares, and what it refuses."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.runtime.stage import Context, StageError
from fantwin.pipeline.tray_scoring.scorer_config import FALSE_ALARMS_PER_DAY, ScorerConfig
from fantwin.pipeline.tray_scoring.scorer_core import NOT_CALIBRATED, ScorerCore
from fantwin.schemas.units import S_PER_DAY
from fantwin.stages.scorer import STAGE
from tests.support.scored_blocks import STEP, feed, prediction_of, with_step
from tests.support.twin_files import write_twin

CALIBRATION = {
    "false_alarms_per_day": 0.1,
    "priors": {},
    "limit_factor": 1.2,
    "fan_hours": 20.0,
    "runs": 3,
    "found": 0,
    "interval_95": (0.0, 4.4),
    "data": (),
    "created": "",
}


def context_of(folder: Path, *, config: dict[str, Any] | None = None, **card: Any) -> Context:
    write_twin(folder / "twin.onnx", **card)
    tray = TrayConfig(name="tray1", fans=2, twin=Path("twin.onnx"))
    return Context("plant", (tray,), ScorerConfig.model_validate(config or {}), folder, folder, 0)


@pytest.mark.parametrize(
    ("card", "config", "per_day"),
    [
        ({}, {}, FALSE_ALARMS_PER_DAY),
        ({"calibration": CALIBRATION}, {}, 0.1),
        ({"calibration": CALIBRATION}, {"false_alarms_per_day": 2.0}, 2.0),
    ],
    ids=["nobody says", "the card says", "the configuration says"],
)
def test_the_declared_rate_is_that_of_the_configuration_else_of_the_card(
    tmp_path: Path, card: dict[str, Any], config: dict[str, Any], per_day: float
) -> None:
    core = STAGE.build(context_of(tmp_path, config=config, **card)).core
    assert isinstance(core, ScorerCore)
    assert core.tray.twin.declared_s == pytest.approx(S_PER_DAY / per_day)
    assert core.tray.twin.limit_factor == (1.2 if card else 1.0)
    assert (NOT_CALIBRATED in core.notes()) != bool(card)
    _, alarms = feed(core, [prediction_of(with_step(6.5, 5.0, fans=2, fan=1, size=3.0 * STEP))])
    assert {alarm.fan for alarm in alarms} == {1}


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"limit_factor": -1.0}, "calibration cannot be used: limit_factor"),
        ({"priors": {"wander": 0.0}}, "calibration cannot be used: priors.wander"),
    ],
    ids=lambda each: next(iter(each)) if isinstance(each, dict) else "",
)
def test_a_calibration_that_cannot_be_used_is_reported_in_one_line(
    tmp_path: Path, wrong: dict[str, Any], why: str
) -> None:
    context = context_of(tmp_path, calibration=CALIBRATION | wrong)
    with pytest.raises(StageError) as refused:
        STAGE.build(context)
    assert why in str(refused.value)
    assert "fantwin calibrate" in str(refused.value) and "\n" not in str(refused.value)
    assert STAGE.check(context) == [str(refused.value)]

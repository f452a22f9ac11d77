"""pipeline.cli.twins.drops_found: of the fan with the widest limits."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pipeline.cli.twins.drops_found import drops_found
from scoring.baseline.healthy_residual import HealthyResidual
from scoring.detectors.smoothed import SmoothedSettings
from scoring.limits import Limits
from tests.support.twin_files import write_twin


def test_the_widest_limits_are_those_of_a_fan_whose_low_frequencies_vary_more(tmp_path: Path) -> None:
    def drop(*stds: float) -> float:
        residual = HealthyResidual(low_frequency_std_of_fans=stds)
        limits = Limits(speed=residual, balance=residual, detectors={"speed_smoothed": SmoothedSettings(limit=5.0)})
        twin = write_twin(tmp_path / "twin.onnx", fans=2, calibration=json.loads(limits.model_dump_json()))
        return drops_found(twin, 1.0)[-1].at_once

    assert drop(1.0, 1.5) == pytest.approx(1.5 * drop())

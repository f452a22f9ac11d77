"""pipeline.cli.twins.drops_found: a drop that is said to be found is found in noise, and a much smaller one is not."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fantwin.pipeline.cli.twins.drops_found import (
    SPEEDS,
    STEADY_S,
    WITHIN_S,
    drop_lines,
    dropping,
    drops_found,
    smallest_drops,
)
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.tray_scoring.modelled_fans import modelled_fans
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.calibration.calibration import Calibration
from fantwin.scoring.model.bins import Bins, bin_ns_of
from fantwin.scoring.model.decision import Decision
from tests.support.twin_files import write_twin

CALIBRATION = Calibration(false_alarms_per_day=24.0, fan_hours=100.0, runs=1, found=0, interval_95=(0.0, 0.9))
FANS = 20


def twin_with(path: Path, **changes: Any) -> Path:
    entry = json.loads(CALIBRATION.model_copy(update=changes).model_dump_json())
    return write_twin(path, fans=1, calibration=entry)


def share_found(path: Path, drop: float, within_s: float) -> float:
    """Share of fans at half their top speed, with the noise of their card, whose drop is found in a time."""
    twin = load_tray_twin(path, FANS)
    fans = modelled_fans(twin)
    exact = dropping(twin, fans, 0.5 * fans.top_rad_s, np.full(FANS, drop))
    noise_rad_s = fans.noise_rad_s * np.random.default_rng(1).normal(size=exact.command.shape)
    bin_ns = bin_ns_of(exact.period_ns, 0.0)
    decision = Decision(fans, bin_ns, exact.period_ns / NS_PER_S, 3600.0, CALIBRATION.priors)
    found = np.zeros(FANS, np.bool_)
    noisy = replace(exact, measured_speed_rad_s=exact.measured_speed_rad_s + noise_rad_s)
    for one in Bins(bin_ns, fans.top_rad_s, None).take(noisy):
        for change in decision.take(one):
            found[change.fan] |= change.raised and one.t_ns <= (STEADY_S + within_s) * NS_PER_S
    return float(found.mean())


def test_most_fans_show_a_drop_in_the_time_in_which_it_is_said_to_be_found(tmp_path: Path) -> None:
    twin = twin_with(tmp_path / "twin.onnx")
    of_half = smallest_drops(load_tray_twin(twin), CALIBRATION)[SPEEDS.index(0.5)]
    assert list(of_half) == sorted(of_half, reverse=True)
    for within_s, drop in zip(WITHIN_S[:2], of_half, strict=False):
        assert share_found(twin, 1.5 * drop, within_s) >= 0.8
        assert share_found(twin, 0.5 * drop, within_s) <= 0.2


def test_a_raised_limit_finds_only_larger_drops_and_people_read_them_in_the_unit_of_the_tray(tmp_path: Path) -> None:
    by_theory, raised = (
        drops_found(twin_with(tmp_path / f"{factor}.onnx", limit_factor=factor), 0.1) for factor in (1.0, 2.0)
    )
    assert [drop.speed for drop in by_theory] == pytest.approx([1250, 2500, 3750, 5000])
    for drop, larger in zip(by_theory, raised, strict=True):
        assert larger.within_10_s and drop.within_10_s
        assert larger.within_10_s > drop.within_10_s
    assert drop_lines(by_theory, "rpm")[0].startswith("found at 1,250 rpm: a drop of ")
    assert drops_found(write_twin(tmp_path / "none.onnx"), 1.0) == []

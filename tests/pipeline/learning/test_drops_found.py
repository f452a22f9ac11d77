"""pipeline.learning.drops_found: a drop that is said to be found is found in noise, and a much smaller one is not."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.learning import drops_found as module
from fantwin.pipeline.learning.drops_found import dropping, drops_found
from fantwin.pipeline.prediction.tray_twin import load_tray_twin
from fantwin.pipeline.tray_scoring.healthy_twin import modelled_fans
from fantwin.schemas.messages import Array
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.calibration.calibration import Calibration
from fantwin.scoring.model.bins import Bins, bin_ns_of
from fantwin.scoring.model.decision import Decision
from tests.support.twin_files import write_twin

CALIBRATION = Calibration(false_alarms_per_day=24.0, fan_hours=100.0, runs=1, found=0, interval_95=(0.0, 0.9))
STEADY_S, WITHIN_S = 5.0, (1.0, 5.0, 7.0)
"""a tenth of the time that a person is told of, for a tenth of the work"""
RAD_S_PER_UNIT = 0.1
FANS = 20


def twin_with(path: Path, limit_factor: float) -> Path:
    entry = json.loads(CALIBRATION.model_copy(update={"limit_factor": limit_factor}).model_dump_json())
    return write_twin(path, fans=1, calibration=entry, rate_hz=20.0)


def found_after_s(path: Path, drops: Array) -> Array:
    """Seconds after which each drop of fans at half their top speed is found, in the noise of their card."""
    twin = load_tray_twin(path, len(drops))
    fans = modelled_fans(twin)
    exact = dropping(twin, fans, 0.5 * fans.top_rad_s, drops)
    noise_rad_s = fans.noise_rad_s * np.random.default_rng(1).normal(size=exact.command.shape)
    bin_ns = bin_ns_of(exact.period_ns, 0.0)
    decision = Decision(fans, bin_ns, exact.period_ns / NS_PER_S, 3600.0, CALIBRATION.priors)
    found_s = np.full(len(drops), np.inf)
    noisy = replace(exact, measured_speed_rad_s=exact.measured_speed_rad_s + noise_rad_s)
    for one in Bins(bin_ns, fans.top_rad_s, fans.reads_balance, None).take(noisy):
        after_s = one.t_ns / NS_PER_S - STEADY_S
        if after_s > WITHIN_S[1]:
            break
        for change in decision.take(one):
            if change.raised:
                found_s[change.fan] = min(found_s[change.fan], after_s)
    return found_s


def test_most_fans_show_a_drop_within_the_stated_time_and_a_raised_limit_finds_larger_ones_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "STEADY_S", STEADY_S)
    monkeypatch.setattr(module, "WITHIN_S", WITHIN_S)
    twin = twin_with(tmp_path / "by-theory.onnx", 1.0)
    by_theory = drops_found(twin, RAD_S_PER_UNIT)
    raised = drops_found(twin_with(tmp_path / "raised.onnx", 2.0), RAD_S_PER_UNIT)
    assert [drop.speed for drop in by_theory] == pytest.approx([1250, 2500, 3750, 5000])
    for drop, larger in zip(by_theory, raised, strict=True):
        assert drop.within_1_s and drop.within_10_s and drop.within_60_s and larger.within_10_s
        assert drop.speed > drop.within_1_s > drop.within_10_s > drop.within_60_s
        assert larger.within_10_s > drop.within_10_s
    assert by_theory[0].line("rpm").startswith("found at 1,250 rpm: a drop of ")
    assert drops_found(write_twin(tmp_path / "none.onnx"), RAD_S_PER_UNIT) == [], "it is not calibrated"

    half = by_theory[1]
    said = np.array([half.within_1_s, half.within_10_s], np.float64) / half.speed
    shares = np.repeat(np.concatenate((1.5 * said, 0.5 * said)), FANS)
    found_s = found_after_s(twin, shares).reshape(2, 2, FANS)
    within = np.mean(found_s <= np.array(WITHIN_S[:2])[:, np.newaxis], axis=2)
    assert (within[0] >= 0.8).all() and (within[1] <= 0.2).all(), within

"""Samples that are too far apart for the motion of a fan give a static twin; others give one with motion."""

from __future__ import annotations

import numpy as np
import pytest

from fantwin.schemas.units import RAD_S_PER_UNIT
from fantwin.twin.build import evaluate, train_twin
from fantwin.twin.errors import TwinError
from fantwin.twin.fitting.static_fit import fit_static, static_instead
from fantwin.twin.runs import Run
from tests.support.slow_lines import slow_line

SAMPLES = 700


def run_of(period_s: float, time_constant_s: float, seed: int, *, synchronous: bool = False) -> Run:
    line = slow_line(SAMPLES * period_s, period_s, time_constant_s, seed, synchronous=synchronous)
    t_s, command, rpm = line
    return Run("slow", t_s, command, rpm * RAD_S_PER_UNIT["rpm"])


@pytest.mark.parametrize(
    ("period_s", "time_constant_s", "synchronous", "kind"),
    [
        (0.2, 1.0, False, "physical"),
        (1.0, 3.0, False, "physical"),
        (1.0, 3.0, True, "physical"),
        (2.0, 1.0, False, "static"),
        (2.0, 1.0, True, "static"),
        (5.0, 3.0, False, "static"),
        (15.0, 0.3, False, "static"),
        (15.0, 3.0, False, "static"),
        (60.0, 1.0, False, "static"),
        (60.0, 1.0, True, "static"),
    ],
)
def test_the_kind_follows_from_time_constant_and_samples_and_none_is_refused(
    period_s: float, time_constant_s: float, synchronous: bool, kind: str
) -> None:
    twin = train_twin([run_of(period_s, time_constant_s, 1, synchronous=synchronous)], [], "physical", name="x")
    assert (twin.card.kind, twin.card.closed_loop) == (kind, (False,))
    held_out = run_of(period_s, time_constant_s, 2, synchronous=synchronous)
    noise = 0.003 * float(held_out.speed_rad_s.mean())
    found = evaluate(twin, [held_out]).pooled
    assert found.rmse_rad_s < (1.6 if kind == "static" else 4.0) * max(twin.card.sigma_rad_s[0], noise)
    assert found.r2 > 0.995
    if kind == "static" and period_s < 4.0 * time_constant_s:  # else it is not to be seen
        assert twin.parameters[0, 0] == pytest.approx(time_constant_s, rel=0.5)


def test_a_speed_that_does_not_follow_its_command_has_no_static_twin() -> None:
    run = run_of(15.0, 1.0, 1)
    shuffled = Run("x", run.t_s, np.random.default_rng(1).permutation(run.command), run.speed_rad_s)
    assert static_instead([run], [], None) is not None
    assert static_instead([shuffled], [], None) is None


def loop_of(set_points_rad_s: list[float]) -> Run:
    """A fan sampled every 15 s, whose controller answers the speed that the load disturbs."""
    samples = 700
    wanted = np.repeat(set_points_rad_s, samples // len(set_points_rad_s))
    load = 6.0 * np.random.default_rng(1).standard_normal(samples)
    command, speed = np.empty(samples), np.empty(samples)
    command[0] = 0.4 * wanted[0]
    for k in range(samples):
        speed[k] = 2.5 * command[k] + load[k]
        if k + 1 < samples:
            command[k + 1] = command[k] + 0.3 * (wanted[k] - speed[k])
    return Run("loop", 15.0 * np.arange(samples, dtype=np.float64), command, speed)


def test_a_static_twin_knows_that_its_fan_is_in_a_loop() -> None:
    run = loop_of([100.0, 180.0, 140.0, 220.0, 120.0])
    assert train_twin([run], [], "static", name="x").card.closed_loop == (True,)


def test_a_loop_at_one_set_point_has_no_static_twin() -> None:
    run = loop_of([180.0])
    with pytest.raises(TwinError, match="closed loop at one set-point"):
        fit_static([run])
    assert static_instead([run], [], None) is None

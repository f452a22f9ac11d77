"""scoring.wear.wear_monitor, through the scorer: days of bearing wear, with 15 s measured in each hour."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from schemas.blocks import cut
from schemas.enums import Action, Transition
from schemas.header import Header
from schemas.messages import Alarm, Prediction, ScorerSnapshot
from scoring.diagnosis.regression_window import HealthyBalance
from scoring.torque_balance import BalanceModel, TorqueBalance
from scoring.wear.slow_change import WEAR_HINT
from stages.scorer import ScorerCore
from tests.support.scored_blocks import (
    CALIBRATION,
    EPOCH_NS,
    SIGMA,
    SIGMA_COMMAND,
    TWIN_SPEED,
    balance_of_a_fan,
    core_of,
    feed,
    request_of,
    snapshot_of,
)

HOUR_NS = 3600 * 10**9
DAY_NS = 24 * HOUR_NS
STEP_NS = 20_000_000
WORN, HEALTHY = 1, 0
GROWTH_PER_DAY = 0.06
"""of the friction, in units of the command"""
DAY_AND_NIGHT = 0.02
LIMIT = (1.0 + 0.5) * SIGMA_COMMAND
"""the adaptation limit, and the reference value of the drift"""


def burst(
    hour: float,
    growth_per_day: float = GROWTH_PER_DAY,
    swing: float = DAY_AND_NIGHT,
    seconds: float = 15.0,
    speed: float | None = None,
    by: Sequence[HealthyBalance] | None = None,
    twin: str = "t",
) -> Prediction:
    """Predictions of two fans at a held speed that differs from hour to hour; the friction of the second grows.

    by: the torque balance of the twin, of each fan; None: that of the fans without wear. twin: its name.
    """
    rng = np.random.default_rng(round(hour * 4))
    fan, n = balance_of_a_fan(), round(seconds * 1e9 / STEP_NS)
    t_ns = EPOCH_NS + round(hour * HOUR_NS) + np.arange(n) * STEP_NS
    twin_speed = TWIN_SPEED * rng.uniform(0.9, 1.1) if speed is None else speed
    friction = swing * np.sin(2 * np.pi * hour / 24) + np.array([0.0, growth_per_day * hour / 24])
    needed = fan.viscous * twin_speed + fan.drag * twin_speed**2 + fan.friction
    command = np.broadcast_to(needed + friction, (n, 2))
    measured = twin_speed + rng.normal(0.0, 0.3, (n, 2))
    of_twin = by or (fan, fan)
    names = ("inertia", "viscous", "drag", "friction", "lag_s")
    columns = {name: np.array([getattr(each, name) for each in of_twin]) for name in names}
    model = BalanceModel(
        **columns,
        filter_rate_per_s=fan.filter_rate_per_s,
        lowest_speed_rad_s=np.full(2, fan.lowest_speed_rad_s),
        highest_speed_rad_s=1000.0,
    )
    return Prediction(
        header=Header("integrator-1", round(hour * 4), "tray1"),
        fans=2,
        period_ns=STEP_NS,
        t_ns=t_ns,
        command=command,
        measured_speed_rad_s=measured,
        predicted_speed_rad_s=np.full((n, 2), twin_speed),
        sigma_rad_s=np.full(2, SIGMA),
        valid=np.ones((n, 2), np.bool_),
        invalid_reason=np.zeros((n, 2), np.uint8),
        twin=twin,
        torque_balance_command=TorqueBalance(model).update(STEP_NS / 1e9, command, measured, np.ones((n, 2), np.bool_)),
        torque_balance_sigma_command=np.full(2, SIGMA_COMMAND),
    )


def core() -> ScorerCore:
    return core_of(2, calibration=CALIBRATION, off_delay_s=1.0)


def core_for_days() -> ScorerCore:
    """With longer intervals of the baseline: over days they make no difference, and most of the time goes into them."""
    return core_of(2, calibration=CALIBRATION, baseline_s=3.0)


def live_through(
    core: ScorerCore, days: float, from_day: float = 0.0, every_hours: float = 1.0, **more: Any
) -> Iterator[Alarm]:
    for hour in np.arange(from_day * 24, days * 24, every_hours).tolist():
        yield from (message for message in core.step(burst(hour, **more)) if isinstance(message, Alarm))


def wear_of(memory: ScorerSnapshot) -> Any:
    return json.loads(memory.state_json)["wear"]


def worn(fan: int, parameter: str, core: ScorerCore) -> Any:
    return wear_of(snapshot_of(core))["fans"][fan]["parameters"][parameter]


@pytest.fixture(scope="module")
def after_eight_days() -> tuple[ScorerCore, list[Alarm]]:
    eight = core_for_days()
    return eight, list(live_through(eight, 8))


@pytest.fixture(scope="module")
def after_twelve_days(after_eight_days) -> tuple[ScorerCore, list[Alarm]]:
    twelve = restored(after_eight_days[0])
    return twelve, list(live_through(twelve, 12, from_day=8))


def test_the_growth_of_friction_is_found_with_an_interval_that_holds_it(after_eight_days) -> None:
    core, alarms = after_eight_days
    assert alarms == []
    fan = balance_of_a_fan()
    truth = {
        "balance": GROWTH_PER_DAY,
        "friction": GROWTH_PER_DAY,
        "drag": GROWTH_PER_DAY / (fan.drag * TWIN_SPEED**2),
        "gain": -GROWTH_PER_DAY / 50.0,
    }
    for parameter, slope in truth.items():
        found = worn(WORN, parameter, core)
        per_day = found["per_day"]
        assert per_day["value"] == pytest.approx(slope, rel=0.1), parameter
        if parameter in ("balance", "friction"):  # growing friction is not quite a drag that grows
            assert per_day["low"] < slope < per_day["high"], parameter
        assert found["change"] == pytest.approx(8 * slope, rel=0.1), parameter


def test_the_alarm_comes_within_the_forecast(after_eight_days, after_twelve_days) -> None:
    core, _ = after_eight_days
    twelve, alarms = after_twelve_days
    found = worn(WORN, "balance", core)
    assert found["limit"] == pytest.approx(LIMIT)
    times = found["reached_t_ns"]
    days = [(times[name] - EPOCH_NS) / DAY_NS for name in ("earliest", "likely", "latest")]
    assert days[0] < LIMIT / GROWTH_PER_DAY < days[2]
    assert days[1] == pytest.approx(LIMIT / GROWTH_PER_DAY, rel=0.05)
    assert days[2] - days[0] < 4.0
    raised = next(iter([*alarms, *live_through(restored(twelve), 13.5, from_day=12)]))
    assert (raised.fan, raised.transition) == (WORN, Transition.RAISED)
    assert days[0] - 0.5 < (raised.t_ns - EPOCH_NS) / DAY_NS < days[2] + 0.5


def test_a_healthy_fan_shows_no_wear(after_eight_days) -> None:
    core, _ = after_eight_days
    for parameter in ("balance", "friction", "drag", "gain"):
        per_day = worn(HEALTHY, parameter, core)["per_day"]
        assert per_day["low"] < 0.0 < per_day["high"], parameter
    assert worn(HEALTHY, "balance", core)["reached_t_ns"] is None
    assert "no significant trend" in worn(HEALTHY, "balance", core)["unknown_reason"]


def test_a_limit_within_days_is_reported_in_health_and_raises_no_alarm(after_eight_days) -> None:
    core, _ = after_eight_days
    assert (
        core.problem()
        == "fan 1 is wearing: its torque balance will reach the limit in about 5 days (4 to 5); inspect it"
    )
    assert list(live_through(restored(core), 8.5, from_day=8)) == []


def test_wear_that_is_far_from_its_limit_is_not_reported() -> None:
    slow = core_for_days()
    assert list(live_through(slow, 4, growth_per_day=0.04, swing=0.002)) == []
    assert worn(WORN, "balance", slow)["reached_t_ns"] is not None
    assert slow.problem() == ""


def test_slow_change_is_noticed_before_it_is_an_alarm() -> None:
    """Half a day, in which one of two fans takes 5 % more command; limits are wide."""
    clogging = core_of(2, calibration=CALIBRATION, baseline_s=3.0, limit_factor=5.0)
    assert list(live_through(clogging, 0.5, every_hours=0.5, growth_per_day=5.0, swing=0.0)) == []
    (notice,) = [note for note in clogging.notes() if note.endswith(WEAR_HINT)]
    assert re.match(r"fan 1: drag \+\d\.\d % in 1\d h, \+0\.\d\d % an hour, the fans beside it [+-]0\.\d\d %: ", notice)
    assert clogging.problem() == ""


def test_less_than_a_day_gives_no_forecast() -> None:
    young = core_for_days()
    assert list(live_through(young, 0.9, every_hours=0.5, growth_per_day=0.1, swing=0.0)) == []
    assert worn(WORN, "balance", young)["unknown_reason"] == "less than a day was observed"
    assert young.problem() == ""


def restored(core: ScorerCore) -> ScorerCore:
    successor = core_for_days()
    successor.restore(snapshot_of(core))
    return successor


def test_a_restart_forgets_nothing_of_it(after_eight_days) -> None:
    core, _ = after_eight_days
    successor = restored(core)
    assert wear_of(snapshot_of(successor)) == wear_of(snapshot_of(core))
    assert successor.problem() == core.problem()
    assert list(live_through(successor, 8.25, from_day=8)) == []
    assert worn(WORN, "friction", successor)["series"]["t_ns"][-1] > worn(WORN, "friction", core)["series"]["t_ns"][-1]


def test_blocks_make_no_difference() -> None:
    found = []
    for block in (37, 750):
        one = core()
        for hour in (0, 1, 2):
            whole = burst(hour)
            for first in range(0, 750, block):
                one.step(cut(whole, first, min(first + block, 750)))
        found.append(wear_of(snapshot_of(one)))
    assert len(found[0]["fans"][0]["parameters"]["drag"]["series"]["t_ns"]) == 3
    assert found[1] == found[0]


def test_wear_starts_again_for_a_fan_that_is_commissioned_again(after_eight_days) -> None:
    successor = restored(after_eight_days[0])
    successor.step(request_of(Action.COMMISSION, WORN))
    assert worn(WORN, "friction", successor)["series"]["t_ns"] == []
    assert worn(HEALTHY, "friction", successor)["series"]["t_ns"] != []
    assert successor.problem() == ""


def test_a_fan_above_half_its_limit_gets_no_point() -> None:
    one = core()
    list(live_through(one, 0.3))
    before = len(worn(WORN, "friction", one)["series"]["t_ns"])
    for hour in range(8, 12):
        list(one.step(burst(hour, growth_per_day=5.0)))
    assert len(worn(WORN, "friction", one)["series"]["t_ns"]) == before
    assert len(worn(HEALTHY, "friction", one)["series"]["t_ns"]) > before


def first_point_s(fan: int, core: ScorerCore) -> float | None:
    times = worn(fan, "friction", core)["series"]["t_ns"]
    return (times[0] - EPOCH_NS) / 1e9 if times else None


def test_a_fan_gets_a_point_once_its_disturbance_is_out_of_the_window() -> None:
    one, block = core(), burst(0, seconds=60.0)
    measured = block.measured_speed_rad_s.copy()
    measured[435:520, WORN] = measured[434, WORN]  # more than half as long as a reading may repeat itself
    one.step(replace(block, measured_speed_rad_s=measured))
    assert (first_point_s(HEALTHY, one), first_point_s(WORN, one)) == (10.0, 51.0)


def with_a_fault(first_s: int = 7) -> Prediction:
    """A block in which the second fan needs 2 more of the command for 2 s."""
    block = burst(0, seconds=60.0)
    more = np.zeros((len(block.t_ns), 2))
    more[50 * first_s : 50 * (first_s + 2), WORN] = 2.0
    return replace(block, command=block.command + more, torque_balance_command=block.torque_balance_command + more)


@pytest.mark.parametrize(("block", "first_s"), [(37, 7), (512, 11)])
def test_how_far_back_a_fault_is_does_not_depend_on_blocks(block: int, first_s: int) -> None:
    whole, cut_up, faulty = core(), core(), with_a_fault(first_s)
    feed(whole, [faulty])
    feed(cut_up, [cut(faulty, first, min(first + block, 3000)) for first in range(0, 3000, block)])
    assert wear_of(snapshot_of(cut_up)) == wear_of(snapshot_of(whole))


def test_after_a_restart_it_is_known_how_far_back_a_fault_is() -> None:
    killed, successor, faulty = core(), core(), with_a_fault()
    feed(killed, [cut(faulty, 0, 1500)])
    successor.restore(snapshot_of(killed))
    feed(successor, [cut(faulty, 1500, 3000)])
    assert first_point_s(WORN, successor) == 51.0


def test_no_wear_point_uses_samples_from_before_a_fan_was_commissioned_again() -> None:
    one, block = core(), burst(0, seconds=60.0)
    feed(one, [cut(block, 0, 500), request_of(Action.COMMISSION, WORN), cut(block, 500, 3000)])
    assert (first_point_s(HEALTHY, one), first_point_s(WORN, one)) == (10.0, 51.0)


def test_a_fan_at_standstill_reports_nothing() -> None:
    one = core()
    for hour in range(6):
        one.step(burst(hour, speed=10.0))
    assert worn(WORN, "friction", one)["series"]["t_ns"] == []


def test_a_twin_without_calibration_has_trends_and_no_limit() -> None:
    one = core_of(2, baseline_s=1.0)
    list(live_through(one, 1.5, swing=0.0))
    assert worn(WORN, "balance", one)["unknown_reason"] == "the twin is not calibrated"
    assert worn(WORN, "friction", one)["per_day"]["low"] > 0.0

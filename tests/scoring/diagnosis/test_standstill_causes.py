"""scoring.diagnosis.standstill_causes: a blocked fan and one without power, by the readings of a counting tacho."""

from __future__ import annotations

import numpy as np
import pytest

from schemas.standstill import Standstill
from schemas.tacho import Tacho
from scoring.diagnosis.diagnosis import RankedCause
from scoring.diagnosis.regression_window import HealthyBalance, Window
from scoring.diagnosis.standstill_causes import standstill_causes
from simulation.four_pin import FourPinDamage, FourPinFans, four_pin_tray
from simulation.tacho import CountingTacho

PERIOD_S, FAULT_S, FANS = 0.1, 30.0, 12
HEALTHY = Standstill(
    turning_command=0.15,
    standing_below_rad_s=14.1,
    off_command=0.0,
    start_s=1.5,
    coast_s=7.0,
    coast_time_constant_s=1.25,
)
BALANCE = HealthyBalance(0.002, 0.004, 0.0, 0.07, 0.0, np.zeros((4, 4)), 3.0, 0.02, 0.1)
PLATEAU, HIGH = 0.16, 0.8
"""duties"""


def causes(duty: float, window_s: float, *, is_blocked: bool) -> list[dict[str, float]]:
    """Of several fans, half a second after each reads as if it stood."""
    fault_s = FAULT_S + np.random.default_rng(1).random(FANS)
    fans = FourPinFans(four_pin_tray(FANS, 2), np.random.default_rng(3), 1)
    tacho = Tacho(kind="count", window_s=window_s)
    counter = CountingTacho((tacho,) * FANS, 0.0, 0.0, np.random.default_rng(4))
    readings = []
    for number in range(round((FAULT_S + 10.0) / PERIOD_S)):
        now_s, before = number * PERIOD_S, fans.speed_rad_s
        is_faulty = now_s >= fault_s
        fans.damage = FourPinDamage(is_blocked=is_faulty & is_blocked, is_unpowered=is_faulty & (not is_blocked))
        fans.advance(np.full(FANS, duty), PERIOD_S)
        counter.turn(now_s, before, now_s + PERIOD_S, fans.speed_rad_s)
        readings.append(counter.reading_rad_s.copy())
    speed = np.array(readings)
    began = np.arange(len(speed))[:, np.newaxis] * PERIOD_S > fault_s
    stands = ((speed < HEALTHY.standing_below_rad_s) & began).argmax(axis=0) + 6
    found = []
    for fan, end in enumerate(stands.tolist()):
        window = Window(PERIOD_S, np.full(end, duty), speed[:end, fan], onset=end - 6)
        found.append(probabilities(standstill_causes(window, HEALTHY, BALANCE, tacho)))
    return found


def probabilities(ranked: tuple[RankedCause, ...]) -> dict[str, float]:
    return {each.cause: each.probability for each in ranked}


@pytest.mark.parametrize("window_s", [0.5, 1.0])
@pytest.mark.parametrize("duty", [PLATEAU, HIGH])
def test_a_fan_without_power_is_told_from_a_blocked_one(duty: float, window_s: float) -> None:
    for is_blocked, cause in ((True, "blocked"), (False, "no_power")):
        found = causes(duty, window_s, is_blocked=is_blocked)
        first = [max(each, key=lambda name: each[name]) for each in found]
        wrong = [each for each, name in zip(found, first, strict=True) if name != cause]
        assert len(wrong) <= 0.25 * FANS
        assert all(max(each.values()) < 0.6 for each in wrong), "where it is wrong, it is not sure"
    assert np.mean([each["no_power"] for each in found]) > 0.7


def test_where_the_readings_do_not_tell_neither_is_ruled_out() -> None:
    """Readings that are missing while the fan comes to rest."""
    speed = np.where(np.arange(200) < 150, 31.0, np.nan)
    speed[185:] = 0.0
    window = Window(PERIOD_S, np.full(200, PLATEAU), speed, onset=190)
    found = probabilities(standstill_causes(window, HEALTHY, BALANCE, Tacho(kind="count", window_s=1.0)))
    assert 0.2 < found["no_power"] < found["blocked"] < 0.55


def test_a_recording_of_before_keeps_its_causes() -> None:
    speed = np.where(np.arange(200) < 190, 31.0, 0.0)
    window = Window(PERIOD_S, np.full(200, PLATEAU), speed, onset=190)
    tacho = Tacho(kind="count", window_s=1.0)
    found = probabilities(standstill_causes(window, HEALTHY, BALANCE, tacho, by_course=False))
    assert found == pytest.approx({"blocked": 0.622, "no_tacho": 0.249, "no_power": 0.129}, abs=0.001)

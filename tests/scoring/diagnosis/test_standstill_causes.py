"""scoring.diagnosis.standstill_causes: a blocked fan and one without power, by the readings of a counting tacho."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from schemas.standstill import Standstill
from schemas.tacho import Tacho
from scoring.diagnosis.diagnosis import RankedCause
from scoring.diagnosis.regression_window import HealthyBalance, Window
from scoring.diagnosis.standstill_causes import coming_to_rest, standstill_causes
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
OF_TURNING = (RankedCause("gain_down", 0.8, None, ""), RankedCause("cannot_tell", 0.2, None, ""))
Floats = NDArray[np.float64]


def readings(duty: float, tacho: Tacho, damage: Callable[[NDArray[np.bool_]], FourPinDamage]) -> tuple[Floats, Floats]:
    """(n, FANS) of fans of which each has a fault from FAULT_S on, or up to a second later; and since when, (FANS,)."""
    fault_s = FAULT_S + np.random.default_rng(1).random(FANS)
    fans = FourPinFans(four_pin_tray(FANS, 2), np.random.default_rng(3), 1)
    counter = CountingTacho((tacho,) * FANS, 0.0, 0.0, np.random.default_rng(4))
    readings = []
    for number in range(round((FAULT_S + 10.0) / PERIOD_S)):
        now_s, before = number * PERIOD_S, fans.speed_rad_s
        fans.damage = damage(now_s >= fault_s)
        fans.advance(np.full(FANS, duty), PERIOD_S)
        counter.turn(now_s, before, now_s + PERIOD_S, fans.speed_rad_s)
        readings.append(counter.reading_rad_s.copy())
    return np.array(readings), fault_s


def blocked(is_faulty: NDArray[np.bool_]) -> FourPinDamage:
    return FourPinDamage(is_blocked=is_faulty)


def unpowered(is_faulty: NDArray[np.bool_]) -> FourPinDamage:
    return FourPinDamage(is_unpowered=is_faulty)


def slowed(is_faulty: NDArray[np.bool_]) -> FourPinDamage:
    """To half of the speed."""
    return FourPinDamage(speed_factor=np.where(is_faulty, 0.5, 1.0))


def causes(duty: float, window_s: float, *, is_blocked: bool) -> list[dict[str, float]]:
    """Of several fans, half a second after each reads as if it stood."""
    tacho = Tacho(kind="count", window_s=window_s)
    speed, fault_s = readings(duty, tacho, blocked if is_blocked else unpowered)
    began = np.arange(len(speed))[:, np.newaxis] * PERIOD_S > fault_s
    stands = ((speed < HEALTHY.standing_below_rad_s) & began).argmax(axis=0) + 6
    found = []
    for fan, end in enumerate(stands.tolist()):
        window = Window(PERIOD_S, np.full(end, duty), speed[:end, fan], onset=end - 6)
        found.append(probabilities(standstill_causes(window, HEALTHY, BALANCE, tacho)))
    return found


def first_after(
    duty: float, window_s: float, damage: Callable[[NDArray[np.bool_]], FourPinDamage], after_s: float
) -> list[str]:
    """The cause named first of each fan so long after its fault, where those of a fan that turns name a weak drive."""
    tacho = Tacho(kind="count", window_s=window_s)
    speed, fault_s = readings(duty, tacho, damage)
    named = []
    for fan, fault in enumerate(fault_s.tolist()):
        end = round((fault + after_s) / PERIOD_S)
        window = Window(PERIOD_S, np.full(end, duty), speed[:end, fan], onset=end - 10)
        rest = coming_to_rest(window, HEALTHY, BALANCE, tacho)
        ranked = rest.beside(OF_TURNING) if rest else OF_TURNING
        assert sum(probabilities(ranked).values()) == pytest.approx(1.0)
        named.append(ranked[0].cause)
    return named


def probabilities(ranked: tuple[RankedCause, ...]) -> dict[str, float]:
    return {each.cause: each.probability for each in ranked}


@pytest.mark.parametrize(("duty", "window_s"), [(PLATEAU, 1.0), (HIGH, 0.5)])
def test_a_fan_without_power_is_told_from_a_blocked_one(duty: float, window_s: float) -> None:
    for is_blocked, cause in ((True, "blocked"), (False, "no_power")):
        found = causes(duty, window_s, is_blocked=is_blocked)
        first = [max(each, key=lambda name: each[name]) for each in found]
        wrong = [each for each, name in zip(found, first, strict=True) if name != cause]
        assert len(wrong) <= 0.25 * FANS
        assert all(max(each.values()) < 0.6 for each in wrong), "where it is wrong, it is not sure"
    assert np.mean([each["no_power"] for each in found]) > 0.7


@pytest.mark.parametrize(("duty", "window_s"), [(PLATEAU, 1.0), (HIGH, 0.5)])
def test_no_power_is_named_while_the_fan_coasts(duty: float, window_s: float) -> None:
    assert set(first_after(duty, window_s, unpowered, 3.0)) == {"no_power"}
    for after_s in (1.0, 1.5, 2.0, 2.5):
        assert "blocked" not in first_after(duty, window_s, unpowered, after_s)


@pytest.mark.parametrize(("duty", "window_s"), [(PLATEAU, 1.0), (HIGH, 0.5)])
def test_a_blocked_fan_is_not_named_as_one_without_power_while_its_reading_falls(duty: float, window_s: float) -> None:
    for after_s in (window_s / 2, window_s, 2 * window_s):
        assert "no_power" not in first_after(duty, window_s, blocked, after_s)
    assert first_after(duty, window_s, blocked, 2.5).count("blocked") >= 0.75 * FANS


@pytest.mark.parametrize(("duty", "window_s"), [(PLATEAU, 1.0), (HIGH, 0.5)])
def test_a_fan_that_slows_down_to_another_speed_has_the_causes_of_one_that_turns(duty: float, window_s: float) -> None:
    for after_s in (1.0, 2.0, 3.0, 5.0, 8.0):
        assert not {"no_power", "blocked", "no_tacho"} & set(first_after(duty, window_s, slowed, after_s))
    assert set(first_after(duty, window_s, slowed, 8.0)) == {"gain_down"}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    ("before", "after", "coast_s"),
    [(HIGH, 0.0, 1.25), (HIGH, HIGH, None), (0.0, HIGH, 1.25)],
    ids=["it is stopped", "no coast is known", "it had just started"],
)
def test_a_fan_may_slow_down_without_coming_to_rest_by_a_fault(before: float, after: float, coast_s: float) -> None:
    healthy = HEALTHY.model_copy(update={"coast_time_constant_s": coast_s})
    number = np.arange(400)
    command = np.where(number < 320, before, after)
    speed = np.where(number < 320, 200.0 * (before > 0.0), np.where(number < 380, 200.0, 60.0))
    window = Window(PERIOD_S, command, speed, onset=380)
    for tacho in (Tacho(kind="count", window_s=0.5), Tacho()):
        assert coming_to_rest(window, healthy, BALANCE, tacho) is None


def test_where_the_readings_do_not_tell_neither_is_ruled_out() -> None:
    """Readings that are missing while the fan comes to rest."""
    speed = np.where(np.arange(200) < 150, 31.0, np.nan)
    speed[185:] = 0.0
    window = Window(PERIOD_S, np.full(200, PLATEAU), speed, onset=190)
    found = probabilities(standstill_causes(window, HEALTHY, BALANCE, Tacho(kind="count", window_s=1.0)))
    assert 0.2 < found["no_power"] < found["blocked"] < 0.55

"""scoring.diagnosis: what a measured supply voltage says of the cause."""

from __future__ import annotations

import numpy as np

from schemas.tacho import Tacho
from scoring.diagnosis.diagnosis import diagnose
from scoring.diagnosis.regression_window import Window
from scoring.diagnosis.standstill_causes import standstill_causes
from tests.scoring.diagnosis.test_standstill_causes import BALANCE, FAULT_S, PERIOD_S, probabilities
from tests.scoring.diagnosis.test_standstill_causes import HEALTHY as STANDSTILL
from tests.support.diagnosis_data import HEALTHY, NOISE_RAD_S, STEP_S, moving_command, onset_of, speeds

FELL, STAYED = 0.1, 12.0


def stood(supply_v_after: float | None) -> Window:
    """A fan that came to rest between coasting and stopping at once; the supply, V, after that."""
    samples, fault = round((FAULT_S + 6.0) / PERIOD_S), round(FAULT_S / PERIOD_S)
    since_s = PERIOD_S * np.arange(samples) - FAULT_S
    speed = 150.0 * np.exp(-np.maximum(since_s, 0.0) / 0.35)
    supply_v = None
    if supply_v_after is not None:
        supply_v = np.where(np.arange(samples) < fault, 12.0, supply_v_after)
        supply_v[::3] = np.nan
    return Window(PERIOD_S, np.full(samples, 0.8), speed, onset=fault, supply_voltage_v=supply_v)


def test_a_lost_supply_says_no_power_and_a_supply_that_is_there_says_blocked() -> None:
    tacho = Tacho()
    unknown = probabilities(standstill_causes(stood(None), STANDSTILL, BALANCE, tacho))
    lost = standstill_causes(stood(FELL), STANDSTILL, BALANCE, tacho)
    there = standstill_causes(stood(STAYED), STANDSTILL, BALANCE, tacho)
    assert lost[0].cause == "no_power"
    assert lost[0].probability > max(0.9, unknown["no_power"])
    assert lost[0].sentence.endswith("; its supply has 0.1 V and had 12 V")
    assert probabilities(there)["no_power"] < 0.3 * unknown["no_power"]
    assert there[0].sentence.endswith("; its supply has 12 V")


def test_a_supply_that_is_nowhere_known_changes_nothing() -> None:
    window = stood(float("nan"))
    assert window.supply_voltage_v is not None
    window.supply_voltage_v[:] = np.nan
    without = standstill_causes(stood(None), STANDSTILL, BALANCE, Tacho())
    assert standstill_causes(window, STANDSTILL, BALANCE, Tacho()) == without


def test_where_the_supply_is_allowed_for_less_drive_is_less_probable_and_says_so() -> None:
    seed = 0
    command = moving_command(seed)
    onset = onset_of(command)
    weak = np.where(np.arange(len(command)) < onset, 1.0, 0.9)
    noise = NOISE_RAD_S * np.random.default_rng(seed).normal(size=len(command))
    window = Window(STEP_S, command, speeds(command, gain=weak) + noise, onset)
    blind = next(each for each in diagnose(window, HEALTHY).causes if each.cause == "gain_down")
    knows = next(each for each in diagnose(window, HEALTHY, knows_supply=True).causes if each.cause == "gain_down")
    assert knows.probability <= blind.probability
    assert knows.sentence.endswith("beyond the supply voltage, which is measured")
    assert not blind.sentence.endswith("measured")

"""simulation.plant: a supply that wanders and air that warms, and what is measured of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from bench.detection.tray_run import samples_of
from fantwin.schemas.device_sample import DeviceSample
from fantwin.simulation.faults import Fault
from fantwin.simulation.plant import Surroundings
from fantwin.simulation.tacho import NoisyTacho, TachoSettings
from fantwin.simulation.tray import TraySettings

DUTY = 0.7
ALL = ("supply_voltage_v", "current_a", "temperature_c")
STILL = TraySettings(
    fans=2, rate_hz=20.0, duration_s=12.0, tacho=TachoSettings(noise=NoisyTacho(0.0)), fan_variation=0.0
)


def last(settings: TraySettings) -> DeviceSample:
    return samples_of(settings, DUTY)[-1]


def test_without_surroundings_samples_are_as_before_and_have_no_columns() -> None:
    plain = samples_of(STILL, DUTY)
    assert all(not sample.auxiliary for sample in plain)
    measured = samples_of(replace(STILL, surroundings=Surroundings(measured=ALL)), DUTY)
    for one, other in zip(plain, measured, strict=True):
        np.testing.assert_array_equal(one.speed_rad_s, other.speed_rad_s)
    assert list(measured[0].auxiliary) == [*ALL]


def test_warm_air_drags_less_and_a_fault_of_the_supply_shows_in_its_voltage() -> None:
    cold = last(STILL)
    warm = last(replace(STILL, surroundings=Surroundings(temperature_c=60.0, measured=ALL)))
    assert np.all(warm.speed_rad_s > 1.01 * cold.speed_rad_s)
    np.testing.assert_allclose(warm.auxiliary["temperature_c"], 60.0, atol=1.0)
    sagging = replace(STILL, faults=(Fault("supply", 1, 5.0, size=0.8),), surroundings=Surroundings(measured=ALL))
    np.testing.assert_allclose(last(sagging).auxiliary["supply_voltage_v"], [12.0, 9.6], atol=0.2)


FOUR_PIN = replace(STILL, fan="4-pin", surroundings=Surroundings(measured=("supply_voltage_v", "temperature_c")))


def test_4_pin_fans_follow_a_supply_that_wanders_only_where_they_do_not_hold_their_speed() -> None:
    wanders = Surroundings(supply_wander=0.05, supply_wander_s=1e4, measured=("supply_voltage_v",))
    steady = last(replace(FOUR_PIN, surroundings=Surroundings())).speed_rad_s
    held = last(replace(FOUR_PIN, surroundings=wanders))
    follows = last(replace(FOUR_PIN, surroundings=replace(wanders, supply_held=0.0)))
    share = follows.auxiliary["supply_voltage_v"] / 12.0
    assert np.all(np.abs(share - 1.0) > 0.02)
    np.testing.assert_allclose(held.speed_rad_s / steady, 1.0, atol=0.005)
    np.testing.assert_allclose(follows.speed_rad_s / steady, share, atol=0.01)

"""The simulated plant: its motion, its clock and samples, a supply that wanders and air that warms."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from bench.detection.tray_run import samples_of
from fantwin.schemas.device_sample import DeviceSample
from fantwin.simulation.errors import SimulationError
from fantwin.simulation.faults import Fault
from fantwin.simulation.plant import (
    DeviceClock,
    Disturbance,
    FanParameters,
    PlantState,
    Surroundings,
    advance,
    at_rest,
    drive,
    tray_of_fans,
)
from fantwin.simulation.tacho import NoisyTacho, TachoSettings
from fantwin.simulation.tray import SimulatedTray, TraySettings

ONE, BASE = tray_of_fans(1, seed=0, fan_variation=0.0), FanParameters()


def friction_v(speed_rad_s: np.ndarray, parameters: FanParameters) -> np.ndarray | float:
    """(fans,) magnitude of Coulomb and Stribeck friction, V; at standstill its largest value."""
    rise = np.exp(-np.square(speed_rad_s / parameters.stribeck_rad_s))
    return parameters.coulomb_v + (parameters.breakaway_v - parameters.coulomb_v) * rise


def settle(duty: float, parameters: FanParameters = ONE, disturbance: Disturbance | None = None) -> float:
    state = advance(at_rest(1), np.array([duty]), 20.0, parameters, disturbance or Disturbance())
    return float(state.speed_rad_s[0])


def test_a_turning_fan_follows_the_equation_of_motion() -> None:
    base = BASE

    def motion(_t: float, x: np.ndarray) -> list[float]:
        w, current = x
        target = 12.0 * float(drive(np.array(0.7), base))
        friction = float(friction_v(np.array(w), base))
        return [(current - base.alpha * w - base.C_D * w * w - friction) / base.J, (target - current) / base.lag_s]

    times = np.linspace(0.1, 3.0, 30)
    exact = solve_ivp(motion, (0.0, 3.0), [100.0, 2.0], t_eval=times, rtol=1e-9, atol=1e-9).y[0]
    state = PlantState(np.array([100.0]), np.array([2.0]))
    found = []
    for step in np.diff(times, prepend=0.0):
        state = advance(state, np.array([0.7]), step, ONE)
        found.append(state.speed_rad_s[0])
    assert np.abs(np.array(found) - exact).max() < 0.05


def just_enough_for(torque_v: float) -> float:
    dead, full = float(BASE.duty_dead), float(BASE.duty_full)
    return dead + torque_v / 12.0 * (full - dead)


def test_a_rotor_stands_exactly_still_below_breakaway_and_starts_above_it() -> None:
    breakaway_v = float(BASE.breakaway_v)
    assert settle(just_enough_for(0.98 * breakaway_v)) == 0.0
    assert settle(just_enough_for(1.02 * breakaway_v)) > 1.0


def test_fans_vary_as_asked_and_the_seed_determines_how_but_never_so_far_that_a_parameter_is_negative() -> None:
    tray = tray_of_fans(2000, seed=3, fan_variation=0.03)
    assert np.std(tray.J) / 0.0148 == pytest.approx(0.03, rel=0.1)
    assert np.mean(tray.C_D) == pytest.approx(5.4772e-6, rel=0.01)
    assert np.abs(np.asarray(tray.alpha) / 0.0074 - 1.0).max() <= 0.09 + 1e-12
    assert np.array_equal(tray.J, tray_of_fans(2000, seed=3, fan_variation=0.03).J)
    assert not np.array_equal(tray.J, tray_of_fans(2000, seed=4, fan_variation=0.03).J)
    assert np.all(tray_of_fans(5, seed=3, fan_variation=0.0).J == 0.0148)
    with pytest.raises(SimulationError, match=r"fan_variation = 0\.5"):
        tray_of_fans(2, seed=0, fan_variation=0.5)


def test_the_device_clock_wraps_at_32_bits_and_drifts_as_set() -> None:
    assert DeviceClock().at(4294.967295) == 2**32 - 1
    assert DeviceClock().at(4294.967296) == 0
    assert DeviceClock(drift_ppm=50.0).at(1000.0) == 1_000_050_000
    assert DeviceClock(drift_ppm=-50.0).at(1000.0) == 999_950_000
    assert DeviceClock(start_us=2**32 - 1).at(1e-6) == 0


def test_the_same_fans_can_be_run_with_other_commands() -> None:
    first, again, others = (
        SimulatedTray(TraySettings(seed=seed, fans_seed=fans)) for seed, fans in ((1, 5), (2, 5), (1, 6))
    )
    inertia = [dataclasses.asdict(tray.parameters)["J"] for tray in (first, again, others)]
    assert np.array_equal(inertia[0], inertia[1])
    assert not np.array_equal(inertia[0], inertia[2])
    assert not np.array_equal(first.take().command, again.take().command)
    assert np.array_equal(
        SimulatedTray(TraySettings()).take().command, SimulatedTray(TraySettings(fans_seed=6)).take().command
    )


def test_a_lost_sample_uses_up_its_sequence_number() -> None:
    samples = samples_of(TraySettings(fans=1, duration_s=20.0, lost=0.1))
    assert [s.sequence for s in samples] == list(range(2000))
    assert sum(s.lost for s in samples) == pytest.approx(200, abs=45)


def test_sampling_times_scatter_by_the_jitter_around_a_schedule_that_does_not_drift() -> None:
    samples = samples_of(TraySettings(fans=1, duration_s=20.0, jitter_us=500.0))
    error_s = np.array([s.t_s for s in samples]) - np.arange(2000) / 100.0
    assert error_s.std() == pytest.approx(500e-6, rel=0.1)
    assert abs(error_s.mean()) < 50e-6
    assert np.all(np.diff([s.t_s for s in samples]) > 0.0)


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

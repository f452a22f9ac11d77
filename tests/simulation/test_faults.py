"""The faults of simulated fans, and the profiles that command them."""

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.detection.tray_run import run_of
from fantwin.simulation.errors import SimulationError
from fantwin.simulation.excitation import PROFILES, Staircase, excitation
from fantwin.simulation.faults import Fault, parse_fault
from fantwin.simulation.tacho import NoisyTacho, TachoSettings
from fantwin.simulation.tray import SimulatedTray, TraySettings

QUIET = TraySettings(
    fans=2,
    duration_s=12.0,
    profile="staircase",
    fan_variation=0.0,
    jitter_us=0.0,
    tacho=TachoSettings(noise=NoisyTacho(0.0, 0.0)),
)


def speeds(*faults: str) -> np.ndarray:
    """(n, 2) speeds of two equal fans at one duty, the first with the faults."""
    return run_of(replace(QUIET, faults=tuple(map(parse_fault, faults))), 0.6).speed_rad_s


@pytest.mark.parametrize(
    "fault",
    [
        "inlet:fan=0,start=5,stop=8,size=1.6",
        "rotor:fan=0,start=5,stop=8,size=1.0",
        "wear:fan=0,start=5,stop=8,size=1.0",
        "supply:fan=0,start=5,stop=8,size=0.8",
    ],
)
def test_a_braking_fault_slows_only_its_fan_and_only_while_it_is_active(fault: str) -> None:
    run = speeds(fault)
    lag = run[:, 1] - run[:, 0]
    assert np.all(lag[:501] == 0.0)
    assert lag[800] > 20.0
    assert abs(lag[-1]) < 0.2 * lag[800]  # it recovers after the fault


def test_wear_grows_slowly_from_nothing() -> None:
    fault = parse_fault("wear:fan=1,start=10,stop=30,size=0.8")
    assert [round(fault.size_at(t), 6) for t in (10.0, 15.0, 20.0, 30.0)] == [0.0, 0.2, 0.4, 0.8]


def test_a_stuck_tacho_repeats_its_last_reading_until_the_fault_ends() -> None:
    run = speeds("tacho-stuck:fan=0,start=1,stop=3")
    assert np.all(run[100:300, 0] == run[99, 0])
    assert run[99, 0] != run[100, 1]
    assert run[300, 0] == run[300, 1]


def test_the_tray_reports_when_a_fault_really_began_and_ended() -> None:
    fault = parse_fault("inlet:fan=0,start=1.003,stop=2.001")
    tray = SimulatedTray(replace(QUIET, faults=(fault, parse_fault("rotor:fan=1,start=5"))))
    assert tray.happened(0) == (None, None)
    while (due_s := tray.due_s()) is not None and due_s < 4.0:
        tray.take()
    assert tray.happened(0) == (pytest.approx(1.01), pytest.approx(2.01))
    assert tray.happened(1) == (None, None)


def test_a_fault_is_read_from_the_command_line() -> None:
    assert parse_fault("inlet:fan=2,start=10,stop=18,size=1.6") == Fault("inlet", 2, 10.0, 18.0, 1.6)
    assert parse_fault("rotor:fan=0") == Fault("rotor", 0, 0.0, math.inf, 1.0)
    assert parse_fault("tacho-stuck:fan=1,start=3") == Fault("tacho-stuck", 1, 3.0, math.inf, None)


TIMES_S = np.arange(0.0, 130.0, 0.05)


def played(profile: str, fans: int = 3, seed: int = 1) -> np.ndarray:
    source = excitation(profile, fans, seed, low=0.2, high=0.8)
    return np.array([source.command(t) for t in TIMES_S])


@pytest.mark.parametrize("profile", [name for name in PROFILES if name != "thermostat"])  # which stops fans
def test_every_profile_stays_in_its_range_and_uses_most_of_it(profile: str) -> None:
    commands = played(profile)
    assert commands.shape == (len(TIMES_S), 3)
    assert commands.min() >= 0.2
    assert commands.max() <= 0.8
    assert np.all(np.ptp(commands, axis=0) > 0.4)


@pytest.mark.parametrize("profile", PROFILES)
def test_every_profile_is_the_same_for_the_same_seed_and_differs_for_another_and_between_fans(profile: str) -> None:
    commands = played(profile)
    assert np.array_equal(commands, played(profile))
    assert not np.array_equal(commands, played(profile, seed=2))
    assert not np.array_equal(commands[:, 0], commands[:, 1])


def test_a_staircase_holds_each_level_and_changes_by_one_step() -> None:
    stairs = Staircase(1, seed=0, low=0.0, high=0.8, steps=8, hold_s=1.0)
    levels = np.array([stairs.command(t + 0.5)[0] for t in range(16)])
    assert np.allclose(np.abs(np.diff(levels)), 0.1)
    assert set(np.round(levels, 6)) == set(np.round(np.linspace(0.0, 0.8, 9), 6))
    assert stairs.command(3.01)[0] == stairs.command(3.99)[0]


def test_an_empty_range_is_refused() -> None:
    with pytest.raises(SimulationError, match=r"commands from 0.5 to 0.5"):
        excitation("manual", 1, 0, low=0.5, high=0.5)

import math
from dataclasses import replace

import numpy as np
import pytest

from bench.detection.tray_run import run_of
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

import numpy as np
import pytest

from fantwin.simulation.errors import SimulationError
from fantwin.simulation.excitation import PROFILES, Staircase, excitation

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

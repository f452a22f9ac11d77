"""Missing readings: a healthy line keeps the declared rate, and a loose wire is one alarm."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import poisson

from fantwin.schemas.messages import Array
from fantwin.scoring.model.missing_readings import MissingReadings

FANS, DECLARED = 200, 2000
SURE = 0.999


def counts(missing: Array, before: Array) -> Array:
    """(fans, 4) of one reading each: whether it and the one before are missing."""
    return np.stack((~before, ~before & missing, before, before & missing), axis=1).astype(float)


def alarms(
    declared: float, share: float, again: float, readings: int, begins: int = 0, ends: int = 0, burst: int = 0
) -> list[Array]:
    """Where alarms are active, (fans,) of each reading.

    declared: readings between false alarms; share, again: that is lost after a reading, and after a lost one; between
    `begins` and `ends` a third of all; burst: of which so many first.
    """
    rng, found = np.random.default_rng(3), []
    line, before = MissingReadings(FANS, 0.2, math.log(declared)), np.zeros(FANS, np.bool_)
    for number in range(readings):
        chance = np.where(before, again, share) if not begins <= number < ends else 0.35
        missing = (rng.random(FANS) < chance) | (begins <= number < begins + burst)
        line.take(counts(missing, before))
        before = missing
        found.append(line.is_active.copy())
    return found


def test_a_healthy_line_that_loses_readings_also_in_bursts_keeps_the_declared_rate() -> None:
    for share, again in ((0.002, 0.1), (0.002, 0.3)):
        active = np.array(alarms(DECLARED, share, again, 1000))
        raised = int((active[1:] & ~active[:-1]).sum())
        assert raised <= poisson.ppf(SURE, active.size / DECLARED)


@pytest.mark.parametrize("burst", [0, 6], ids=["at random", "with a burst first"])
def test_a_loose_wire_is_one_alarm_of_a_few_seconds_delay_that_ends_once_after_it(burst: int) -> None:
    active = np.array(alarms(1e8, 0.001, 0.1, 900, begins=200, ends=600, burst=burst)).astype(int)
    changes = np.diff(active, axis=0)
    assert ((changes == 1).sum(axis=0) == 1).mean() > 0.99
    assert 200 < np.median(np.argwhere(changes == 1)[:, 0]) < 240
    assert 600 < np.median(np.argwhere(changes == -1)[:, 0]) < 660
    assert not active[-1].any()


def played(line: MissingReadings, lost: Array) -> Array:
    """Where alarms are active, (n, fans). lost: (n, fans) whether each reading is missing."""
    before, found = np.zeros(lost.shape[1], np.bool_), []
    for missing in lost:
        line.take(counts(missing, before))
        before = missing
        found.append(line.is_active.copy())
    return np.array(found)


def test_bursts_of_seconds_on_a_fast_line_are_one_alarm() -> None:
    line, rng = MissingReadings(1, 0.01, math.log(1e8)), np.random.default_rng(4)
    is_burst = np.arange(7000) % 250 >= 150
    active = played(line, (is_burst & (rng.random(7000) < 0.7))[:, np.newaxis])
    assert np.diff(active[:, 0].astype(int)).tolist().count(1) == 1 and active[-1, 0]

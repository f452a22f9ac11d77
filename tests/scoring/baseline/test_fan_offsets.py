"""scoring.baseline.fan_offsets: the mean residual of each fan over speed, apart from days and noise."""

import numpy as np
import pytest

from scoring.baseline.fan_offsets import Cells, fan_offsets
from scoring.baseline.healthy_residual import FanOffsets

BINS, STEP_S = 6, 0.01
CENTRES = np.arange(BINS) * 100.0 + 50.0


def runs_of(offsets: np.ndarray, days: int, noise: float, seed: int = 1, seen: float = 1.0) -> list[Cells]:
    """Daily runs of fans with `offsets` (fans, bins) and a constant per day and fan; bins seen by chance for 20 s."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(days):
        count = np.where(rng.random(offsets.shape) < seen, 2000.0, 0.0)
        of_day = rng.normal(0.0, 1.0, (len(offsets), 1))
        made.append(
            Cells(range(len(offsets)), count, count * (offsets + of_day + rng.normal(0.0, noise, offsets.shape)))
        )
    return made


def without_its_mean(table: np.ndarray) -> np.ndarray:
    """The part of a table that remains after a baseline, which is constant over speed."""
    return table - table.mean(axis=1, keepdims=True)


def found_of(runs: list[Cells]) -> np.ndarray:
    found = fan_offsets(runs, CENTRES, STEP_S)
    assert found is not None
    return without_its_mean(np.array(found.offset_sigmas))


def test_an_offset_of_every_day_is_found_despite_daily_noise() -> None:
    offsets = without_its_mean(np.random.default_rng(2).normal(0.0, 1.0, (10, BINS)))
    np.testing.assert_allclose(found_of(runs_of(offsets, 12, noise=0.0)), offsets, atol=1e-3)
    error = found_of(runs_of(offsets, 24, noise=0.2, seen=0.5)) - offsets
    assert np.sqrt(np.mean(error**2)) < 0.15


def test_variation_from_day_to_day_is_not_attributed_to_the_fans() -> None:
    alike = np.tile(np.linspace(-1.0, 1.0, BINS), (50, 1))
    found = found_of(runs_of(alike, 12, noise=0.9))
    assert np.sqrt(np.mean((found - alike) ** 2)) < 0.1, "means of twelve days are off by 0.26"


def test_three_nights_are_enough_and_two_are_not() -> None:
    offsets = without_its_mean(np.random.default_rng(4).normal(0.0, 1.0, (4, BINS)))
    nights = [
        Cells(run.known_as, 150.0 * run.count, 150.0 * run.total) for run in runs_of(offsets, 3, noise=0.1, seen=0.9)
    ]
    assert np.sqrt(np.mean((found_of(nights) - offsets) ** 2)) < 0.15
    assert fan_offsets(nights[:2], CENTRES, STEP_S) is None


def test_a_table_with_a_hole_is_refused() -> None:
    with pytest.raises(ValueError, match="one value for each"):
        FanOffsets(speeds_rad_s=(1.0, 2.0), offset_sigmas=((0.0, 0.0), (0.0,)))
    with pytest.raises(ValueError, match="ascending order"):
        FanOffsets(speeds_rad_s=(2.0, 1.0), offset_sigmas=((0.0, 0.0),))

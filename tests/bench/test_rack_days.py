"""bench.detection.rack_days: days that are simulated together are those of one long run."""

from __future__ import annotations

import numpy as np
import pytest

from bench.detection import rack_days
from bench.detection.plant import START_NS
from bench.detection.rack_days import reports_by_days
from bench.detection.racks import RACK_FANS, Racks, racks, reports
from schemas.messages import Array, Raw
from simulation.faults import Fault

DAY_S, DAYS, RATE_HZ = 3600.0, 2, 2.0
ROWS = round(DAY_S * DAYS * RATE_HZ)
FAULTS = [Fault("blocked", 1, 1800.0, 5400.0), Fault("blade", 6, 3000.0, 3900.0, 0.3)]
"""over midnight, and one that ends after it"""


def ageing(t_s: float) -> Array:
    return np.full(2 * RACK_FANS, 1.0 - 0.2 * t_s / (DAY_S * DAYS))


def table(blocks: list[list[Raw]]) -> tuple[Array, Array, Array]:
    """(rows, columns) commands, readings and host times in s; NaN where a line was lost."""
    command, speed, host_s = (np.full((ROWS, 2 * RACK_FANS), np.nan) for _ in range(3))
    for rack, raw in ((rack, raw) for racks_blocks in blocks for rack, raw in enumerate(racks_blocks)):
        fans = slice(rack * RACK_FANS, (rack + 1) * RACK_FANS)
        command[raw.device_sequence, fans], speed[raw.device_sequence, fans] = raw.command, raw.speed_rad_s
        host_s[raw.device_sequence, fans] = ((raw.host_receive_t_ns - START_NS) / 1e9)[:, np.newaxis]
    return command, speed, host_s


def of_two_days() -> Racks:
    return racks(2, DAY_S * DAYS, seed=3)


def test_days_side_by_side_are_one_long_run(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rack_days, "DAY_S", DAY_S)
    done: list[float] = []
    command, speed, host_s = table(list(reports_by_days(of_two_days(), RATE_HZ, FAULTS, ageing, done.append)))
    expected_command, expected_speed, _ = table(list(reports(of_two_days(), RATE_HZ, FAULTS, ageing=ageing)))
    both = np.isfinite(command) & np.isfinite(expected_command)
    assert both.mean() > 0.99
    np.testing.assert_allclose(command[both], expected_command[both])
    late_s = host_s - np.arange(ROWS)[:, np.newaxis] / RATE_HZ
    assert 0.0 <= np.nanmin(late_s) <= np.nanmax(late_s) <= 0.0041
    difference = np.abs(speed - expected_speed)
    assert np.nanmedian(difference) < 3.0, "rad/s: a count of a tacho, and the wandering of the speed"
    around_midnight = slice(round(DAY_S * RATE_HZ) - 20, round(DAY_S * RATE_HZ) + 20)
    assert np.nanmax(difference[around_midnight]) < 15.0, "fans are at their speeds when a day begins"
    blocked = slice(round(1810.0 * RATE_HZ), round(5390.0 * RATE_HZ))
    assert np.nanmax(speed[blocked, 1]) == 0.0
    assert done[-1] == 1.0

"""Fans that are not scored are reported with the reason."""

import numpy as np

from schemas.units import NS_PER_S
from scoring.alarms.unscored_monitor import UnscoredMonitor


def test_a_reason_of_a_newer_twin_integrator_is_reported_with_its_number():
    monitor = UnscoredMonitor(2, NS_PER_S)
    monitor.update(NS_PER_S, np.zeros((3, 2), np.bool_), np.full((3, 2), 99, np.uint8))
    assert "unknown (99)" in monitor.problem()

"""pipeline.runtime.modelled_fans: what the card of a twin says of a fan's drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipeline.runtime.healthy_twin import known_of
from schemas.tacho import INSTANTANEOUS, Tacho, tacho_of_each_fan
from tests.stages.test_twin_integrator import physical_twin

COUNTING = (Tacho(kind="count", pulses=2, window_s=1.0),)


@pytest.mark.parametrize(("tachos", "expected"), [(COUNTING, [True, False]), (INSTANTANEOUS, [False, False])])
def test_a_fan_whose_tacho_counts_and_whose_torque_is_that_of_no_rotor_controls_its_speed_by_itself(
    tachos: tuple[Tacho, ...], expected: list[bool]
) -> None:
    twin = physical_twin(2)
    balance = replace(twin.balance, viscous=np.full(2, 1.0), drag=np.array([-1e-4, 1e-3]))
    known = known_of(replace(twin, tachos=tacho_of_each_fan(tachos, 2), balance=balance))
    assert known.fans.has_own_drive.tolist() == expected
    assert [fan.has_own_drive for fan in known.steady_fans] == expected

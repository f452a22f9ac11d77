"""pipeline.tray_scoring.healthy_twin: what the card of a twin says of a fan's drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fantwin.pipeline.tray_scoring.healthy_twin import known_of
from fantwin.schemas.tacho import INSTANTANEOUS, Tacho, tacho_of_each_fan
from tests.support.integrated_twins import physical_twin

COUNTING = (Tacho(kind="count", pulses=2, window_s=1.0),)
AVERAGING = (Tacho(kind="average", window_s=1.0),)


@pytest.mark.parametrize(
    ("tacho", "drag", "expected"),
    [(COUNTING, -1e-4, True), (COUNTING, 0.0, False), (INSTANTANEOUS, -1e-4, False), (AVERAGING, -1e-4, False)],
)
def test_fans_whose_tachos_count_and_whose_torque_is_that_of_no_fan_control_their_speed_by_themselves(
    tacho: tuple[Tacho, ...], drag: float, expected: bool
) -> None:
    twin = physical_twin(2)
    balance = replace(twin.balance, viscous=np.full(2, 1.0), drag=np.array([2.0 * drag, -drag]))
    known = known_of(replace(twin, tachos=tacho_of_each_fan(tacho, 2), balance=balance))
    assert known.fans.has_own_drive.tolist() == [expected] * 2
    assert [fan.has_own_drive for fan in known.steady_fans] == [expected] * 2


def test_whatever_the_torque_balance_says_a_fan_settles_at_a_speed_and_such_a_balance_is_not_preferred() -> None:
    twin = physical_twin(3)
    top = twin.card.top_speed_rad_s
    viscous = np.array([0.05, 0.0, -1.0])
    known = known_of(replace(twin, balance=replace(twin.balance, viscous=viscous, drag=-np.full(3, 0.1 / top))))
    speeds = np.linspace(0.0, 2.0 * top, 9)[:, np.newaxis]
    assert np.all(known.fans.slope(speeds) * top > 0.09 * np.ptp(twin.card.command_range))
    assert not known.fans.prefers_balance.any()

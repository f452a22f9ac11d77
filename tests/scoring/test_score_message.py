"""What a scored sample says of its fan."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fantwin.schemas.enums import FanState
from fantwin.schemas.messages import Prediction
from fantwin.scoring.alarms.alarm_text import RETURNING, words_now
from fantwin.scoring.score_message import ScoreColumns, score_of
from tests.support.made_messages import filled

RPM = np.pi / 30.0


def test_a_fan_in_alarm_that_stands_is_never_called_healthy_again_and_one_that_turns_is() -> None:
    speeds = np.array([[0.0, 0.0, 900.0, 900.0, np.nan]]) * RPM
    given = {"measured_speed_rad_s": speeds, "predicted_speed_rad_s": 900.0 * RPM, "command": 26.0, "sigma_rad_s": 4.0}
    item = filled(Prediction, 1, 5, period_ns=10**9, torque_balance_command=0.1, **given)
    active, well = [[True, False, True, True, True]], [[True, False, True, False, True]]
    of = replace(ScoreColumns.empty(1, 5), is_active=np.array(active), is_returning=np.array(well))
    (states,) = score_of(item, of, np.ones(5, np.bool_), 0.0).state.tolist()
    assert states == [FanState.ALARM, FanState.NORMAL, FanState.RETURNING, FanState.ALARM, FanState.RETURNING]
    assert [words_now(state) == RETURNING for state in states] == [False, False, True, False, True]

"""What is kept of the past of a fleet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fantwin.pipeline.config.models import TrayConfig
from fantwin.pipeline.outputs.rerun.fleet_view import FleetView
from fantwin.pipeline.outputs.rerun.plot_places import FleetPlots, PlotPlaces
from fantwin.schemas.messages import Score
from fantwin.schemas.units import NS_PER_S
from tests.support.score_data import START_NS, made_up_tray

WINDOW_S = 4


def view_of(*trays: str) -> FleetView:
    configured = [TrayConfig(name=name, fans=3) for name in trays]
    return FleetView(configured, PlotPlaces(FleetPlots(), 0), WINDOW_S * NS_PER_S)


def at(seconds: float, tray: str = "tray1") -> Score:
    (score,) = made_up_tray(tray=tray, seconds=0.1, faulty_fan=None, gap_fan=None)[0]
    return replace(score, t_ns=score.t_ns - score.t_ns[-1] + START_NS + round(seconds * NS_PER_S))


@pytest.mark.parametrize("period_s", [0.5, 1.0])
def test_the_history_is_one_window_however_often_samples_come(period_s: float) -> None:
    view = view_of("tray1")
    assert view.history("tray1") == []
    times = np.arange(0.0, 5 * WINDOW_S, period_s)
    for seconds in times:
        view.add_newest(at(seconds))
    kept = [int(score.t_ns[0] - START_NS) / NS_PER_S for score in view.history("tray1")]
    assert kept == [seconds for seconds in times if seconds > times[-1] - WINDOW_S]


def test_the_history_of_a_replay_has_nothing_of_the_live_samples_before_it() -> None:
    view = view_of("tray1")
    for seconds in (1000.0, 1001.0, 3.0, 4.0):
        view.add_newest(at(seconds))
    assert [int(score.t_ns[0] - START_NS) / NS_PER_S for score in view.history("tray1")] == [3.0, 4.0]

"""What is shown of a fleet: what is kept of the past, and at which time the overview is."""

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
    return FleetView("site", configured, PlotPlaces(FleetPlots(), 0), WINDOW_S * NS_PER_S)


def at(seconds: float, tray: str = "tray1") -> Score:
    (score,) = made_up_tray(tray=tray, seconds=0.1, faulty_fan=None, gap_fan=None)[0]
    return replace(score, t_ns=score.t_ns - score.t_ns[-1] + START_NS + round(seconds * NS_PER_S))


@pytest.mark.parametrize("period_s", [0.5, 1.0])
def test_the_history_is_one_window_however_often_samples_come(period_s: float) -> None:
    view = view_of("tray1")
    assert view.history("tray1") == []
    times = np.arange(0.0, 5 * WINDOW_S, period_s)
    for seconds in times:
        view.add_newest([at(seconds)], 0)
    kept = [int(score.t_ns[0] - START_NS) / NS_PER_S for score in view.history("tray1")]
    assert kept == [seconds for seconds in times if seconds > times[-1] - WINDOW_S]


def test_the_history_of_a_replay_has_nothing_of_the_live_samples_before_it() -> None:
    view = view_of("tray1")
    for seconds in (1000.0, 1001.0, 3.0, 4.0):
        view.add_newest([at(seconds)], 0)
    assert [int(score.t_ns[0] - START_NS) / NS_PER_S for score in view.history("tray1")] == [3.0, 4.0]


def test_a_tray_that_is_behind_does_not_set_the_overview_back_and_a_replay_does() -> None:
    view = view_of("tray1", "tray2")
    shown: list[float] = []
    for score in (at(100.0), at(99.0, "tray2"), at(101.0), at(3.0), at(4.0)):
        view.add_newest([score], 0)
        overview = view.overview(0)
        assert overview is not None
        shown.append((overview.t_ns - START_NS) / NS_PER_S)
    assert shown == [100.0, 100.0, 101.0, 3.0, 4.0]

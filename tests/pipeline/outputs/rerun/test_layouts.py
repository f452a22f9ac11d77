"""The layouts: the real Rerun viewer, without a display, opens each beside its view and reports nothing."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.pipeline.outputs.rerun.test_recorded_view import live_view, recorded_view
from tests.pipeline.outputs.rerun.test_viewer_picture import colors, needs_a_driver, rerun_picture
from tests.support.running_chain import eventually
from tests.support.score_data import START_NS

ALL = {
    *(f"tray1 / fan {fan} speed (rad/s)" for fan in range(3)),
    *(f"tray1 / fan {fan} {kind}" for fan in range(3) for kind in ("torque balance", "score")),
    *("temperature (°C)", "state of each fan", "alarms", "alarm log"),
}
ALARMS = {
    *("tray1 / fan 2 speed (rad/s)", "tray1 / fan 2 torque balance", "tray1 / fan 2 score"),
    *("state of each fan", "alarms", "alarm log"),
}
WEAR = {"tray1 / speed since commissioning (%)"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("made", "layout", "names"),
    [
        (recorded_view, "alarms", ALARMS),
        (live_view, "wear", WEAR),
    ],
)
@needs_a_driver
def test_a_layout_of_a_live_view_and_of_a_recording_opens_without_a_report(
    made: Any, layout: str, names: set[str], tmp_path: Path
) -> None:
    with rerun_picture._headless_viewer([made(tmp_path, layout)]) as viewer:
        eventually(lambda: shown(viewer).keys() - {"stages"} == names, f"the views of the layout {layout}")
        rerun_picture._stable_screenshot(viewer, None)
        assert {name: reports for name, reports in shown(viewer).items() if reports} == {}
        assert [entry for entry in viewer.get_logs() if entry.level.lower() in ("warn", "error")] == []


@pytest.mark.slow
@needs_a_driver
def test_without_a_report_all_time_axes_are_linked_and_show_the_window_before_the_cursor(tmp_path: Path) -> None:
    with rerun_picture._headless_viewer([live_view(tmp_path, window_s=1.0)]) as viewer:
        eventually(lambda: shown(viewer).keys() - {"stages"} == ALL, "the views")
        axes = [part["TimeAxis"] for part in viewer.get_blueprint().blueprint.values() if "TimeAxis" in part]
        assert [axis["link"] for axis in axes if "link" in axis] == ["LinkToGlobal"] * (len(ALL) - 2), "but for texts"
        assert len([axis for axis in axes if "view_range" in axis]) == 1
        in_the_hole, after_it = (score_line(viewer, seconds) for seconds in (5.5, 9.0))
        assert {name: reports for name, reports in shown(viewer).items() if reports} == {}
        assert in_the_hole == 0.0 and after_it > 0.005, "the window is a second long, and no samples are from 4 to 6 s"


def score_line(viewer: Any, seconds: float) -> float:
    """The share of a score's plot that its line covers, with the cursor there."""
    viewer.set_time("time", timestamp=np.datetime64(START_NS + round(seconds * 1e9), "ns"), play_state="paused")

    def drawn() -> list[float]:
        view = next(view for view in viewer.get_state().views if view.name == "tray1 / fan 0 score")
        with suppress(ConnectionError):  # the viewer has made its views again meanwhile
            return [colors(rerun_picture._stable_screenshot(viewer, view.view_id))["measured"]]
        return []

    return eventually(drawn, "the plot is drawn")[0]


def shown(viewer: Any) -> dict[str, list[str]]:
    return {view.name: [str(report) for report in view.reports] for view in viewer.get_state().views}

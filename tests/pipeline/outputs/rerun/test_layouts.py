"""The layouts: the real Rerun viewer, without a display, opens each beside its view and reports nothing."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.outputs.rerun.viewer_core import FLUSH_PERIOD_NS
from fantwin.stages.viewer import build
from tests.support.drawn_fleets import context as fleet_context
from tests.support.drawn_fleets import messages_of, play
from tests.support.drawn_views import LATER_NS, context, sent
from tests.support.headless_viewer import headless_viewer, needs_a_driver
from tests.support.ports import free_port
from tests.support.recorded_views import live_view, recorded_view
from tests.support.running_chain import eventually
from tests.support.score_data import made_up_tray


def plots(*fans: str) -> set[str]:
    kinds = ("speed (rad/s)", "torque balance", "score")
    lists = {"state of each fan", "alarms", "alarm log"}
    return lists | {f"{tray} / fan {fan} {kind}" for tray, fan in (each.split("/") for each in fans) for kind in kinds}


def fleet_view(folder: Path) -> Path:
    """A view that ends while fan 2 of tray2 is in alarm."""
    core: Any = build(fleet_context(folder, 3, 3, show=("tray1/0",))).core
    play(core, messages_of(seconds=12))
    core.close()
    return folder / "view.rrd"


def reports(viewer: Any) -> dict[str, list[str]]:
    """What the viewer reports of each view, by name."""
    return {view.name: [str(report) for report in view.reports] for view in viewer.get_state().views}


def is_drawn(viewer: Any) -> bool:
    """Whether it has drawn its window in the time that it allows itself, which a busy machine may not be given."""
    with suppress(TimeoutError):
        return bool(viewer.take_screenshot())
    return False


@pytest.mark.slow
@needs_a_driver
def test_each_layout_of_a_live_view_a_recording_and_a_fleet_opens_without_a_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = {
        live_view(tmp_path / "all"): plots("tray1/0", "tray1/1", "tray1/2") | {"temperature (°C)"},
        recorded_view(tmp_path / "wear", "wear"): {"tray1 / speed since commissioning (%)"},
        recorded_view(tmp_path, "alarms"): plots("tray1/2") | {"temperature (°C)"},
    }
    monkeypatch.setattr("fantwin.pipeline.outputs.rerun.fleet_view.FLEET_ABOVE", 3)
    made[fleet_view(tmp_path / "fleet")] = plots("tray1/0", "tray2/2")
    for path, names in made.items():
        with headless_viewer() as viewer:
            viewer.open(str(path))
            eventually(lambda: reports(viewer).keys() == names, f"the views of {path}")  # noqa: B023  at once
            axes = [part["TimeAxis"] for part in viewer.get_blueprint().blueprint.values() if "TimeAxis" in part]
            assert len([axis for axis in axes if "view_range" in axis]) == 1, "all others are linked to it"
            eventually(lambda: is_drawn(viewer), f"{path} is drawn")
            assert {name: of for name, of in reports(viewer).items() if of} == {}
            assert [entry for entry in viewer.get_logs() if entry.level.lower() in ("warn", "error")] == []


@pytest.mark.slow
@needs_a_driver
def test_a_live_viewer_follows_an_old_recording(tmp_path: Path) -> None:
    scores, _ = made_up_tray(seconds=5)
    port = free_port()
    core = build(context(tmp_path, grpc_port=port)).core
    with headless_viewer() as viewer:
        viewer.open(f"rerun+http://127.0.0.1:{port}/proxy")
        for number, item in enumerate(scores):
            core.step(sent(item))
            core.tick(LATER_NS + number * FLUSH_PERIOD_NS)
        last_ns = int(scores[-1].t_ns[-1])
        eventually(lambda: abs(shown_ns(viewer) - last_ns) < 1000, "the last sample is under the cursor")
        assert not any(reports(viewer).values())
    core.close()


def shown_ns(viewer: Any) -> int:
    """The position of the cursor in the only recording of a viewer; 0 if it shows nothing in time yet."""
    return next((entry.current_time or 0 for entry in viewer.get_state().recordings), 0)

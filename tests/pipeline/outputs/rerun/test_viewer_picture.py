"""The real Rerun viewer, without a display, opens what the viewer stage wrote."""

from __future__ import annotations

import json
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from fantwin.pipeline.cli.recordings.view import view
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.outputs.rerun.viewer_core import FLUSH_PERIOD_NS
from fantwin.stages.viewer import build
from tests.stages.test_viewer import LATER_NS, context, free_port, play, sent
from tests.support.running_chain import eventually
from tests.support.score_data import made_up_tray

rerun_picture = pytest.importorskip("fantwin.pipeline.outputs.rerun.rerun_picture", exc_type=ModuleNotFoundError)
needs_a_driver = pytest.mark.skipif(
    not rerun_picture.has_vulkan_driver(), reason="no Vulkan driver here: apt-get install mesa-vulkan-drivers"
)
BEFORE_FAULT_S = 7


def view_file(folder: Path, seconds: int) -> Path:
    """The first seconds of three fans, the last one with a fault, kept by the viewer stage."""
    scores, alarms = made_up_tray(seconds=seconds)
    core = build(context(folder, speed_unit="rpm")).core
    play(core, scores)
    for alarm in alarms if seconds > BEFORE_FAULT_S else ():
        core.step(alarm)
    core.close()
    return folder / "view.rrd"


@pytest.mark.slow
@needs_a_driver
def test_a_picture_shows_green_bands_and_from_the_fault_on_a_red_deviation_and_lists_every_view_without_warnings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shares = []
    for seconds in (BEFORE_FAULT_S, 20):
        folder = tmp_path / str(seconds)
        folder.mkdir()
        output = folder / "view.png"
        view([view_file(folder, seconds)], output, json_output=True)
        document = json.loads(capsys.readouterr().out)
        assert document["picture"] == str(output)
        plots = [f"tray1 / fan {fan} {kind}" for fan in range(3) for kind in ("speed (rpm)", "torque balance", "score")]
        assert document["views"] == {name: [] for name in (*plots, "state of each fan", "alarms", "alarm log")}
        shares.append(colors(output.read_bytes()))
    healthy, faulty = shares
    assert healthy["band"] > 0.005 and faulty["band"] > 0.005
    assert healthy["deviation"] < 2e-4 and faulty["deviation"] > 1e-3
    assert healthy["measured"] > 0.001


@pytest.mark.slow
@needs_a_driver
def test_a_live_viewer_follows_an_old_recording_while_the_clock_is_of_today(tmp_path: Path) -> None:
    scores, _ = made_up_tray(seconds=5)
    port = free_port()
    core = build(context(tmp_path, serve=True, grpc_port=port, web_port=0)).core
    with rerun_picture.headless_viewer() as viewer:
        viewer.open(f"rerun+http://127.0.0.1:{port}/proxy")
        for number, score in enumerate(scores):
            core.step(sent(score))
            core.tick(LATER_NS + number * FLUSH_PERIOD_NS)
        last_ns = int(scores[-1].t_ns[-1])
        eventually(lambda: abs(shown_ns(viewer) - last_ns) < 1000, "the last sample is under the cursor")
        assert {str(report) for view in viewer.get_state().views for report in view.reports} == set()
        measured = next(view for view in viewer.get_state().views if "fan 0 speed" in view.name)
        assert colors(viewer.take_screenshot(measured.view_id))["band"] > 0.01
    core.close()


def test_a_missing_driver_is_a_one_line_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerun_picture.sys, "platform", "linux")
    monkeypatch.setenv("VK_DRIVER_FILES", "/nowhere/icd.json")
    with pytest.raises(UserError, match="mesa-vulkan-drivers") as caught:
        rerun_picture.draw_picture(view_file(tmp_path, 1))
    assert "\n" not in str(caught.value)


def shown_ns(viewer: Any) -> int:
    """The position of the cursor in the only recording of a viewer; 0 if it shows nothing in time yet."""
    return next((entry.current_time or 0 for entry in viewer.get_state().recordings), 0)


def colors(png: bytes) -> dict[str, float]:
    """The shares of a picture that have the colours of a band, a deviation and a line."""
    red, green, blue = np.asarray(Image.open(BytesIO(png)).convert("RGB")).astype(int).transpose(2, 0, 1)
    return {
        "band": float(((green > 2 * red) & (green > 1.5 * blue) & (green > 60) & (green < 140)).mean()),
        "deviation": float(((red > 50) & (red < 100) & (red > 2 * green) & (red > 2 * blue)).mean()),
        "measured": float(((blue > 130) & (blue > 1.2 * green) & (red > 70)).mean()),
    }

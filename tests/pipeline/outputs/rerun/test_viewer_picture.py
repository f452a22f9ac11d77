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
from fantwin.pipeline.outputs.rerun.viewer_core import PAGE_PERIOD_NS
from fantwin.stages.viewer import build
from tests.stages.test_viewer import LATER_NS, card, context, free_port, health, play, sent
from tests.support.running_chain import eventually
from tests.support.score_data import START_NS, made_up_tray

rerun_picture = pytest.importorskip("fantwin.pipeline.outputs.rerun.rerun_picture", exc_type=ModuleNotFoundError)
needs_a_driver = pytest.mark.skipif(
    not rerun_picture.has_vulkan_driver(), reason="no Vulkan driver here: apt-get install mesa-vulkan-drivers"
)


@pytest.fixture(scope="module")
def view_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty seconds of three fans, the last one with a fault, kept by the viewer stage."""
    folder = tmp_path_factory.mktemp("view")
    scores, alarms = made_up_tray(seconds=20)
    core = build(context(folder, speed_unit="rpm")).core
    play(core, scores)
    for alarm in alarms:
        core.step(alarm)
    core.close()
    return folder / "view.rrd"


@pytest.mark.slow
@needs_a_driver
def test_a_fan_shows_a_green_band_and_from_its_fault_on_a_red_deviation_too(view_file: Path) -> None:
    until = rerun_picture._until(rerun_picture._read(view_file), START_NS + 7_500_000_000)
    times = [rerun_picture._times_ns(chunk.to_record_batch()) for chunk in until.chunks if not chunk.is_static]
    assert max(each.max() for each in times) == until.last_ns == START_NS + 7_500_000_000
    assert not [chunk for chunk in until.chunks if chunk.entity_path == "/tray1/log"], "alarms come later"
    healthy = colors(rerun_picture.draw_picture(view_file, fans=[2], at_s=7.5, view="fan 2").png)
    faulty = colors(rerun_picture.draw_picture(view_file, view="fan 2").png)
    assert healthy["band"] > 0.02 and faulty["band"] > 0.04
    assert healthy["deviation"] < 1e-3 and faulty["deviation"] > 0.01
    assert faulty["red points"] > 3 * healthy["red points"] > 0
    assert healthy["measured"] > 0.002


@pytest.mark.slow
@needs_a_driver
def test_the_command_writes_the_picture_and_lists_every_view_without_warnings(
    view_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "view.png"
    view([view_file], output, fans="0,1,2", json_output=True)
    document = json.loads(capsys.readouterr().out)
    assert document["picture"] == str(output)
    plots = [f"tray1 / fan {fan} {kind}" for fan in range(3) for kind in ("speed (rpm)", "torque balance", "score")]
    assert document["views"] == {name: [] for name in (*plots, "state of each fan", "alarms", "alarm log")}
    assert Image.open(output).width == 1920


@pytest.mark.slow
@needs_a_driver
def test_a_live_viewer_follows_an_old_recording_while_health_is_of_today(tmp_path: Path) -> None:
    scores, _ = made_up_tray(seconds=5)
    port = free_port()
    core = build(context(tmp_path, serve=True, grpc_port=port, web_port=0)).core
    with rerun_picture._headless_viewer() as viewer:
        viewer.open(f"rerun+http://127.0.0.1:{port}/proxy")
        for number, item in enumerate((card(), health(), *scores, health(problem="something is wrong"))):
            core.step(sent(item))
            core.tick(LATER_NS + number * PAGE_PERIOD_NS)
        last_ns = int(scores[-1].t_ns[-1])
        eventually(lambda: abs(shown_ns(viewer) - last_ns) < 1000, "the last sample is under the cursor")
        assert {str(report) for view in viewer.get_state().views for report in view.reports} == set()
        measured = next(view for view in viewer.get_state().views if "fan 0 speed" in view.name)
        assert colors(viewer.take_screenshot(measured.view_id))["band"] > 0.01
    core.close()


def test_a_missing_driver_is_a_one_line_error(view_file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerun_picture.sys, "platform", "linux")
    monkeypatch.setenv("VK_DRIVER_FILES", "/nowhere/icd.json")
    with pytest.raises(UserError, match="mesa-vulkan-drivers") as caught:
        rerun_picture.draw_picture(view_file)
    assert "\n" not in str(caught.value)


def shown_ns(viewer: Any) -> int:
    """The position of the cursor in the only recording of a viewer; 0 if it shows nothing in time yet."""
    return next((entry.current_time or 0 for entry in viewer.get_state().recordings), 0)


def colors(png: bytes) -> dict[str, float]:
    """The shares of a picture that have the colours of a band, a deviation, points, a line and lanes."""
    red, green, blue = np.asarray(Image.open(BytesIO(png)).convert("RGB")).astype(int).transpose(2, 0, 1)

    def near(r: int, g: int, b: int, by: int = 12) -> float:
        return float(((abs(red - r) < by) & (abs(green - g) < by) & (abs(blue - b) < by)).mean())

    return {
        "band": float(((green > 2 * red) & (green > 1.5 * blue) & (green > 60) & (green < 140)).mean()),
        "deviation": float(((red > 50) & (red < 100) & (red > 2 * green) & (red > 2 * blue)).mean()),
        "red points": near(240, 50, 50, by=25),
        "measured": float(((blue > 130) & (blue > 1.2 * green) & (red > 70)).mean()),
        "lane normal": near(32, 120, 62, by=16),
        "lane alarm": near(178, 30, 30, by=16),
        "lane unknown": near(95, 95, 95, by=16),
    }

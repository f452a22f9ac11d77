"""The real Rerun viewer, without a display, opens what the viewer stage wrote."""

from __future__ import annotations

import json
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fantwin.pipeline.cli.recordings.view import view
from fantwin.pipeline.errors import UserError
from fantwin.stages.viewer import build
from tests.support.drawn_views import context, play
from tests.support.score_data import made_up_tray

rerun_picture = pytest.importorskip("fantwin.pipeline.outputs.rerun.rerun_picture", exc_type=ModuleNotFoundError)
needs_a_driver = pytest.mark.skipif(
    not rerun_picture.has_vulkan_driver(), reason="no Vulkan driver here: apt-get install mesa-vulkan-drivers"
)


def view_file(folder: Path, seconds: int) -> Path:
    """The first seconds of three fans, the last one with a fault, kept by the viewer stage."""
    scores, alarms = made_up_tray(seconds=seconds)
    core = build(context(folder, speed_unit="rpm")).core
    play(core, scores)
    for alarm in alarms:
        core.step(alarm)
    core.close()
    return folder / "view.rrd"


@pytest.mark.slow
@needs_a_driver
def test_a_picture_shows_green_bands_and_a_red_deviation_and_lists_every_view_without_warnings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "view.png"
    view([view_file(tmp_path, 20)], output, json_output=True)
    document = json.loads(capsys.readouterr().out)
    assert document["picture"] == str(output)
    plots = [f"tray1 / fan {fan} {kind}" for fan in range(3) for kind in ("speed (rpm)", "torque balance", "score")]
    assert document["views"] == {name: [] for name in (*plots, "state of each fan", "alarms", "alarm log")}
    shares = colors(output.read_bytes())
    assert shares["band"] > 0.005 and shares["deviation"] > 1e-3 and shares["measured"] > 0.001


def test_a_missing_driver_is_a_one_line_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rerun_picture.sys, "platform", "linux")
    monkeypatch.setenv("VK_DRIVER_FILES", "/nowhere/icd.json")
    with pytest.raises(UserError, match="mesa-vulkan-drivers") as caught:
        rerun_picture.draw_picture(view_file(tmp_path, 1))
    assert "\n" not in str(caught.value)


def colors(png: bytes) -> dict[str, float]:
    """The shares of a picture that have the colours of a band, a deviation and a line."""
    red, green, blue = np.asarray(Image.open(BytesIO(png)).convert("RGB")).astype(int).transpose(2, 0, 1)
    return {
        "band": float(((green > 2 * red) & (green > 1.5 * blue) & (green > 60) & (green < 140)).mean()),
        "deviation": float(((red > 50) & (red < 100) & (red > 2 * green) & (red > 2 * blue)).mean()),
        "measured": float(((blue > 130) & (blue > 1.2 * green) & (red > 70)).mean()),
    }

"""The real Rerun viewer, without a display, shows a fleet."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from fantwin.pipeline.outputs.rerun.viewer_core import ViewerCore
from fantwin.stages.viewer import build
from tests.pipeline.outputs.rerun.test_viewer_picture import needs_a_driver, rerun_picture
from tests.stages.test_viewer_fleet import context, messages_of, play

rerun_fleet = pytest.importorskip("fantwin.pipeline.outputs.rerun.rerun_fleet", exc_type=ModuleNotFoundError)


@pytest.fixture(scope="module")
def view_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty seconds of three trays of three fans; fan 2 of tray2 is in alarm from 8.5 s to 14.5 s."""
    folder = tmp_path_factory.mktemp("view")
    core = build(context(folder, 3, 3, fleet_above=3)).core
    assert isinstance(core, ViewerCore)
    play(core, messages_of())
    core.close()
    return folder / "view.rrd"


def cells(png: bytes) -> dict[str, float]:
    """The shares of a picture that have the colours of a cell that is normal, near its limit, and in alarm."""
    red, green, blue = np.asarray(Image.open(BytesIO(png)).convert("RGB")).astype(int).transpose(2, 0, 1)
    return {
        "normal": float(((green > 1.4 * red) & (green > 1.4 * blue) & (green > 70)).mean()),
        "near": float(((red > 120) & (green > 0.8 * red) & (green > 1.8 * blue)).mean()),
        "alarm": float(((red > 120) & (red > 3 * green) & (red > 3 * blue)).mean()),
    }


@pytest.mark.slow
@needs_a_driver
def test_the_map_shows_the_fan_in_alarm_as_long_as_it_is(view_file: Path) -> None:
    pictures = [rerun_picture.draw_picture(view_file, view="every fan", **at) for at in ({"at_s": 12.0}, {})]
    during, after = (cells(drawn.png) for drawn in pictures)
    assert during["alarm"] > 10 * after["alarm"] and during["alarm"] > 0.01
    assert after["normal"] + after["near"] > during["normal"] + during["near"] > 0.1
    assert [report for each in pictures for reports in each.reports.values() for report in reports] == []

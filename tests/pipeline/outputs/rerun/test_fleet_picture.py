"""The real Rerun viewer, without a display, shows a fleet."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
from PIL import Image

from fantwin.pipeline.outputs.rerun.viewer_core import ViewerCore
from fantwin.stages.viewer import build
from tests.pipeline.outputs.rerun.test_viewer_picture import needs_a_driver, rerun_picture
from tests.stages.test_viewer_fleet import context, messages_of, play


@pytest.fixture(scope="module")
def view_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty seconds of three trays of three fans; fan 2 of tray2 is in alarm from 8.5 s to 14.5 s."""
    folder = tmp_path_factory.mktemp("view")
    with patch("fantwin.stages.viewer.FLEET_ABOVE", 3):
        core = build(context(folder, 3, 3)).core
    assert isinstance(core, ViewerCore)
    play(core, messages_of())
    core.close()
    return folder / "view.rrd"


def red_share(png: bytes) -> float:
    """The share of a picture that is as red as an entry of the log about a fan in alarm."""
    red, green, blue = np.asarray(Image.open(BytesIO(png)).convert("RGB")).astype(int).transpose(2, 0, 1)
    return float(((red > 100) & (red > 3 * green) & (red > 2 * blue)).mean())


@pytest.mark.slow
@needs_a_driver
def test_the_log_shows_the_alarm_from_when_it_was_raised_and_the_viewer_has_no_report(view_file: Path) -> None:
    before, during = (rerun_picture.draw_picture(view_file, view="alarm log", at_s=at_s) for at_s in (6.0, 12.0))
    assert red_share(before.png) == 0.0
    assert red_share(during.png) > 1e-4
    whole = rerun_picture.draw_picture(view_file)
    assert {"alarms", "alarm log", "plot 1: a fan in alarm"} <= set(whole.reports)
    assert [report for each in (before, during, whole) for of in each.reports.values() for report in of] == []

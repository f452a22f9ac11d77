"""The file of a view ends where the disk is full, and the viewer goes on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.rerun.rerun_sink import RerunSink, ViewFile, ViewOptions
from fantwin.pipeline.outputs.rerun.viewer_core import ViewerCore
from fantwin.schemas.units import NS_PER_S
from tests.support.drawn_views import sent
from tests.support.score_data import START_NS, made_up_tray


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "view.rrd").touch()
    return tmp_path / "view.rrd"


def test_what_is_written_is_in_the_file_after_a_flush(path: Path) -> None:
    content = np.random.default_rng(1).bytes(300_000)
    file = ViewFile(path)
    with file.pipe.open("wb", buffering=0) as pipe:
        file.release_pipe()
        for start in range(0, len(content), 1000):
            pipe.write(content[start : start + 1000])
        file.flush()
        assert path.read_bytes() == content
    file.close()
    assert file.problem == ""


def test_row_09_a_view_on_a_full_disk_is_reported_and_the_viewer_goes_on_and_ends(small_disk: Path) -> None:
    trays = (TrayConfig(name="tray1", fans=3),)
    sink = RerunSink("x", trays, START_NS, small_disk / "view.rrd", ViewOptions())
    core = ViewerCore("site", trays, sink)
    with (small_disk / "ballast").open("wb", buffering=0) as ballast, pytest.raises(OSError, match="No space"):
        while True:
            ballast.write(bytes(4096))
    scores, _ = made_up_tray()
    half = len(scores) // 2
    for second, some in enumerate((scores[:half], scores[half:])):
        for score in some:
            core.step(sent(score))
        core.tick(START_NS + second * NS_PER_S)
        assert "view.rrd: the view is not written any more: No space left on device; what is in" in core.problem()
    core.close()
    assert core.counters()["samples_drawn"] == sum(len(score.t_ns) for score in scores)


def test_the_file_ends_before_it_exceeds_its_limit(path: Path) -> None:
    file = ViewFile(path, limit_bytes=200_000)
    with file.pipe.open("wb", buffering=0) as pipe:
        file.release_pipe()
        for _ in range(300):
            pipe.write(bytes(1000))
    file.close()
    assert 100_000 < path.stat().st_size <= 200_000
    assert "it has the largest size of a view" in file.problem

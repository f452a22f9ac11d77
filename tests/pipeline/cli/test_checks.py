"""Problems that the stages report before they start."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import Any

from fantwin.pipeline.acquisition.sample_blocks import SampleBlocks
from fantwin.pipeline.config.models import TrayConfig
from fantwin.pipeline.runtime.stage import Context
from fantwin.pipeline.sources.serial.source import SerialSource
from fantwin.stages import acquisition, recorder, viewer
from tests.support.ports import free_port


def context(folder: Path, config: Any, **tray: Any) -> Context:
    trays = (TrayConfig.model_validate({"name": "tray1", "fans": 1, **tray}),)
    return Context(site="s", trays=trays, config=config, folder=folder, run_folder=folder / "run", started_t_ns=0)


def test_the_port_is_found_beside_the_configuration(tmp_path, monkeypatch):
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    (tmp_path / "line").touch()
    here = context(tmp_path, acquisition.AcquisitionConfig(), port="line")
    assert acquisition.check(here) == []
    blocks = acquisition.build(here).source
    source = blocks.source if isinstance(blocks, SampleBlocks) else None
    assert isinstance(source, SerialSource) and source._path == tmp_path / "line"
    (problem,) = acquisition.check(context(tmp_path, acquisition.AcquisitionConfig(), port="none"))
    assert f"{tmp_path / 'none'}: no such port" in problem


def test_a_viewer_with_its_ports_taken_says_so(tmp_path):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        config = viewer.ViewerConfig(grpc_port=taken.getsockname()[1], web_port=0)
        (problem,) = viewer.STAGE.check(context(tmp_path, config))
        assert "viewer.grpc_port" in problem and "is taken" in problem
        assert (
            viewer.STAGE.check(context(tmp_path, config.model_copy(update={"serve": False, "file": "view.rrd"}))) == []
        )
    free = viewer.ViewerConfig(grpc_port=free_port(), web_port=0)
    assert viewer.STAGE.check(context(tmp_path, free)) == []


def test_a_recorder_says_when_its_folder_cannot_be_made(tmp_path, monkeypatch):
    here = context(tmp_path, recorder.RecorderConfig())
    assert recorder.STAGE.check(here) == []
    (tmp_path / "run").touch()
    (problem,) = recorder.STAGE.check(here)
    assert "is not a folder that this user can write to" in problem
    (tmp_path / "run").unlink()
    monkeypatch.setattr(os, "access", lambda *_: False)
    (problem,) = recorder.STAGE.check(here)
    assert str(tmp_path) in problem

"""The configuration of the stages that tests run."""

from __future__ import annotations

import pytest

from fantwin.pipeline.config.settings import BusConfig, Config, LauncherConfig, TrayConfig
from tests.support.toy_stage import TRAY_A, TRAY_B, ToyConfig


@pytest.fixture
def config(endpoint, tmp_path) -> Config:
    return Config(
        path=tmp_path / "fan.toml",
        text="",
        overrides=(),
        site="s",
        run_folder=tmp_path,
        bus=BusConfig(endpoint=endpoint),
        launcher=LauncherConfig(),
        stages=("acquisition", "resampler"),
        trays=tuple(TrayConfig(name=name, fans=1) for name in (TRAY_A, TRAY_B)),
        sections={"resampler": ToyConfig(), "acquisition": ToyConfig()},
    )

"""A scorer in a thread whose core a test gives, and the words that lead a command to its bus."""

from __future__ import annotations

from dataclasses import replace

from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.runtime.stage import BuiltStage, Core, Stage
from fantwin.pipeline.tray_scoring.scorer_config import ScorerConfig
from tests.support.running_chain import DEMO
from tests.support.running_stage import RunningStage


class RunningScorer(RunningStage):
    """The one of the demo's tray; it runs until `end`."""

    def __init__(self, endpoint: str, core: Core) -> None:
        setting = f"bus.endpoint='{endpoint}'"
        self.words = ("-c", DEMO / "demo.toml", "--set", setting)
        self.config = load_config(DEMO / "demo.toml", [setting])
        stage = Stage(
            row=replace(STAGES["scorer"], reads=("prediction", "request")),
            about="",
            config=ScorerConfig,
            build=lambda _context: BuiltStage(core),
        )
        super().__init__(stage, self.config)

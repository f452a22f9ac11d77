"""What the cores of stages are built from, without a bus."""

from __future__ import annotations

from bench.detection.plant import START_NS
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.runtime.stage import Context


def stage_context(config: Config, stage: str) -> Context:
    """Of a stage of a configuration, all trays, at the beginning of simulated data."""
    return Context(
        site=config.site,
        trays=config.trays,
        config=config.sections[stage],
        folder=config.folder,
        run_folder=config.run_folder,
        started_t_ns=START_NS,
        configuration_text=config.text,
    )

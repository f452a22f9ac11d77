"""Builds what a process of a stage consists of: a core for each of its trays, or one for all."""

from __future__ import annotations

from dataclasses import replace

from pipeline.config.models import Config
from pipeline.config.shards import Shard
from pipeline.runtime.stage import BuiltStage, Context, Kept, Stage


def context_of(stage: Stage, config: Config, shard: Shard, started_t_ns: int, kept: Kept) -> Context:
    """What a process of a stage is built from. kept: what others keep of its state."""
    return Context(
        site=config.site,
        trays=tuple(map(config.tray, shard.trays)),
        config=config.sections[stage.name],
        folder=config.folder,
        run_folder=config.run_folder,
        started_t_ns=started_t_ns,
        instance=shard.name,
        shard_number=shard.number,
        snapshot_folder=config.run_folder,
        kept=kept,
        configuration_path=config.path,
        configuration_text=config.text,
        overrides=config.overrides,
    )


def build_parts(stage: Stage, context: Context) -> dict[str, BuiltStage]:
    """The cores, with their sources, by the tray that each serves; an empty name: all. If one cannot be built, those
    before it are aborted.

    Raises:
        StageError: it cannot be built.
    """
    groups = {tray.name: (tray,) for tray in context.trays} if stage.core_per_tray else {"": context.trays}
    parts: dict[str, BuiltStage] = {}
    try:
        for name, trays in groups.items():
            parts[name] = stage.build(replace(context, trays=trays))
    except BaseException:
        abort(parts)
        raise
    return parts


def abort(parts: dict[str, BuiltStage]) -> None:
    """Release what the cores hold; nothing is saved."""
    for each in parts.values():
        each.core.abort()

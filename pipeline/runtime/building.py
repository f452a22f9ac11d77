"""Builds what a process of a stage consists of, a core for each of its trays or one for all, and joins the bus."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

from fantwin.pipeline.bus.session import Bus, join_bus
from fantwin.pipeline.config.roles import role_names
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.config.shards import Shard
from fantwin.pipeline.runtime.kept_snapshots import KeptSnapshots, keeps_snapshots
from fantwin.pipeline.runtime.second_owner import refuse_second
from fantwin.pipeline.runtime.sessions import Session
from fantwin.pipeline.runtime.stage import BuiltStage, Context, Kept, Stage
from fantwin.schemas.topics import ALL_TRAYS


def build_and_join(
    stage: Stage,
    config: Config,
    shard: Shard,
    session: Session,
    session_id: str,
    stop: threading.Event,
    is_replayed: Callable[[], bool],
) -> tuple[Bus, dict[str, BuiltStage]]:
    """Build a process of a stage, then join the bus: a stage that cannot be built says so even where there is no bus.
    Only a core that continues from what others keep joins it earlier. If this fails, nothing is left. session_id: of
    the session on the bus. is_replayed: see Context.

    Raises:
        StageError: it cannot be built, or another process has one of its trays.
        BusError: the bus cannot be joined.
    """
    joined: list[Bus] = []

    def bus() -> Bus:
        if not joined:
            joined.append(join_bus(config, stop, roles=role_names(stage.name, shard), session_id=session_id))
        return joined[0]

    def refuse_others() -> None:
        refuse_second(bus(), config.site, session, stop)

    is_one_expected = any(map(keeps_snapshots, config.stages))
    kept = KeptSnapshots(bus, config.site, stop, refuse_others, Bus.answer_timeout_s, is_one_expected=is_one_expected)
    parts: dict[str, BuiltStage] = {}
    try:
        parts = build_parts(stage, _context_of(stage, config, shard, session, kept, is_replayed))
        refuse_others()
        return bus(), parts
    except BaseException:
        abort(parts)
        for each in joined:
            each.close()
        raise


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


def _context_of(
    stage: Stage, config: Config, shard: Shard, session: Session, kept: Kept, is_replayed: Callable[[], bool]
) -> Context:
    """What a process of a stage is built from. kept: what others keep of its state, which counts where it may have run
    on another host before."""
    may_move = shard.name != ALL_TRAYS or config.bus.mode == "client"
    return Context(
        site=config.site,
        trays=tuple(map(config.tray, shard.trays)),
        config=config.sections[stage.name],
        folder=config.folder,
        run_folder=config.run_folder,
        started_t_ns=session.started_t_ns,
        instance=shard.name,
        producer=session.producer,
        shard_number=shard.number,
        snapshot_folder=config.run_folder,
        kept=kept if may_move else None,
        is_replayed=is_replayed,
        configuration_path=config.path,
        configuration_text=config.text,
        overrides=config.overrides,
        reads=stage.reads_as_configured(config),
    )

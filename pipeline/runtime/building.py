"""Builds what a process of a stage consists of: a core for each of its trays, or one for all."""

from __future__ import annotations

from dataclasses import replace

from pipeline.runtime.stage import BuiltStage, Context, Stage


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

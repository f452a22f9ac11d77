"""Shards: which of a site's trays a process of a stage has, and what the process is called.

A stage runs as one process or as several, each with trays of its own. Trays are given out like cards: shard K of N has
the K-th tray of the configuration and every N-th after it. So all hosts agree without asking one another, the shards
differ by one tray at most, and a tray that is added at the end of the configuration moves no other one.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.errors import UsageError
from fantwin.schemas.topics import ALL_TRAYS, stage_label

LONGEST_NAME = 60
"""characters: a name begins files, whose names may have 255 bytes"""
MOST_NAME_CHARACTERS = 32 << 10
"""of the trays of one shard together: a session shows them in its token, and Zenoh's keys end at 64 KiB"""


@dataclass(frozen=True)
class Shard:
    """The trays that one process of a stage has.

    Attributes:
        name: of the process, in keys, messages and file names: `all`, `2-of-8`, or made of the names of its trays.
        trays: in the order of the configuration.
        words: the options of `fantwin up --only` that select them; none: all trays.
        number: of a numbered shard, counted from 1.
    """

    name: str
    trays: tuple[str, ...]
    words: tuple[str, ...] = ()
    number: int = 1

    @property
    def is_whole(self) -> bool:
        """Whether it has all trays of the site, because nothing selects some."""
        return not self.words


def chosen_trays(config: Config, trays: str | None, shard: str | None) -> list[str]:
    """The trays that two options choose, `--trays a,b` and `--shard 2/8`, in the order of the configuration; all
    without them.

    Raises:
        UsageError: both are given, one cannot be understood, there is no such tray, or the shard has no tray.
    """
    names = [tray.name for tray in config.trays]
    if trays is not None and shard is not None:
        raise UsageError("give --trays or --shard, not both")
    if trays is not None:
        chosen = {config.tray(name).name for name in trays.split(",")}
        return [name for name in names if name in chosen]
    if shard is None:
        return names
    number, of = _numbers(shard)
    if of > len(names):
        raise UsageError(f"--shard {shard}: {config.path} has {_count(len(names))}, and a shard needs one at least")
    return names[number - 1 :: of]


def chosen_shard(stage: str, config: Config, trays: str | None = None, shard: str | None = None) -> Shard:
    """The shard of a stage that the options of `fantwin up --only` choose.

    Raises:
        UsageError: see `chosen_trays`; or the shard has too many trays.
    """
    names = [tray.name for tray in config.trays]
    chosen = chosen_trays(config, trays, shard)
    found = numbered_shard(stage, *_numbers(shard), names) if shard else shard_of(stage, chosen, names)
    characters = sum(len(tray) + 1 for tray in found.trays)
    if not found.is_whole and characters > MOST_NAME_CHARACTERS:
        raise UsageError(
            f"a shard of {_count(len(found.trays))}: their names have {characters:,} characters, and "
            f"{MOST_NAME_CHARACTERS:,} are possible: make more shards"
        )
    return found


def own_file(instance: str, path: Path) -> Path:
    """A file that belongs to one process of a stage; shards may share a folder: `2-of-8.recording.mcap`. The name of
    the shard is not at the end, where it could be taken for the number of a part."""
    return path if instance == ALL_TRAYS else path.with_name(f"{instance}.{path.name}")


def shards_of(stage: str, config: Config) -> list[Shard]:
    """The shards that a configuration gives a stage: as many as `launcher.shards` says, else as its row of the registry
    says."""
    names = [tray.name for tray in config.trays]
    number = config.launcher.number_of_shards(stage)
    if number is not None:
        return [numbered_shard(stage, each, number, names) for each in range(1, number + 1)]
    return [shard_of(stage, each, names) for each in (_by_source(config) if _has_devices(stage) else [names])]


def _has_devices(stage: str) -> bool:
    return STAGES[stage].scope == "tray"


def _by_source(config: Config) -> list[list[str]]:
    """The trays of each process that asks devices: one each, but those together whose source shares a process."""
    shared = [tray.name for tray in config.trays if tray.source.shares_process]
    alone = {tray.name: [tray.name] for tray in config.trays if not tray.source.shares_process}
    return [alone.get(tray.name, shared) for tray in config.trays if tray.name in alone or tray.name == shared[0]]


def numbered_shard(stage: str, number: int, of: int, names: Sequence[str]) -> Shard:
    """Shard `number` of `of`, counted from 1, of the trays of a site."""
    if of == 1:
        return shard_of(stage, names, names)
    return Shard(f"{number}-of-{of}", tuple(names[number - 1 :: of]), ("--shard", f"{number}/{of}"), number)


def shard_of(stage: str, trays: Sequence[str], names: Iterable[str]) -> Shard:
    """The shard with these of the trays of a site. The name of one tray names it; but of a site with one tray only that
    of a stage that has a process for each."""
    is_named_by_tray = len(trays) == 1 and _has_devices(stage)
    if list(trays) == list(names) and not is_named_by_tray:
        return Shard(ALL_TRAYS, tuple(trays))
    name = "+".join(trays)
    if len(name) > LONGEST_NAME:
        digest = hashlib.sha256(name.encode()).hexdigest()[:8]
        name = f"{trays[0][:LONGEST_NAME]}+{len(trays) - 1}-{digest}"
    return Shard(name, tuple(trays), ("--trays", ",".join(trays)))


def _numbers(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text, re.ASCII)
    number, of = (int(match[1]), int(match[2])) if match else (0, 0)
    if not 1 <= number <= of:
        raise UsageError(f"--shard {text}: give K/N with K from 1 to N, for example --shard 2/8")
    return number, of


def _count(trays: int) -> str:
    return "1 tray" if trays == 1 else f"{trays} trays"


@dataclass(frozen=True)
class StageProcess:
    """What to start: one row of the process list, which is data."""

    stage: str
    shard: Shard

    @property
    def instance(self) -> str:
        """The name of the process among those of its stage."""
        return self.shard.name

    @property
    def label(self) -> str:
        """Its name for people."""
        return stage_label(self.stage, self.instance)


def process_list(config: Config, trays: Collection[str] | None = None) -> list[StageProcess]:
    """The processes of a configuration, in the order of the data flow.

    trays: only those whose first tray is one of these. So hosts that share the trays of a site among them start each
    process once. None: all.
    """
    rows = (StageProcess(stage, shard) for stage in config.stages for shard in shards_of(stage, config))
    return [row for row in rows if trays is None or row.shard.trays[0] in trays]

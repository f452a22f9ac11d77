"""Who may do what on the bus: the roles of a site, made from the registry of stages and the table of topics.

A role is the common name of a certificate. There is one for each stage; of a stage also one for each tray alone, as
`acquisition.tray1`, and for each shard of the configuration, as `scorer.2-of-8`. Beside stages there are people and
programs: `operator`, `viewer` (also the stage), `source`, `replay`, `router`, and the controllers that the
configuration names. Nothing here names a stage: a new one has its role with its row in the registry.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.settings import OWN_ROLES, Config
from fantwin.pipeline.config.shards import Shard, shard_of, shards_of
from fantwin.schemas.topics import ALL_TRAYS, BY_NAME, TOPICS, makes_samples_of_samples

OPERATOR, VIEWER, SOURCE, REPLAY, ROUTER = OWN_ROLES
READERS = (VIEWER, OPERATOR)
"""roles of a command that only looks, the one with the fewest rights first"""
OPERATED = ("command", "request")
"""topics of people, and of programs that act for them"""
PUSHED = ("reading",)
"""topics of sources outside the site"""
REPORTS = "consumed"
EVERYTHING = tuple(topic.name for topic in TOPICS)


@dataclass(frozen=True)
class Role:
    """What the owner of a certificate may do.

    Attributes:
        name: the common name of the certificate.
        about: one line for people.
        stage: the stage it may run; empty: none.
        instances: names of processes of that stage; none: all.
        trays: those it is limited to; none: all.
        writes, reads, keeps: topics. Whoever writes a topic also answers for what was missed of it; whoever reads it
            may ask.
        moves_fans: it may show that it moves the commands of a tray.
        is_router: it may pass on all messages of all.
    """

    name: str
    about: str
    stage: str = ""
    instances: tuple[str, ...] = ()
    trays: tuple[str, ...] = ()
    writes: tuple[str, ...] = ()
    reads: tuple[str, ...] = ()
    keeps: tuple[str, ...] = ()
    moves_fans: bool = False
    is_router: bool = False


def roles_of(config: Config) -> dict[str, Role]:
    """All roles of a site, by name."""
    return {role.name: role for role in (*_roles_of_stages(config), *_roles_of_others(config))}


def roles_of_stages() -> dict[str, Role]:
    """By name, the roles of all stages and of a replay that hold without a configuration: for all trays."""
    return {role.name: role for role in (*(_of_stage(stage, stage, (), ()) for stage in STAGES), _of_replay())}


def role_names(stage: str, shard: Shard) -> tuple[str, ...]:
    """The roles that a process of a stage may have, the one with the fewest rights first."""
    limited = f"{stage}.{shard.name}"
    return (limited, stage) if shard.name != ALL_TRAYS else (stage,)


def default_roles(config: Config) -> list[str]:
    """The roles that a site needs: its stages, its router, people who look and people who act; programs that push
    samples only where a tray takes them."""
    sources = (SOURCE,) if any(tray.source.takes_pushed for tray in config.trays) else ()
    return list(dict.fromkeys((*config.stages, ROUTER, OPERATOR, VIEWER, *sources)))


def _roles_of_stages(config: Config) -> Iterator[Role]:
    for stage in STAGES:
        yield _of_stage(stage, stage, (), ())
        for shard in _limited(stage, config):
            instances = (shard.name, ALL_TRAYS) if len(config.trays) == 1 else (shard.name,)
            yield _of_stage(f"{stage}.{shard.name}", stage, instances, shard.trays)


def _limited(stage: str, config: Config) -> Iterable[Shard]:
    names = [tray.name for tray in config.trays]
    found = [*(shard_of(stage, [name], names) for name in names), *shards_of(stage, config)]
    if len(names) == 1:
        found.append(Shard(names[0], tuple(names)))
    return {shard.name: shard for shard in found if shard.name != ALL_TRAYS}.values()


def _of_stage(name: str, stage: str, instances: tuple[str, ...], trays: tuple[str, ...]) -> Role:
    row = STAGES[stage]
    reads, writes = row.reads, row.writes
    if makes_samples_of_samples(reads, writes):
        writes = (*writes, REPORTS)
    of = f" of {', '.join(trays)}" if trays else ""
    return Role(
        name,
        "people who look, and the stage viewer" if name == VIEWER else f"stage {stage}{of}",
        stage=stage,
        instances=instances,
        trays=trays,
        writes=writes,
        reads=EVERYTHING if name == VIEWER else (*reads, "clock"),
        keeps=row.keeps,
    )


def _roles_of_others(config: Config) -> Iterator[Role]:
    yield Role(OPERATOR, "people who act: commands, requests", writes=OPERATED, reads=EVERYTHING, moves_fans=True)
    security = config.bus.security
    for name in security.controllers if security else ():
        yield Role(name, "a program that commands fans", writes=OPERATED, reads=EVERYTHING, moves_fans=True)
    pushed = tuple(name for name in PUSHED if name in BY_NAME)
    for tray in (None, *(tray.name for tray in config.trays)):
        name, of = (f"{SOURCE}.{tray}", f" of {tray}") if tray else (SOURCE, "")
        yield Role(name, f"a program that has readings{of}", trays=(tray,) if tray else (), writes=pushed)
    yield _of_replay()
    yield Role(ROUTER, "a router: passes on what its clients may do", is_router=True)


def _of_replay() -> Role:
    replayed = tuple(topic.name for topic in TOPICS if not topic.is_of_session)
    return Role(REPLAY, "a replay of a recording onto the bus", stage=REPLAY, writes=replayed, reads=EVERYTHING)

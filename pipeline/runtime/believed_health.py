"""Removes from a health message the outputs that its stage may not write. If they were believed, the messages of the
true producer would be those of a stranger, and messages that were never sent would count as lost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from fantwin.pipeline.config.roles import Role
from fantwin.schemas.health import Health
from fantwin.schemas.streams import MOST_PUBLISHED
from fantwin.schemas.topics import topic_of, tray_of


def believed_health(health: Health, roles: Mapping[str, Role]) -> Health:
    """The health with only those outputs that its process may write by the roles of a site; the same object if these
    are all. A stage that this version does not know may write all: no certificate exists for such a stage."""
    role = roles.get(f"{health.stage}.{health.instance}") or roles.get(health.stage)
    believed = tuple(
        output
        for output in health.outputs
        if output.published <= MOST_PUBLISHED and (role is None or not role.stage or _may_write(role, output.key))
    )
    return health if len(believed) == len(health.outputs) else replace(health, outputs=believed)


def _may_write(role: Role, key: str) -> bool:
    try:
        return topic_of(key).name in role.writes and (not role.trays or tray_of(key) in role.trays)
    except KeyError:
        return False

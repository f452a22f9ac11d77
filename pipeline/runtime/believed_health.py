"""Removes from a health message the outputs that its stage may not write. If they were believed, the messages of the
true producer would be those of a stranger, and messages that were never sent would count as lost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from fantwin.pipeline.config.roles import Role
from fantwin.schemas.health import Health
from fantwin.schemas.streams import MOST_PUBLISHED
from fantwin.schemas.topics import topic_of, tray_of


class BelievedHealth:
    """Removes from a health message the outputs that its stage may not write, by the roles of a site.

    If they were believed, the messages of the true producer would be those of a stranger, and messages that were never
    sent would count as lost.
    """

    def __init__(self, roles: Mapping[str, Role]) -> None:
        self._roles = {name: role for name, role in roles.items() if role.stage}

    def of(self, health: Health) -> Health:
        """The health with only those outputs that its process may write; the same object if these are all."""
        believed = tuple(
            output
            for output in health.outputs
            if output.published <= MOST_PUBLISHED and self._may_write(health, output.key)
        )
        return health if len(believed) == len(health.outputs) else replace(health, outputs=believed)

    def _may_write(self, health: Health, key: str) -> bool:
        """Whether the process of a health message may publish on a key. A stage that this version does not know may: no
        certificate exists for such a stage."""
        role = self._roles.get(f"{health.stage}.{health.instance}") or self._roles.get(health.stage)
        if role is None:
            return True
        try:
            topic = topic_of(key).name
        except KeyError:
            return False
        return topic in role.writes and (not role.trays or tray_of(key) in role.trays)

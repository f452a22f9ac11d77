"""What a health is believed about: outputs that its stage may write. Others would make each message on their keys one
of a stranger, and what was never sent a loss."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from pipeline.config.roles import Role
from schemas.health import Health
from schemas.topics import topic_of, tray_of


class BelievedOutputs:
    """By the roles of a site."""

    def __init__(self, roles: Mapping[str, Role]) -> None:
        self._roles = {name: role for name, role in roles.items() if role.stage}

    def of(self, health: Health) -> Health:
        """The health with those of its outputs only that its process may write; itself, if these are all."""
        believed = tuple(output for output in health.outputs if self._may_write(health, output.key))
        return health if len(believed) == len(health.outputs) else replace(health, outputs=believed)

    def _may_write(self, health: Health, key: str) -> bool:
        """Whether the process of a health may have published on a key. Of a stage that this version does not know all
        is believed: no certificate is for such a stage."""
        role = self._roles.get(f"{health.stage}.{health.instance}") or self._roles.get(health.stage)
        if role is None:
            return True
        try:
            topic = topic_of(key).name
        except KeyError:
            return False
        return topic in role.writes and (not role.trays or tray_of(key) in role.trays)

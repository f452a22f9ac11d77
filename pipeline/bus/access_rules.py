"""Zenoh's access control of a site, made from its roles (`pipeline.config.roles`): what is not allowed is refused.

Rules of a router, or of a peer, are about what others send to it (`ingress`): what is not accepted goes nowhere. What
it sends on (`egress`) may go to everybody whose certificate the site knows, since nobody can subscribe to, or ask for,
what it may not read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import zenoh

from fantwin.pipeline.bus.recovery import ALL_PRODUCERS, recovery_key
from fantwin.pipeline.config.roles import Role, roles_of
from fantwin.pipeline.config.settings import Config
from fantwin.schemas.topics import (
    HEALTH,
    ROOT,
    alive_key,
    health_key,
    rights_key,
    session_key,
    sessions_key,
    sweep_key,
    tray_key,
)

EVERY_MESSAGE = (
    *("put", "delete", "declare_subscriber", "query", "reply", "declare_queryable"),
    *("liveliness_token", "liveliness_query", "declare_liveliness_subscriber"),
)
_EVERYBODY = "everybody"


@dataclass(frozen=True)
class Rights:
    """What a role may do, as key expressions by the kind of message."""

    of_message: Mapping[str, tuple[str, ...]]

    def allow(self, message: str, key: str) -> bool:
        """Whether a message of this kind may be sent on this key or key expression."""
        wanted = zenoh.KeyExpr(key)
        return any(zenoh.KeyExpr(each).includes(wanted) for each in self.of_message.get(message, ()))


@dataclass(frozen=True)
class SiteRoles:
    """The roles of a site, as this process knows them from its configuration."""

    site: str
    roles: Mapping[str, Role]

    @classmethod
    def of(cls, config: Config) -> SiteRoles:
        """Those of a configuration."""
        return cls(config.site, roles_of(config))

    def rights(self, role: str) -> Rights | None:
        """What a role may do; None: there is no such role."""
        found = self.roles.get(role)
        return rights_of(found, self.site) if found else None


def rights_of(role: Role, site: str) -> Rights:
    """What a role may send, in one site."""
    if role.is_router:
        return Rights(dict.fromkeys(EVERY_MESSAGE, (f"{ROOT}/{site}/**",)))
    writes = [key for topic in role.writes for key in _keys(site, topic, role.trays)]
    reads = [key for topic in role.reads for key in _keys(site, topic, role.trays)]
    everyone_reads = [health_key(site, "*", "*")]
    tokens: list[str] = []
    for instance in (role.instances or ("*",)) if role.stage else ():
        writes.append(health_key(site, role.stage, instance))
        tokens += [alive_key(site, role.stage, instance), *_session_tokens(site, role, instance)]
    if role.moves_fans:
        tokens.append(sweep_key(site, "*"))
    keeps = [key for topic in role.keeps for key in _keys(site, topic, ())]
    kept = [key for topic in role.keeps for key in _keys(site, topic, role.trays)]
    asks = [key for topic in role.writes for key in _keys(site, topic, role.trays)]
    answers = [recovery_key(key, ALL_PRODUCERS) for key in writes]
    who_is_there = (alive_key(site, "*", "*"), sessions_key(site), sweep_key(site, "*"))
    return Rights(
        {
            "put": tuple(writes),
            "declare_subscriber": (*reads, *everyone_reads),
            "query": (
                *(recovery_key(key, ALL_PRODUCERS) for key in (*reads, *everyone_reads)),
                *asks,
                rights_key(site, role.name),
            ),
            "declare_queryable": (*answers, *keeps),
            "reply": (*answers, *kept),
            "liveliness_token": tuple(tokens),
            "liveliness_query": who_is_there,
            "declare_liveliness_subscriber": who_is_there,
        }
    )


def access_control(of: SiteRoles) -> dict[str, Any]:
    """The value of Zenoh's `access_control`."""
    roles, site = list(of.roles.values()), of.site
    rules: list[dict[str, Any]] = [_rule(_EVERYBODY, EVERY_MESSAGE, (f"{ROOT}/{site}/**",), "egress")]
    policies: list[dict[str, Any]] = [{"rules": [_EVERYBODY], "subjects": [role.name for role in roles]}]
    for role in roles:
        own = [
            _rule(f"{role.name}: {' '.join(messages)}", messages, keys, "ingress")
            for keys, messages in _by_keys(rights_of(role, site)).items()
        ]
        rules += own
        policies.append({"rules": [each["id"] for each in own], "subjects": [role.name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": role.name, "cert_common_names": [role.name]} for role in roles],
        "policies": policies,
    }


def _by_keys(rights: Rights) -> dict[tuple[str, ...], list[str]]:
    """The messages that are allowed on the same keys."""
    found: dict[tuple[str, ...], list[str]] = {}
    for message, keys in rights.of_message.items():
        if keys:
            found.setdefault(tuple(dict.fromkeys(keys)), []).append(message)
    return found


def _rule(name: str, messages: Sequence[str], keys: Sequence[str], flow: str) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "messages": messages, "flows": [flow], "key_exprs": keys}


def _keys(site: str, topic: str, trays: Sequence[str]) -> list[str]:
    """Where a topic is published: of these trays; none: of all."""
    if topic == HEALTH:
        return [health_key(site, "*", "*")]
    return [tray_key(site, tray, topic) for tray in trays or ("*",)]


def _session_tokens(site: str, role: Role, instance: str) -> list[str]:
    """A token says which trays its owner has, so that of a limited role may name no others."""
    if not role.trays:
        return [sessions_key(site, role.stage, instance)]
    own = session_key(site, role.stage, instance, *"****")
    return [own, f"{own}/{'+'.join(role.trays)}"]

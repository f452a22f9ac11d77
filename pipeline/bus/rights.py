"""Rights on the bus: the rules of Zenoh's access control, made from the roles of a site, and whether what a session
declares is accepted.

Rules of a router, or of a peer, are about what others send to it (`ingress`): what is not accepted goes nowhere. What
it sends on (`egress`) may go to everybody whose certificate the site knows, since nobody can subscribe to, or ask for,
what it may not read.

Zenoh drops what is not allowed without a word to whoever sent it, so a session asks the router when it starts, which
answers from the rules that it enforces; peers all have the same rules. Where a site has two routers, that of the
session counts: what other routers pass on, each accepts.

A role may only ask for its own rights. So no answer means that the router does not know the role, and refuses all; but
only while the router is there: an answer is awaited for longer than a dead link goes unnoticed.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import zenoh

from fantwin.pipeline.bus.recovery import ALL_PRODUCERS, recovery_key
from fantwin.pipeline.bus.router_link import LEASE_MS
from fantwin.pipeline.config.roles import OPERATOR, Role, roles_of
from fantwin.pipeline.config.settings import Config
from fantwin.schemas.topics import (
    HEALTH,
    ROOT,
    alive_key,
    health_key,
    key_in_words,
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


ANSWER_LIMIT_S = 3.0
UNANSWERED_LIMIT_S = float(LEASE_MS) / 1000 + 1.0
"""a router that is there all this time and does not answer refuses the question"""
_RETRY_S = 0.1
_SHOWN = 3
_WORDS = {
    "put": "publish",
    "declare_subscriber": "read",
    "declare_queryable": "answer for",
    "liveliness_token": "show that it runs as",
}


def granted_rights(session: zenoh.Session, site: str, role: str) -> Rights | None:
    """What the router grants a role; None if it does not answer: it does not know the role, has just started, or is
    overloaded. Waits for the answer."""
    replies = session.get(rights_key(site, role), timeout=ANSWER_LIMIT_S, consolidation=zenoh.ConsolidationMode.NONE)
    return next(filter(None, (_rights_in(reply, session) for reply in replies)), None)


def awaited_rights(session: zenoh.Session, site: str, role: str, stop: threading.Event | None = None) -> Rights | None:
    """The same, asked again for as long as a router that has just started, or a dead link, may take."""
    until_s = time.monotonic() + UNANSWERED_LIMIT_S
    pause = stop or threading.Event()
    while (granted := granted_rights(session, site, role)) is None and time.monotonic() < until_s:
        if pause.wait(_RETRY_S):
            return None
    return granted


def claims_of(site: SiteRoles, role: str) -> list[tuple[str, str]]:
    """All that a role may declare, by this process's own configuration."""
    own = site.rights(role)
    return [(message, key) for message in _WORDS for key in own.of_message.get(message, ())] if own else []


def refused_in_words(claims: Collection[tuple[str, str]], role: str, site: SiteRoles) -> str:
    """What a role may not do by this process's own configuration, and what to do; empty if it may do all.

    claims: what the session has declared, each a kind of message of Zenoh and a key or key expression.
    """
    rights = site.rights(role)
    if rights is None:
        return f"its certificate says {role!r}, which is no role of site {site.site!r}; all is refused"
    if not (refused := _refused(claims, rights)):
        return ""
    operator = site.rights(OPERATOR)
    is_operator = operator is not None and all(operator.allow(*claim) for claim in claims)
    fitting = f"role {OPERATOR!r}" if is_operator else "its own role"
    return f"its certificate says {role!r}, which may not {refused}; use the certificate of {fitting}"


def refused_by_router(claims: Collection[tuple[str, str]], role: str, site: SiteRoles, granted: Rights | None) -> str:
    """What a router refuses of that, and what to do; empty if nothing. granted: its answer; None: it gave none."""
    if granted is None:
        return (
            f"the router refuses all of role {role!r}: restart it, `fantwin router -c`, with a configuration of "
            f"site {site.site!r} that has this role"
        )
    refused = _refused(claims, granted)
    return f"the router does not let {role!r} {refused}: restart the router with this configuration" if refused else ""


def _refused(claims: Collection[tuple[str, str]], rights: Rights) -> str:
    refused = [(message, key) for message, key in claims if not rights.allow(message, key)]
    # a role that may not publish may not answer for published messages either: that is not named as well
    found = [claim for claim in refused if claim[0] != "declare_queryable"] or refused
    words = list(dict.fromkeys(f"{_WORDS.get(message, message)} {key_in_words(key)}" for message, key in found))
    more = f" and {len(words) - _SHOWN} more" if len(words) > _SHOWN else ""
    return ", ".join(words[:_SHOWN]) + more


def answer_rights(session: zenoh.Session, site: SiteRoles) -> zenoh.Queryable[None]:
    """Answer, in a router, what each role may do."""

    def receive(query: zenoh.Query) -> None:
        with query:
            rights = site.rights(str(query.key_expr).rpartition("/")[2])
            if rights is not None:
                query.reply(query.key_expr, json.dumps(dict(rights.of_message)).encode())

    return session.declare_queryable(rights_key(site.site, "*"), zenoh.handlers.Callback(receive, indirect=False))


def _rights_in(reply: zenoh.Reply, session: zenoh.Session) -> Rights | None:
    """The rights in an answer of the router of a session. Another router of the site, which does not decide what this
    session may do, answers as well."""
    router = reply.replier_id
    if reply.ok is None or (router is not None and router.zid not in session.info.routers_zid()):
        return None
    return _decoded(reply.ok.payload.to_bytes())


def _decoded(answer: bytes) -> Rights | None:
    try:
        found = json.loads(answer)
        return Rights({str(message): tuple(map(str, keys)) for message, keys in found.items()})
    except (ValueError, AttributeError, TypeError):
        return None

"""Every role tries everything on every topic, through a real router: only what its stage or its task needs arrives.

What is expected comes from the declarations of the stages and from the table here, not from the code that makes rules.
A forbidden message is followed by an allowed one on the same connection, which keeps the order: once that has arrived,
the forbidden one never will.
"""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import zenoh

from fantwin.pipeline.bus.recovery import recovery_key
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.runtime.stage import load_stage
from fantwin.schemas.topics import (
    TOPICS,
    alive_key,
    health_key,
    rights_key,
    session_key,
    sweep_key,
    tray_key,
)
from tests.support.secured_site import ANSWER_S, SITE, TRAYS, Heard, SecuredSite, free_endpoint, put

PEOPLE = {
    "operator": {"command", "request"},
    "dcim": {"command", "request"},
    "source": {"reading"},
    "replay": {topic.name for topic in TOPICS if not topic.is_of_session},
}
"""what others than stages may publish"""
READ_ALL = {"operator", "dcim", "viewer", "replay"}
OF_TRAYS = [topic.name for topic in TOPICS if topic.name != "health"]
PROCESSES = [(stage, instance) for stage in (*STAGES, "replay") for instance in ("all", *TRAYS, "1-of-2")]


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Iterator[SecuredSite]:
    with SecuredSite(tmp_path_factory.mktemp("site"), free_endpoint()).running() as running:
        yield running


def roles(site: SecuredSite) -> list[str]:
    return [role for role in site.site.roles if role != "router"]


def stage_and_trays(role: str) -> tuple[str, tuple[str, ...]]:
    """The stage or task of a role, and the trays it is for."""
    name, _, tray = role.partition(".")
    return name, (tray,) if tray else TRAYS


def may_write(role: str, topic: str, tray: str) -> bool:
    name, trays = stage_and_trays(role)
    if name not in STAGES:
        return tray in trays and topic in PEOPLE.get(name, ())
    stage = load_stage(name)
    return tray in trays and (topic in stage.writes or (topic == "consumed" and stage.makes_samples_of_samples))


def may_read(role: str, topic: str, tray: str) -> bool:
    name, trays = stage_and_trays(role)
    reads = (*load_stage(name).reads, "clock") if name in STAGES else ()
    return role in READ_ALL or (tray in trays and topic in reads)


def is_process_of(role: str, stage: str, instance: str) -> bool:
    name, _, tray = role.partition(".")
    return name == stage and (name in STAGES or name == "replay") and (not tray or tray == instance)


def test_the_table_has_every_role(site):
    known = {stage_and_trays(role)[0] for role in roles(site)}
    assert known == {*STAGES, *PEOPLE, "viewer"}
    assert len(roles(site)) == 3 * len(STAGES) + len(PEOPLE) + len(TRAYS)


def test_who_may_publish_what(site):
    """role x topic x tray, and the health of each process."""
    heard = Heard(site.session("router"), f"fantwin/{SITE}/**")
    site.flush("router")
    allowed = set()
    for role in roles(site):
        session = site.session(role)
        for topic in OF_TRAYS:
            for tray in TRAYS:
                put(session, tray_key(SITE, tray, topic), role.encode())
                if may_write(role, topic, tray):
                    allowed.add((tray_key(SITE, tray, topic), role))
            session.delete(tray_key(SITE, "a", topic))
        for stage, instance in PROCESSES:
            put(session, health_key(SITE, stage, instance), role.encode())
            if is_process_of(role, stage, instance):
                allowed.add((health_key(SITE, stage, instance), role))
        put(session, rights_key(SITE, role), role.encode())
        put(session, "another/key", role.encode())
        site.flush(role)
    put(site.session("operator"), tray_key(SITE, "a", "command"), b"sentinel")
    arrived = {(key, payload.decode()) for key, payload in heard.until_sentinel()}
    assert arrived == allowed
    writers = {
        topic: sorted({role.partition(".")[0] for key, role in arrived if key.endswith(f"/{topic}")})
        for topic in OF_TRAYS
    }
    assert writers["raw"] == ["acquisition", "replay"]
    assert writers["command"] == ["dcim", "operator", "replay"]
    asking = {name for name, row in STAGES.items() if "request" in row.writes}
    assert writers["request"] == sorted({"dcim", "operator", "replay"} | asking)


def test_who_may_read_what(site):
    """role x topic x tray: a subscription that is not allowed gets nothing, nor does one to everything."""
    everything = f"fantwin/{SITE}/**"
    heard = {
        (role, key): Heard(site.session(role), key)
        for role in roles(site)
        for key in (*(tray_key(SITE, tray, topic) for topic in OF_TRAYS for tray in TRAYS), everything)
    }
    ends = {role: Heard(site.session(role), health_key(SITE, "*", "*")) for role in roles(site)}
    for role in roles(site):
        site.flush(role)
    speaker = site.session("router")
    for topic in OF_TRAYS:
        for tray in TRAYS:
            put(speaker, tray_key(SITE, tray, topic), b"x")
    put(speaker, health_key(SITE, "scorer", "all"), b"sentinel")
    for role in roles(site):
        ends[role].until_sentinel()
        allowed = {tray_key(SITE, tray, topic) for topic in OF_TRAYS for tray in TRAYS if may_read(role, topic, tray)}
        assert {key for who, key in heard if who == role and heard[who, key].messages} - {everything} == allowed, role
        # a session passes what it receives to each of its subscribers that match
        assert {key for key, _ in heard[role, everything].messages} == allowed, role


def test_who_may_answer_for_what_was_missed_and_who_may_ask(site):
    """role x topic x tray: answers, queries, and snapshots that are kept for others."""
    answering = []
    for role in roles(site):
        for topic in OF_TRAYS:
            for tray in TRAYS:
                for key in (
                    recovery_key(tray_key(SITE, tray, topic), role),
                    tray_key(SITE, tray, topic),
                ):

                    def answer(query: zenoh.Query, key: str = key, role: str = role) -> None:
                        with query:
                            query.reply(key, role.encode())

                    answering.append(site.session(role).declare_queryable(key, answer))
        site.flush(role)
    for topic in OF_TRAYS:
        for tray in TRAYS:
            key = tray_key(SITE, tray, topic)
            writers = {role for role in roles(site) if may_write(role, topic, tray)}
            keepers = {
                role
                for role in roles(site)
                if topic == "snapshot" and stage_and_trays(role)[0] == "recorder" and tray in stage_and_trays(role)[1]
            }
            assert answers(site, "router", recovery_key(key, "*")) == writers, key
            assert answers(site, "router", key) == keepers, key
            for role in (each for each in roles(site) if tray == "a" or "." in each):  # the others are for both trays
                expected = writers if may_read(role, topic, tray) else set()
                assert answers(site, role, recovery_key(key, "*")) - {role} == expected - {role}, (role, key)
    kept = tray_key(SITE, "a", "snapshot")
    assert answers(site, "scorer", kept) - {"scorer"} == {"recorder", "recorder.a"}
    assert answers(site, "resampler", kept) - {"resampler"} == set()
    for each in answering:
        each.undeclare()


def answers(site: SecuredSite, role: str, key: str) -> set[str]:
    replies = site.session(role).get(
        key, target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE, timeout=ANSWER_S
    )
    return {reply.ok.payload.to_string() for reply in replies if reply.ok}


def test_nobody_shows_the_token_of_another(site):
    """role x stage x process: that it is alive, which process it is, and for which trays; and that it moves fans."""
    tokens = []
    expected = set()
    for role in roles(site):
        liveliness = site.session(role).liveliness()
        limit = role.partition(".")[2]
        for stage, instance in PROCESSES:
            own = session_key(SITE, stage, instance, 1, f"by-{role}", "host", 2)
            for key in (alive_key(SITE, stage, instance), own, f"{own}/a", f"{own}/b"):
                tokens.append(liveliness.declare_token(key))
                of_other_tray = limit and key in (f"{own}/a", f"{own}/b") and not key.endswith(f"/{limit}")
                if is_process_of(role, stage, instance) and not of_other_tray:
                    expected.add(key)
        tokens.append(liveliness.declare_token(sweep_key(SITE, f"by-{role}")))
        if role in ("operator", "dcim"):
            expected.add(sweep_key(SITE, f"by-{role}"))
        site.flush(role)
    replies = site.session("router").liveliness().get(f"fantwin/{SITE}/**", timeout=ANSWER_S)
    shown = {str(reply.ok.key_expr) for reply in replies if reply.ok}
    assert shown == expected
    for each in tokens:
        each.undeclare()


def test_a_role_asks_for_its_own_rights_only(site):
    for role in roles(site):
        assert answers(site, role, rights_key(SITE, "*")) == set()
        other = "scorer" if role != "scorer" else "resampler"
        assert answers(site, role, rights_key(SITE, other)) == set()
        assert len(answers(site, role, rights_key(SITE, role))) == 1

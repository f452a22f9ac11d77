"""One owner of each stage: a second is refused at its start, and ignored where both run."""

from __future__ import annotations

import os
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.shards import Shard
from fantwin.pipeline.runtime.runner import Runner
from fantwin.pipeline.runtime.sessions import MOST_SESSIONS, Session, Sessions
from fantwin.pipeline.runtime.stage import BuiltStage, StageError
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.pipeline.tray_scoring.snapshot_store import SnapshotStore
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.enums import Severity
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Grid, Raw
from fantwin.schemas.topics import BY_NAME, alive_key, sessions_key, tray_key
from tests.support.running_chain import eventually
from tests.support.toy_stage import TRAY_A, TRAY_B, Bench, Passer, raw, toy

FIRST = Session("acquisition", TRAY_A, 100, "acquisition-a-1111", "board", 4711, (TRAY_A,))
SECOND = Session("acquisition", TRAY_A, 200, "acquisition-a-2222", "rack", 4712, (TRAY_A,))
SHARD_A = Shard(TRAY_A, (TRAY_A,), ("--trays", TRAY_A))
ONE_LINE = (
    "acquisition/a runs twice: process 4711 on board is ignored, because process 4712 on rack started later; "
    "stop one of them"
)


@pytest.mark.parametrize(
    ("stage", "instance"),
    [("viewer", "all"), ("acquisition", "b"), ("acquisition", f"{TRAY_A}-b")],
    ids=["of another stage", "of another tray", "of a tray with a similar name"],
)
def test_row_07_a_token_that_names_the_producer_of_another_process_is_none(stage, instance):
    """Who may show a token may not choose whom it is about."""
    sessions = known(FIRST)
    forged = replace(FIRST, stage=stage, instance=instance, trays=())
    assert Session.of_key(forged.key("s")) is None
    for session in (forged, replace(forged, started_t_ns=2, producer=f"{stage}-{instance}-2")):
        sessions.update(session.key("s"), alive=True)
    assert not sessions.is_ignored(FIRST.producer, TRAY_A)
    sessions.update(forged.key("s"), alive=False)
    assert sessions.is_alive(FIRST.producer)


def test_row_07_a_token_of_the_same_producer_does_not_take_the_place_of_one_that_is_there():
    sessions = known(FIRST)
    again = replace(FIRST, started_t_ns=1, process_id=1)
    sessions.update(again.key("s"), alive=True)
    assert sessions.named("acquisition", TRAY_A) == FIRST
    sessions.update(again.key("s"), alive=False)
    assert sessions.is_alive(FIRST.producer)


@pytest.mark.parametrize("order", [(FIRST, SECOND), (SECOND, FIRST)])
def test_row_07_of_two_sessions_the_later_owns_the_stage_until_it_ends(order):
    sessions = Sessions()
    for session in order:
        sessions.update(session.key("s"), alive=True)
    assert sessions.is_ignored(FIRST.producer, TRAY_A)
    assert not sessions.is_ignored(SECOND.producer, TRAY_A)
    assert sessions.problem() == ONE_LINE
    sessions.update(SECOND.key("s"), alive=False)
    assert not sessions.is_ignored(FIRST.producer, TRAY_A)
    assert not sessions.problem()


def test_row_07_sessions_of_different_trays_and_stages_do_not_conflict_and_the_remembered_ones_are_bounded():
    sessions = Sessions()
    of_b = replace(SECOND, instance="b", producer="acquisition-b-1", trays=("b",))
    scorer = replace(SECOND, stage="scorer", producer="scorer-a-1")
    for session in (FIRST, of_b, scorer):
        sessions.update(session.key("s"), alive=True)
        assert sessions.named(session.stage, session.instance) == session
    assert not sessions.problem()
    for number in range(MOST_SESSIONS + 5):
        sessions._alive[f"key {number}"] = FIRST
    sessions.update(SECOND.key("s"), alive=True)
    assert SECOND.key("s") not in sessions._alive


def shard(name: str, started_t_ns: int, *trays: str) -> Session:
    return Session("scorer", name, started_t_ns, f"scorer-{name}-{started_t_ns}", "board", started_t_ns, trays)


def known(*sessions: Session) -> Sessions:
    found = Sessions()
    for session in sessions:
        found.update(session.key("s"), alive=True)
    return found


def test_row_07_a_session_and_its_trays_are_read_from_the_key_of_its_token():
    for session in (FIRST, shard("all", 1), shard("2-of-4", 3, "b", "c-d"), shard("all", 4, "all")):
        assert Session.of_key(session.key("s")) == session
    assert Session.of_key(sessions_key("s")) is None
    assert Session.of_key(FIRST.key("s").replace("4711", "x")) is None


def test_row_07_only_the_trays_that_two_sessions_have_change_their_owner():
    one, other = shard("1-of-2", 1, "a", "c"), shard("c+d", 2, "c", "d")
    sessions = known(other, one, shard("2-of-2", 1, "b"))
    assert [sessions.is_ignored(one.producer, tray) for tray in "ac"] == [False, True]
    assert not any(sessions.is_ignored(other.producer, tray) for tray in "cd")
    assert sessions.owner("scorer", "c") == other
    assert sessions.owner("scorer", "x") is None
    assert sessions.problem() == (
        "two owners of tray c in scorer: scorer/1-of-2, process 1 on board, is ignored, because scorer/c+d, "
        "process 2 on board, started later; stop one of them, or give it other trays"
    )
    sessions.update(other.key("s"), alive=False)
    assert not sessions.is_ignored(one.producer, "c"), "it takes over at once"
    assert not sessions.problem()


@pytest.mark.parametrize(("whole_started", "is_whole_ignored"), [(1, True), (9, False)])
def test_row_07_a_session_of_all_trays_and_one_of_some(whole_started, is_whole_ignored):
    whole, some = shard("all", whole_started), shard("a+b", 5, "a", "b")
    sessions = known(whole, some)
    for tray, is_shared in (("a", True), ("b", True), ("c", False)):
        assert sessions.is_ignored(whole.producer, tray) == (is_whole_ignored and is_shared)
        assert sessions.is_ignored(some.producer, tray) == (not is_whole_ignored or not is_shared)
    assert "two owners of trays a, b in scorer" in sessions.problem()


def test_row_07_a_shard_with_a_tray_that_another_one_has_is_refused_in_one_line(config, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.runtime.second_owner.LEAVING_LIMIT_S", 0.0)
    stop = threading.Event()
    stop.set()
    with Bus(config.bus) as bus:
        bus.declare_alive(replace(shard("a+x", 1, "a", "x"), stage="resampler", producer="resampler-a+x-1").key("s"))
        with pytest.raises(StageError) as refused:
            Runner(toy(), config, Shard("all", (TRAY_A, TRAY_B)), stop)
        assert str(refused.value) == (
            "resampler of site 's' cannot start: resampler/a+x already has trays a, x: process 1 on board; stop that, "
            "or give this one other trays"
        )
        Runner(toy(), config, Shard(TRAY_B, (TRAY_B,), ("--trays", TRAY_B)), stop).run()


def test_row_07_a_second_process_of_a_stage_is_refused_in_one_line_that_names_the_first(config, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.runtime.second_owner.LEAVING_LIMIT_S", 0.0)
    aborted: list[bool] = []

    class Aborts(Passer):
        def abort(self) -> None:
            aborted.append(True)

    bench = Bench(toy(), config)
    first = os.getpid()
    monkeypatch.setattr("fantwin.pipeline.runtime.sessions.os.getpid", lambda: first + 1)
    with pytest.raises(
        StageError, match=f"^resampler of site 's' already runs: process {first} on [^;]*; stop that, or give"
    ):
        Runner(toy(lambda _context: BuiltStage(Aborts()), core_per_tray=False), config, None, threading.Event())
    bench.feed(TRAY_A, 1)
    assert bench.next(Grid).t_ns.tolist() == [1], "the first is not disturbed"
    bench.end()
    assert aborted == [True]


def test_row_07_a_stage_with_a_device_is_refused_where_a_replay_presents_the_site_and_others_are_not(
    config, monkeypatch
):
    monkeypatch.setattr("fantwin.pipeline.runtime.second_owner.LEAVING_LIMIT_S", 0.0)
    with Bus(config.bus) as replay:
        replay.declare_alive(alive_key("s", "replay", "all"))
        with pytest.raises(StageError) as refused:
            Runner(toy(name="acquisition", reads=(), writes=("raw",)), config, SHARD_A, threading.Event())
        assert str(refused.value) == (
            "a replay presents site 's': stop it, or give acquisition/a another site or bus.endpoint"
        )
        stop = threading.Event()
        stop.set()
        Runner(toy(), config, None, stop).run()


@pytest.mark.parametrize("process_id", [2**22 + 1, os.getpid()], ids=["ended", "our number, as in a container"])
def test_row_07_the_token_of_a_process_of_this_host_that_has_ended_refuses_nobody(config, monkeypatch, process_id):
    monkeypatch.setattr("fantwin.pipeline.runtime.second_owner.LEAVING_LIMIT_S", 0.0)
    ours = Session.of_this_process("resampler", Shard("all", (TRAY_A, TRAY_B)), 1, "resampler-all-1")
    with Bus(config.bus) as bus:
        bus.declare_alive(replace(ours, process_id=process_id).key("s"))
        stop = threading.Event()
        stop.set()
        Runner(toy(), config, None, stop).run()


def test_row_07_where_two_run_the_samples_of_one_are_ignored_and_both_are_named(config):
    bench = Bench(toy(), config)
    with Bus(config.bus) as other:
        for bus, session in ((bench.bus, FIRST), (other, SECOND)):
            bus.declare_alive(session.key("s"))
        bench.health_with(lambda health: health.problem == ONE_LINE)
        key = tray_key("s", TRAY_A, "raw")
        publishers = {s: bench.bus.publisher(key, BY_NAME["raw"], type_name(Raw), s.producer) for s in (FIRST, SECOND)}

        def feed(session: Session, t_ns: int) -> None:
            header = Header(session.producer, publishers[session].published, TRAY_A)
            publishers[session].put(encode(replace(raw(t_ns), header=header)))

        feed(FIRST, 1)
        feed(SECOND, 2)
        assert bench.next(Grid).t_ns.tolist() == [2]
        refused = bench.health_with(lambda health: any(c.name == "refused_of_second" for c in health.counters))
    bench.health_with(lambda health: not health.problem)
    feed(FIRST, 3)
    assert bench.next(Grid).t_ns.tolist() == [3], "the other has ended"
    bench.end()
    assert {c.name: c.value for c in refused.counters}["refused_of_second"] == 1
    assert {line.producer: line.refused for line in refused.inputs} == {FIRST.producer: 1, SECOND.producer: 0}


def test_row_07_alarms_of_a_second_scorer_are_not_shown(config):
    first, second = (
        replace(s, stage="scorer", instance="all", producer=f"scorer-all-{s.started_t_ns}", trays=())
        for s in (FIRST, SECOND)
    )
    with Bus(config.bus) as site, Bus(config.bus) as ours:
        watcher = SiteWatcher(ours, "s")
        for session in (first, second):
            site.declare_alive(session.key("s"))
        key = tray_key("s", TRAY_A, "alarm")
        eventually(lambda: not watcher.counts(key, first.producer), "both are known")
        for session, fan in ((first, 1), (second, 2)):
            alarm = Alarm(
                header=Header(session.producer, 0, TRAY_A),
                fan=fan,
                active=True,
                severity=Severity.ALARM,
                t_ns=1,
                onset_t_ns=1,
                residual_rad_s=0,
                residual_std_rad_s=0,
                message="",
            )
            site.publisher(key, BY_NAME["alarm"], type_name(Alarm), session.producer).put(encode(alarm))
        eventually(watcher.alarms, "an alarm is shown")
        assert [alarm.fan for alarm in watcher.alarms()] == [2]


def test_row_07_a_snapshot_that_another_process_uses_is_refused_in_one_line(tmp_path: Path):
    path = tmp_path / "scorer-tray1.snapshot"
    first = SnapshotStore(path)
    first.lock("site one")
    with pytest.raises(StageError) as refused:
        SnapshotStore(path).lock("site two")
    assert str(refused.value) == (
        f"{path}: in use by another scorer (process {os.getpid()}, site one); stop that, or give this site another "
        "run_folder"
    )
    first.unlock()
    SnapshotStore(path).lock("site two")
    SnapshotStore(path / "scorer-tray1.snapshot").lock("in a folder that cannot be written, nothing is locked")

"""One owner of each stage: a second is refused at its start, and where two run, the earlier one ends."""

from __future__ import annotations

import os
import threading
from dataclasses import replace
from pathlib import Path

import pytest

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.shards import Shard
from fantwin.pipeline.runtime.runner import Runner
from fantwin.pipeline.runtime.sessions import Session, Sessions
from fantwin.pipeline.runtime.stage import BuiltStage, StageError
from fantwin.pipeline.tray_scoring.snapshot_store import SnapshotStore
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.messages import Grid
from fantwin.schemas.topics import alive_key, sessions_key
from tests.support.toy_stage import TRAY_A, TRAY_B, Bench, Passer, toy

FIRST = Session("acquisition", TRAY_A, 100, "acquisition-a-1111", "board", 4711, (TRAY_A,))
SECOND = Session("acquisition", TRAY_A, 200, "acquisition-a-2222", "rack", 4712, (TRAY_A,))
SHARD_A = Shard(TRAY_A, (TRAY_A,), ("--trays", TRAY_A))


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
    assert sessions.successor_of(FIRST) is None
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
    sessions = known(*order)
    assert sessions.successor_of(FIRST) == SECOND
    assert sessions.successor_of(SECOND) is None
    assert sessions.owner("acquisition", TRAY_A) == SECOND
    sessions.update(SECOND.key("s"), alive=False)
    assert sessions.successor_of(FIRST) is None
    assert sessions.owner("acquisition", TRAY_A) == FIRST


def test_row_07_sessions_of_different_trays_and_stages_do_not_conflict_and_the_remembered_ones_are_bounded(monkeypatch):
    sessions = Sessions()
    of_b = replace(SECOND, instance="b", producer="acquisition-b-1", trays=("b",))
    scorer = replace(SECOND, stage="scorer", producer="scorer-a-1")
    for session in (FIRST, of_b, scorer):
        sessions.update(session.key("s"), alive=True)
        assert sessions.named(session.stage, session.instance) == session
        assert sessions.successor_of(session) is None
    monkeypatch.setattr("fantwin.pipeline.runtime.sessions.MOST_SESSIONS", 20)
    for number in range(20):
        sessions.update(replace(FIRST, producer=f"acquisition-a-{number}").key("s"), alive=True)
    sessions.update(SECOND.key("s"), alive=True)
    assert not sessions.is_alive(SECOND.producer), "those that are there are not forgotten"
    sessions.update(FIRST.key("s"), alive=False)
    sessions.update(SECOND.key("s"), alive=True)
    assert sessions.is_alive(SECOND.producer) and not sessions.has_ended(FIRST.producer)


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


def test_row_07_only_sessions_with_a_common_tray_have_successors():
    one, other, third = shard("1-of-2", 1, "a", "c"), shard("c+d", 2, "c", "d"), shard("2-of-2", 1, "b")
    sessions = known(other, one, third)
    assert [sessions.successor_of(each) for each in (one, other, third)] == [other, None, None]
    assert sessions.owner("scorer", "c") == other
    assert sessions.owner("scorer", "x") is None
    whole = shard("all", 9)
    sessions.update(whole.key("s"), alive=True)
    assert sessions.successor_of(third) == whole, "a session of all trays has those of each other one"
    assert [sessions.owner("scorer", tray) for tray in "acx"] == [whole] * 3


@pytest.fixture
def _found_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first of two is found before the time for that is over, and is not waited for until it leaves."""
    monkeypatch.setattr("fantwin.pipeline.runtime.second_owner.LEAVING_LIMIT_S", 0.0)
    monkeypatch.setattr("fantwin.pipeline.runtime.second_owner.GOSSIP_S", 60.0)


@pytest.fixture
def stopped() -> threading.Event:
    stop = threading.Event()
    stop.set()
    return stop


@pytest.mark.usefixtures("_found_before")
def test_row_07_a_shard_with_a_tray_that_another_one_has_is_refused_in_one_line(config, stopped):
    with Bus(config.bus) as bus:
        bus.declare_alive(replace(shard("a+x", 1, "a", "x"), stage="resampler", producer="resampler-a+x-1").key("s"))
        with pytest.raises(StageError) as refused:
            Runner(toy(), config, Shard("all", (TRAY_A, TRAY_B)), threading.Event())
        assert str(refused.value) == (
            "resampler of site 's' cannot start: resampler/a+x already has trays a, x: process 1 on board; stop that, "
            "or give this one other trays"
        )
        Runner(toy(), config, Shard(TRAY_B, (TRAY_B,), ("--trays", TRAY_B)), stopped).run()


def test_row_07_a_second_process_of_a_stage_is_refused_in_one_line_that_names_the_first(config, monkeypatch, request):
    aborted: list[bool] = []

    class Aborts(Passer):
        def abort(self) -> None:
            aborted.append(True)

    bench = Bench(toy(), config)
    request.getfixturevalue("_found_before")  # from now on: the first waits for others, too
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


@pytest.mark.usefixtures("_found_before")
def test_row_07_a_stage_with_a_device_is_refused_where_a_replay_presents_the_site_and_others_are_not(config, stopped):
    with Bus(config.bus) as replay:
        replay.declare_alive(alive_key("s", "replay", "all"))
        with pytest.raises(StageError) as refused:
            Runner(toy(name="acquisition", reads=(), writes=("raw",)), config, SHARD_A, threading.Event())
        assert str(refused.value) == (
            "a replay presents site 's': stop it, or give acquisition/a another site or bus.endpoint"
        )
        Runner(toy(), config, None, stopped).run()


@pytest.mark.parametrize("process_id", [2**22 + 1, os.getpid()], ids=["ended", "our number, as in a container"])
def test_row_07_the_token_of_a_process_of_this_host_that_has_ended_refuses_nobody(
    config, monkeypatch, stopped, process_id
):
    monkeypatch.setattr("fantwin.pipeline.runtime.second_owner.LEAVING_LIMIT_S", 0.0)
    ours = Session.of_this_process("resampler", Shard("all", (TRAY_A, TRAY_B)), 1, "resampler-all-1")
    with Bus(config.bus) as bus:
        bus.declare_alive(replace(ours, process_id=process_id).key("s"))
        Runner(toy(), config, None, stopped).run()


def test_row_07_where_two_were_started_at_once_the_earlier_ends_and_names_the_other(config):
    bench = Bench(toy(), config, expects=StageError)
    with Bus(config.bus) as other:
        token = Session("resampler", "a+x", 2**62, "resampler-a+x-1", "rack", 4712, (TRAY_A, "x"))
        other.declare_alive(token.key("s"))
        ending = bench.health_with(lambda health: health.is_last)
    bench.thread.join(20)
    bench.bus.close()
    (error,) = bench.crashes
    said = "resampler ends: resampler/a+x, process 4712 on rack, has trays a, x and started later"
    assert str(error).startswith(said)
    assert ending.problem.startswith(said)
    assert ending.status == StageStatus.DEGRADED


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

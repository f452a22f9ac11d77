"""Recovery is bounded in time, bytes and messages, and live data does not wait for it."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import pytest

from fantwin.pipeline.bus import recovery as bus_recovery
from fantwin.pipeline.bus.recovery import LAST_SEQUENCE, Answer, recovery_key
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.runtime.inbox import INBOX_BYTES, FromBus, Inbox, Recovered
from fantwin.pipeline.runtime.sequence_tracker import (
    MOST_HELD_MESSAGES,
    MOST_PRODUCERS,
    SILENT_S,
    Found,
    Request,
    SequenceTracker,
)
from fantwin.pipeline.runtime.sessions import Session, Sessions
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Grid, Raw
from fantwin.schemas.topics import BY_NAME, health_key, tray_key
from tests.support.numbered_packets import KEY, health, packet, sequences
from tests.support.running_chain import eventually
from tests.support.toy_stage import TRAY_A, Bench, raw, toy


def test_row_11_live_data_does_not_wait_for_a_producer_that_never_answers(config, monkeypatch):
    """A stranger makes the stage ask, and does not answer; the time limit is far beyond the test's."""
    monkeypatch.setattr(Bus, "answer_timeout_s", 300.0)
    bench = Bench(toy(), config)
    asked = threading.Event()
    queries: list[Any] = []

    def never_answer(query: Any) -> None:
        queries.append(query)
        asked.set()

    key = tray_key("s", TRAY_A, "raw")
    silent = bench.bus._session.declare_queryable(recovery_key(key, "stranger"), never_answer)
    stranger = bench.bus.publisher(key, BY_NAME["raw"], type_name(Raw), "another name")
    stranger.put(encode(replace(raw(1), header=Header("stranger", 5, TRAY_A))))
    assert asked.wait(20)
    for t_ns in (2, 3):
        bench.feed(TRAY_A, t_ns)
    assert [bench.next(Grid).t_ns.tolist() for _ in range(2)] == [[2], [3]]
    for query in queries:
        query.drop()
    assert bench.next(Grid).t_ns.tolist() == [1], "without an answer the stream goes on"
    silent.undeclare()
    bench.end()


def late(_request: Request) -> Found | None:
    return None


def test_row_11_messages_of_a_stream_wait_in_order_for_those_that_were_missed_and_others_go_on():
    requests: list[Request] = []
    tracker = SequenceTracker(requests.append)
    tracker.accept(packet(0))
    tracker.accept(packet(3))
    tracker.accept(packet(4))
    assert tracker.is_waiting
    assert sequences(tracker.accept(packet(0, "other"))) == [0]
    assert sequences(tracker.answer(requests[0], Found([packet(2), packet(1)], 5))) == [1, 2, 3, 4]
    assert not tracker.is_waiting
    assert tracker.answer(requests[0], Found([packet(1)])) == [], "a second answer changes nothing"


def test_row_11_a_stream_that_has_waited_for_too_many_messages_or_bytes_goes_on_without(monkeypatch):
    tracker = SequenceTracker(late)
    tracker.accept(packet(0))
    due = [s for number in range(2, MOST_HELD_MESSAGES + 4) for s in sequences(tracker.accept(packet(number)))]
    assert due == list(range(2, MOST_HELD_MESSAGES + 4))
    assert tracker.inputs()[0].missing == 1
    monkeypatch.setattr("fantwin.pipeline.runtime.sequence_tracker.MOST_HELD_BYTES", 100)
    tracker = SequenceTracker(late)
    tracker.accept(packet(0))
    large = [replace(packet(number), payload=bytes(40)) for number in range(2, 6)]
    assert [len(tracker.accept(each)) for each in large] == [0, 0, 0, 4]


def test_row_11_a_flood_of_producers_leaves_the_real_one_in_sequence_few_others_and_room_for_a_stage():
    sessions, flood = Sessions(), 4 * MOST_PRODUCERS
    sessions.update(Session("acquisition", "tray", 1, "acquisition-tray-restarted", "host", 1).key("site"), alive=True)
    tracker = SequenceTracker(lambda _request: Found(), sessions=sessions)
    for number in range(flood):
        assert sequences(tracker.accept(packet(number, "real"))) == [number]
        tracker.accept(packet(1, f"false-{number}"))
    assert len(list(tracker._streams)) == MOST_PRODUCERS
    assert sum(line.received for line in tracker.inputs()) == flood + MOST_PRODUCERS - 1
    assert tracker.counters() == {"refused_producers": flood - MOST_PRODUCERS + 1}
    real = next(line for line in tracker.inputs() if line.producer == "real")
    assert (real.received, real.missing, real.duplicated) == (flood, 0, 0)
    assert sequences(tracker.accept(packet(0, "acquisition-tray-restarted"))) == [0]
    assert sequences(tracker.accept(packet(0, "stranger"))) == []


def test_row_11_where_a_stage_publishes_others_are_refused_without_asking():
    sessions, requests = Sessions(), []
    acquisition = Session("acquisition", "tray", 1, "acquisition-tray-real", "host", 1)
    sessions.update(acquisition.key("site"), alive=True)
    tracker = SequenceTracker(requests.append, sessions=sessions)
    tracker.accept(packet(3, "early"))
    sessions.add_health(health(0, "acquisition-tray-real"), {KEY})
    requests.clear()
    assert tracker.accept(packet(4, "early")) == [], "it was heard before the stage had said what it publishes"
    tracker.accept(packet(3, "stranger"))
    tracker.reconcile(health(3, "stranger"), [KEY])
    own_health = health_key("site", "acquisition", "tray")
    tracker.accept(replace(packet(3, "stranger"), key=own_health, topic="health"))
    assert not requests
    assert tracker.counters() == {"refused_producers": 3}
    assert f"{own_health}: stranger is not a stage of this site" in tracker.problem()
    assert sequences(tracker.accept(packet(0, "acquisition-tray-real"))) == [0]
    sessions.update(acquisition.key("site"), alive=False)
    tracker.accept(packet(3, "a replay"))
    assert [request.producer for request in requests] == ["a replay"]
    successor = Session("acquisition", "tray", 2, "acquisition-tray-next", "host", 2)
    sessions.update(successor.key("site"), alive=True)
    sessions.add_health(health(0, "acquisition-tray-next"), {KEY})
    assert sequences(tracker.accept(packet(1, "acquisition-tray-real"))) == [1], (
        "it may have been on the way when the session ended"
    )


def test_row_11_a_producer_that_was_silent_for_long_makes_room_and_while_all_wait_others_are_refused_and_named():
    now_s = [0.0]
    tracker = SequenceTracker(lambda _request: Found(), lambda: now_s[0])
    for number in range(10):
        tracker.accept(packet(number, "stopped long ago"))
    now_s[0] = SILENT_S
    for number in range(MOST_PRODUCERS):
        tracker.accept(packet(0, f"new-{number}"))
    assert {line.producer for line in tracker.inputs()} == {"", *(f"new-{n}" for n in range(MOST_PRODUCERS))}
    tracker = SequenceTracker(late)
    for number in range(MOST_PRODUCERS + 1):
        tracker.accept(packet(1, f"p{number}"))
    assert tracker.counters() == {"refused_producers": 1}
    assert f"{KEY}: too many producers at once" in tracker.problem()


@pytest.fixture
def endless(endpoint, monkeypatch):
    """A bus on which somebody answers requests for KEY of "endless" without end, and whoever asks it."""
    monkeypatch.setattr(Bus, "answer_timeout_s", 60.0)
    config = BusConfig(endpoint=endpoint)
    has_ended = threading.Event()

    def answer(query: Any) -> None:
        with query:
            while not has_ended.is_set():
                query.reply(recovery_key(KEY, "endless"), bytes(1000))

    with Bus(config) as bus, Bus(config) as asker:
        queryable = bus._session.declare_queryable(recovery_key(KEY, "endless"), answer)
        bus.declare_alive("fantwin/s/alive/endless/all")
        eventually(lambda: asker.alive("fantwin/s/alive/*/*"), "they have met")
        yield asker
        has_ended.set()
        queryable.undeclare()


@pytest.mark.parametrize(("last", "most_bytes", "expected"), [(9, 1 << 30, 10), (LAST_SEQUENCE, 50_500, 50)])
def test_row_11_an_endless_answer_ends_at_its_bound(endless, monkeypatch, last, most_bytes, expected):
    monkeypatch.setattr(bus_recovery, "MOST_RECOVERED_BYTES", most_bytes)
    answered = threading.Event()
    answers: list[Answer] = []

    def receive(answer: Answer) -> None:
        answers.append(answer)
        answered.set()

    request = endless.request_missed(KEY, "endless", 0, last, 60, receive)
    assert answered.wait(20)
    request.cancel()
    assert len(answers[0].messages) == expected
    assert len(answers) == 1


def test_row_11_the_inbox_is_bounded_in_bytes_and_what_must_not_be_missed_is_not_dropped():
    inbox = Inbox(drops_oldest=True)
    for number in range(5):
        inbox.put(FromBus("k", bytes(INBOX_BYTES // 2), number))
    assert (inbox.waiting(), inbox.dropped) == (2, 3)
    inbox = Inbox(drops_oldest=True)
    answer = Recovered(Request(KEY, "p", 0, 5), Answer())
    inbox.put(answer)
    for number in range(5):
        inbox.put(FromBus("k", bytes(INBOX_BYTES), number))
    assert inbox.get(0.0) is answer
    assert inbox.get(0.0) == FromBus("k", bytes(INBOX_BYTES), 4)

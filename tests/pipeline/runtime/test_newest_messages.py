"""A core that follows some trays gets every message of theirs, and of the others the newest."""

from __future__ import annotations

from collections.abc import Sequence, Set
from dataclasses import replace
from typing import Any

from fantwin.pipeline.bus.recovery import ALL_PRODUCERS, Answer
from fantwin.pipeline.config.models import Config
from fantwin.pipeline.runtime.inbox import Inbox, Newest
from fantwin.pipeline.runtime.newest_messages import MOST_UNDER_WAY, PAUSE_S, PERIOD_S, NewestMessages
from fantwin.pipeline.runtime.stage import BuiltStage
from fantwin.schemas.codec import encode
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Message
from fantwin.schemas.topics import tray_key
from tests.support.running_chain import eventually
from tests.support.toy_stage import TRAY_A, TRAY_B, Bench, Silent, raw, toy

KEYS = [tray_key("s", f"tray{number}", "raw") for number in range(300)]


class FakeBus:
    """Keeps the requests under way."""

    def __init__(self) -> None:
        self.asked: dict[str, tuple[str, int]] = {}
        """by key: the producer, and the first sequence number"""
        self.answer: dict[str, Any] = {}

    def request_missed(
        self, key: str, producer: str, first: int, last: int, timeout_s: float, on_answer: Any, newest: int
    ) -> Any:
        assert newest == 1
        self.asked[key] = producer, first
        self.answer[key] = on_answer
        return self

    def cancel(self) -> None:
        """Nothing is running."""


class Asker:
    """A `NewestMessages` with a bus and a clock of its own."""

    def __init__(self, *keys: str) -> None:
        self.now_s = 0.0
        self.bus: Any = FakeBus()
        self.inbox = Inbox(drops_oldest=False)
        self.newest = NewestMessages(self.bus, self.inbox, now_s=lambda: self.now_s)
        self.newest.watch(set(keys))

    def ask(self) -> dict[str, tuple[str, int]]:
        """What is asked now that was not asked before."""
        self.bus.asked = {}
        self.newest.ask()
        return self.bus.asked

    def answer(self, key: str, *found: Envelope, timed_out: bool = False) -> Any:
        """The request for a key is answered with these messages; returns the newest."""
        self.bus.answer.pop(key)(Answer([(key, e.payload) for e in found], timed_out=timed_out))
        item = self.inbox.get(0.0)
        assert isinstance(item, Newest) and item.key == key
        return self.newest.finish(item, found)


def sent(key: str, sequence: int, producer: str = "p") -> Envelope:
    return Envelope(key, "raw", encode(replace(raw(sequence), header=Header(producer, sequence, "tray0"))), 0)


def test_all_producers_are_asked_first_and_then_the_one_that_answered_for_what_is_newer():
    asker = Asker(KEYS[0])
    assert asker.ask() == {KEYS[0]: (ALL_PRODUCERS, 0)}
    assert asker.answer(KEYS[0], sent(KEYS[0], 7)).header.sequence == 7
    assert asker.ask() == {}, "not before its time"
    asker.now_s = PERIOD_S
    assert asker.ask() == {KEYS[0]: ("p", 8)}
    assert asker.answer(KEYS[0], sent(KEYS[0], 60)).header.sequence == 60
    asker.now_s = 2 * PERIOD_S
    assert asker.ask() == {KEYS[0]: ("p", 61)}


def test_when_a_producer_has_nothing_newer_all_are_asked_and_what_is_known_is_not_new():
    asker = Asker(KEYS[0])
    asker.ask()
    asker.answer(KEYS[0], sent(KEYS[0], 7))
    asker.now_s = PERIOD_S
    asker.ask()
    assert asker.answer(KEYS[0]) is None
    asker.now_s = 2 * PERIOD_S
    assert asker.ask() == {KEYS[0]: (ALL_PRODUCERS, 0)}
    assert asker.answer(KEYS[0], sent(KEYS[0], 7)) is None, "the same again"
    asker.now_s = 3 * PERIOD_S
    asker.ask()
    newest = asker.answer(KEYS[0], sent(KEYS[0], 0, "its successor"), sent(KEYS[0], 7))
    assert newest.header.producer == "its successor"
    asker.now_s = 4 * PERIOD_S
    assert asker.ask() == {KEYS[0]: ("its successor", 1)}


def test_a_producer_that_does_not_answer_in_time_is_left_alone_for_a_while_and_others_are_not():
    asker = Asker(*KEYS[:2])
    asker.ask()
    asker.answer(KEYS[0], timed_out=True)
    asker.answer(KEYS[1], sent(KEYS[1], 3))
    asker.now_s = PERIOD_S
    assert asker.ask() == {KEYS[1]: ("p", 4)}
    asker.now_s = PAUSE_S
    assert asker.ask() == {KEYS[0]: (ALL_PRODUCERS, 0)}


def test_some_are_asked_at_a_time_and_every_key_has_its_turn():
    asker = Asker(*KEYS)
    asked: list[str] = []
    while under_way := asker.ask():
        assert len(under_way) <= MOST_UNDER_WAY
        asked += under_way
        for key in under_way:
            asker.answer(key, sent(key, 1))
    assert sorted(asked) == sorted(KEYS)


def test_an_answer_about_a_key_that_is_not_watched_any_more_is_ignored():
    asker = Asker(*KEYS[:2])
    asker.ask()
    asker.newest.watch({KEYS[1]})
    assert asker.answer(KEYS[0], sent(KEYS[0], 1)) is None
    asker.newest.watch(set(KEYS[:2]))
    assert asker.ask() == {KEYS[0]: (ALL_PRODUCERS, 0)}, "it begins again"


class Follower(Silent):
    """Serves all trays, and follows some."""

    def __init__(self, *trays: str) -> None:
        super().__init__()
        self.trays: set[str] = set(trays)
        self.got: dict[str, list[int]] = {TRAY_A: [], TRAY_B: []}

    def followed(self) -> Set[str] | None:
        return self.trays

    def step(self, item: Any) -> Sequence[Message]:
        if isinstance(item, Envelope):
            self.got[item.header.tray].append(item.header.sequence)
        return []


def bench_of(config: Config, follower: Follower) -> Bench:
    stage = toy(lambda _context: BuiltStage(follower), core_per_tray=False, undecoded=("raw",), may_drop=True)
    return Bench(stage, config)


def test_of_a_followed_tray_every_message_arrives_and_of_another_the_newest(config: Config):
    follower = Follower(TRAY_A)
    bench = bench_of(config, follower)
    for number in range(50):
        bench.feed(TRAY_A, number)
        bench.feed(TRAY_B, number)
    eventually(lambda: follower.got[TRAY_A] == list(range(50)), "all of tray a arrive")
    eventually(lambda: 49 in follower.got[TRAY_B], "the newest of tray b arrives")
    assert follower.got[TRAY_B] == sorted(set(follower.got[TRAY_B])) and len(follower.got[TRAY_B]) < 25
    bench.feed(TRAY_B, 50)
    eventually(lambda: follower.got[TRAY_B][-1] == 50, "a newer one is asked for")
    last = bench.end()
    assert {line.key: line.received for line in last.inputs} == {tray_key("s", TRAY_A, "raw"): 50}
    assert tray_key("s", TRAY_B, "raw") not in {each.key for each in last.waiting_for}, "it was heard"


def test_a_tray_is_followed_from_when_the_core_says_so_and_what_it_did_not_read_before_is_not_missing(config: Config):
    follower = Follower(TRAY_A)
    bench = bench_of(config, follower)
    key, got, feeder = tray_key("s", TRAY_B, "raw"), follower.got[TRAY_B], bench.publisher[TRAY_B]
    received = 0
    for _ in range(2):
        for _ in range(30):
            bench.feed(TRAY_B, 0)
        eventually(lambda: got and got[-1] == feeder.published - 1, "the newest arrives")
        before = len(got)
        follower.trays = {TRAY_B}
        eventually(lambda: key in bench.runner._receiver.current_keys, "it has subscribed")

        def arrives(before: int = before) -> bool:
            bench.feed(TRAY_B, 0)
            return len(got) > before

        eventually(arrives, "the publisher knows of the subscription")
        for _ in range(20):
            bench.feed(TRAY_B, 0)
        eventually(lambda: got[-1] == feeder.published - 1, "all arrive")
        assert got[before:] == list(range(got[before], feeder.published))
        received += feeder.published - got[before]
        follower.trays = set()
        eventually(lambda: not bench.runner._receiver.current_keys, "it has unsubscribed")
        bench.runner._receiver.on_message(key, sent(key, feeder.published - 1, "feeder").payload)  # came late
    lines = bench.end().inputs
    assert [(line.key, line.producer) for line in lines] == [(key, "")], "nobody waits for it to receive more"
    assert (lines[0].received, lines[0].missing, lines[0].duplicated) == (received, 0, 0)

"""The sequence tracker: each message once and in order, gaps recovered, the rest counted."""

from collections.abc import Iterable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fantwin.pipeline.runtime.sequence_tracker import Found, Request, SequenceTracker
from fantwin.pipeline.runtime.sessions import Session, Sessions
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.topics import CATCH_UP_MESSAGES
from tests.support import made_messages
from tests.support.numbered_packets import KEY, PRODUCER, health, packet, sequences

TOKEN = Session("scorer", "all", 1, PRODUCER, "host", 1).key("site")


def with_its_session() -> Sessions:
    """Sessions among which is that of the producer."""
    sessions = Sessions()
    sessions.update(TOKEN, alive=True)
    return sessions


class Producer:
    """Records the requests it gets, and answers them from the messages it still keeps."""

    def __init__(self, keeps: Iterable[int]) -> None:
        self.keeps = set(keeps)
        self.asked: list[tuple[int, int]] = []

    def ask(self, request: Request) -> Found:
        self.asked.append((request.first, request.last))
        kept = sorted(self.keeps, reverse=True)
        return Found([packet(s, request.producer) for s in kept if request.first <= s <= request.last])


def test_a_gap_is_filled_in_order_from_what_the_producer_keeps_and_the_rest_is_missing():
    producer = Producer(range(10))
    tracker = SequenceTracker(producer.ask)
    assert sequences(tracker.accept(packet(0))) == [0]
    assert sequences(tracker.accept(packet(4))) == [1, 2, 3, 4]
    assert producer.asked == [(1, 3)]
    assert sequences(tracker.accept(packet(4))) == [], "it comes again"
    (line,) = tracker.inputs()
    assert (line.received, line.missing, line.duplicated, line.next_sequence) == (5, 0, 1, 5)
    tracker = SequenceTracker(Producer([2]).ask)
    tracker.accept(packet(0))
    assert sequences(tracker.accept(packet(5))) == [2, 5]
    assert sequences(tracker.accept(packet(0, "new"))) == [0], "a new session has its own sequence"
    line = next(each for each in tracker.inputs() if each.producer == PRODUCER)
    assert (line.received, line.missing, line.missing_at_start, line.duplicated) == (3, 3, 0, 0)


def test_a_late_consumer_gets_the_messages_still_kept_and_counts_earlier_ones_as_history():
    producer = Producer([10**6 - 2, 10**6 - 1])
    tracker = SequenceTracker(producer.ask)
    assert sequences(tracker.accept(packet(10**6))) == [10**6 - 2, 10**6 - 1, 10**6]
    assert tracker.inputs()[0].missing == 0
    assert producer.asked == [(10**6 - CATCH_UP_MESSAGES, 10**6 - 1)], "no more than a producer keeps"


@pytest.mark.parametrize("kept_until", [5000, 5003])
def test_a_consumer_restarted_late_gets_what_is_kept_also_when_a_live_message_comes_first(kept_until):
    """What is kept is as much as may be held: it must not be taken for live messages that wait for an answer."""
    requests: list[Request] = []
    tracker = SequenceTracker(requests.append)
    live = [due for number in (5000, 5001) for due in tracker.accept(packet(number))]
    kept = [packet(number) for number in range(kept_until - CATCH_UP_MESSAGES, kept_until)]
    due = [*live, *tracker.accept_kept(kept), *tracker.accept(packet(5002))]
    assert sequences(due) == list(range(max(kept_until - CATCH_UP_MESSAGES, 5000 - CATCH_UP_MESSAGES), 5003))
    assert tracker.answer(requests[0], Found(kept, kept_until)) == []
    (line,) = tracker.inputs()
    assert (line.missing, line.duplicated) == (0, 0)


@pytest.mark.parametrize(("found", "missing"), [(Found(), 8), (Found(published=9), 0), (Found(was_asked=False), 0)])
def test_first_messages_of_a_stage_that_does_not_answer_are_missing_and_not_history(found, missing):
    tracker = SequenceTracker(lambda _request: found, sessions=with_its_session())
    assert sequences(tracker.accept(packet(8))) == [8]
    (line,) = tracker.inputs()
    assert (line.missing, line.missing_at_start) == (missing, missing)


def test_the_latest_of_many_producers_are_listed_by_name_and_the_others_summed_up():
    now_s = [0.0]
    tracker = SequenceTracker(Producer([]).ask, lambda: now_s[0])
    list(tracker.accept(packet(0, "controller")))
    for number in range(100):
        now_s[0] += 1.0
        list(tracker.accept(packet(0, f"operator-{number}")))
        list(tracker.accept(packet(3, f"operator-{number}")))
        assert sequences(tracker.accept(packet(number + 1, "controller"))) == [number + 1], (
            "the latest producers keep their state"
        )
    *named, others = tracker.inputs()
    assert {line.producer for line in named} == {"controller", *(f"operator-{number}" for number in range(37, 100))}
    assert (others.producer, others.received, others.missing) == ("", 2 * 37, 2 * 37)
    assert sum(line.received for line in tracker.inputs()) == 301


def test_health_reveals_first_and_last_messages_that_never_arrived():
    producer = Producer(range(3))
    tracker = SequenceTracker(producer.ask)
    tracker.accept(packet(0))
    assert sequences(tracker.reconcile(health(2), [KEY])) == [1]
    assert sequences(tracker.reconcile(health(3), [KEY])) == [2]
    assert sequences(tracker.reconcile(health(3), [KEY])) == []
    assert sequences(SequenceTracker(Producer([0]).ask).reconcile(health(1), [KEY])) == [0]
    assert SequenceTracker(Producer(range(3)).ask).reconcile(health(3), ["another/key"]) == []
    known = SequenceTracker(Producer([]).ask)
    assert sequences(known.reconcile(health(0), [KEY])) == []
    assert sequences(known.accept(packet(3))) == [3]
    (line,) = known.inputs()
    assert (line.received, line.missing, line.next_sequence) == (1, 3, 4), "its producer was known before"


@given(
    arriving=st.lists(st.integers(0, 60), max_size=80),
    kept=st.sets(st.integers(0, 60)),
)
def test_each_message_comes_once_and_in_order_and_the_counts_add_up(arriving, kept):
    tracker = SequenceTracker(Producer(kept).ask)
    out = [s for sequence in arriving for s in sequences(tracker.accept(packet(sequence)))]
    assert out == sorted(set(out))
    if arriving:
        (line,) = tracker.inputs()
        assert line.received == len(out)
        assert line.missing == line.next_sequence - out[0] - len(out)


class SlowProducer:
    """Takes requests and answers none; `now_s` is the time."""

    def __init__(self) -> None:
        self.asked: list[Request] = []
        self.now_s = 0.0

    def ask(self, request: Request) -> None:
        self.asked.append(request)


def tracker_of_session(slow: SlowProducer, *, alive: bool, replaced: bool = False) -> SequenceTracker:
    sessions = with_its_session()
    if replaced:
        sessions.update(Session("scorer", "all", 2, "scorer-all-new", "host", 2).key("site"), alive=True)
    tracker = SequenceTracker(slow.ask, lambda: slow.now_s, sessions)
    assert sequences(tracker.accept(packet(0))) == [0]
    sessions.update(TOKEN, alive=alive)
    return tracker


@pytest.mark.parametrize(
    ("alive", "replaced", "patience_s"), [(True, False, 120.0), (False, False, 120.0), (False, True, 5.0)]
)
@pytest.mark.parametrize("answers", [True, False])
def test_row_16_a_stage_that_does_not_answer_is_asked_again_for_a_while(
    alive: bool, replaced: bool, patience_s: float, answers: bool
):
    """A link may be slow or lose requests, and a stage whose token has gone may be cut off, unless it is replaced."""
    slow = SlowProducer()
    tracker = tracker_of_session(slow, alive=alive, replaced=replaced)
    assert tracker.accept(packet(4)) == []
    while slow.now_s < patience_s:
        assert tracker.answer(slow.asked[-1], Found()) == []
        assert (slow.asked[-1].first, slow.asked[-1].last) == (1, 3)
        slow.now_s += 1.0
        assert slow.asked[-1].not_before_s <= slow.now_s
    found = Found([packet(2)], published=6) if answers else Found()
    assert sequences(tracker.answer(slow.asked[-1], found)) == [2, 4][not answers :]
    assert tracker.inputs()[0].missing == 3 - answers


def test_row_16_a_stage_that_is_left_alone_because_it_did_not_answer_is_asked_later():
    slow = SlowProducer()

    def ask(request: Request) -> Found | None:
        return slow.ask(request) if request.not_before_s else Found()

    tracker = SequenceTracker(ask, lambda: slow.now_s, with_its_session())
    assert sequences(tracker.accept(packet(0))) == [0]
    assert tracker.accept(packet(4)) == []
    (later,) = slow.asked
    assert sequences(tracker.answer(later, Found([packet(n) for n in (1, 2, 3)], published=5))) == [1, 2, 3, 4]
    assert tracker.inputs()[0].missing == 0


def test_row_16_a_stage_that_has_said_that_it_ends_does_not_return():
    slow, sessions = SlowProducer(), with_its_session()
    tracker = SequenceTracker(slow.ask, lambda: slow.now_s, sessions)
    assert sequences(tracker.accept(packet(0))) == [0]
    last = made_messages.health("scorer", producer=PRODUCER, status=StageStatus.STOPPED, is_last=True)
    sessions.add_health(last, {KEY})
    sessions.update(TOKEN, alive=False)
    assert tracker.accept(packet(4)) == []
    slow.now_s = 5.0
    assert sequences(tracker.answer(slow.asked[-1], Found())) == [4]


def test_row_16_whoever_ends_goes_on_without_the_answers_that_are_due():
    slow = SlowProducer()
    tracker = tracker_of_session(slow, alive=False)
    assert tracker.accept(packet(4)) == []
    assert tracker.accept(packet(5)) == []
    assert tracker.accept(packet(8)) == []
    assert sequences(tracker.give_up()) == [4, 5, 8]
    assert not tracker.is_waiting
    assert tracker.inputs()[0].missing == 5


def test_row_16_the_rest_of_an_answer_that_was_not_complete_is_asked_for_at_once():
    slow = SlowProducer()
    tracker = tracker_of_session(slow, alive=True)
    assert tracker.accept(packet(100)) == []
    slow.now_s = 1000.0
    assert sequences(tracker.answer(slow.asked[-1], Found([packet(n) for n in range(1, 40)]))) == [*range(1, 40)]
    assert (slow.asked[-1].first, slow.asked[-1].last, slow.asked[-1].not_before_s) == (40, 99, 0.0)
    assert tracker.accept(packet(101)) == []
    assert sequences(tracker.answer(slow.asked[-1], Found([packet(n) for n in range(40, 100)], 102))) == [
        *range(40, 102)
    ]
    assert tracker.inputs()[0].missing == 0

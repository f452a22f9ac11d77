"""Sequence numbers are believed only within what is possible: nobody ends a stream by a high number in its name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.runtime.sequence_tracker import REFUSAL_SHOWN_S, Found, SequenceTracker
from fantwin.pipeline.runtime.tracked_streams import Request
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.header import Header
from fantwin.schemas.health import Health, Output
from fantwin.schemas.messages import Grid, Raw
from fantwin.schemas.topics import BY_NAME, health_key, tray_key
from tests.pipeline.runtime.test_sequence_tracker import KEY, PRODUCER, health, packet, sequences
from tests.support.toy_stage import TRAY_A, Bench, raw, toy


class RealProducer:
    """Answers as a publisher does: with what it keeps, and with how many messages it has published."""

    def __init__(self, published: int) -> None:
        self.published = published

    def ask(self, request: Request) -> Found:
        kept = range(request.first, min(request.last + 1, self.published))
        return Found([packet(sequence) for sequence in kept], self.published)


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def unanswered(_request: Request) -> Found:
    return Found()


@pytest.mark.parametrize("forged", [12, 2**64 - 1])
def test_row_10_a_number_that_its_producer_has_not_reached_is_refused(forged):
    producer = RealProducer(10)
    tracker = SequenceTracker(producer.ask)
    assert sequences(tracker.accept(packet(9))) == list(range(10))
    assert tracker.accept(packet(forged)) == []
    producer.published = 12
    assert sequences(tracker.accept(packet(10))) == [10]
    assert sequences(tracker.accept(packet(11))) == [11]
    (line,) = tracker.inputs()
    assert (line.received, line.missing, line.duplicated) == (12, 0, 0)
    assert tracker.counters() == {"refused_numbers": 1}
    assert f"{KEY}: {PRODUCER} cannot have published {forged + 1} messages after 10" in tracker.problem()
    first = SequenceTracker(RealProducer(2).ask)
    assert sequences(first.accept(packet(10**9))) == [], "also as the first message"
    assert sequences(first.accept(packet(1))) == [0, 1]


def test_row_10_without_an_answer_a_number_is_believed_as_far_as_its_producer_can_have_come():
    clock = Clock()
    tracker = SequenceTracker(unanswered, clock)
    tracker.accept(packet(0))
    assert tracker.accept(packet(100_000)) == []
    assert sequences(tracker.accept(packet(1))) == [1]
    clock.now_s += 30.0  # a link that was lost for so long: its producer has died meanwhile
    assert sequences(tracker.accept(packet(30_000))) == [30_000]
    assert tracker.inputs()[0].missing == 29_998
    assert tracker.counters() == {"refused_numbers": 1}
    assert tracker.problem()
    clock.now_s += REFUSAL_SHOWN_S
    assert not tracker.problem()


@pytest.mark.parametrize("claimed", [10**9, 2**64 - 1])
def test_row_10_a_health_that_claims_more_than_possible_is_not_believed(claimed):
    tracker = SequenceTracker(unanswered)
    tracker.accept(packet(0))
    assert not tracker.believes(health(claimed))
    assert tracker.believes(health(2))
    assert tracker.counters() == {"refused_numbers": 1}


def test_row_10_a_health_that_claims_more_than_its_producer_has_published_skips_nothing():
    tracker = SequenceTracker(RealProducer(3).ask)
    assert sequences(tracker.accept(packet(2))) == [0, 1, 2]
    assert tracker.believes(health(500)), "it is possible, as far as this consumer knows"
    assert tracker.reconcile(health(500), [KEY]) == []
    assert sequences(tracker.accept(packet(3))) == [3]
    assert tracker.inputs()[0].missing == 0


class Forger:
    """Another program that publishes in the name of the feeder."""

    def __init__(self, bus: Bus) -> None:
        self._raw = bus.publisher(tray_key("s", TRAY_A, "raw"), BY_NAME["raw"], type_name(Raw), "forger")
        self._health = bus.publisher(
            health_key("s", "acquisition", TRAY_A), BY_NAME["health"], type_name(Health), "forger"
        )

    def raw(self, sequence: int) -> None:
        self._raw.put(encode(replace(raw(1), header=Header("feeder", sequence, TRAY_A))))

    def health(self, published: int) -> None:
        self._health.put(
            encode(
                Health(
                    header=Header("feeder", 0, ""),
                    stage="acquisition",
                    instance=TRAY_A,
                    status=StageStatus.OK,
                    t_ns=0,
                    uptime_s=0,
                    outputs=(Output(key=tray_key("s", TRAY_A, "raw"), published=published),),
                )
            )
        )


@pytest.mark.parametrize("forge", [lambda forger: forger.raw(10**6), lambda forger: forger.health(10**6)])
def test_row_10_a_forged_message_does_not_make_real_samples_duplicates(config, forge: Callable[[Forger], None]):
    bench = Bench(toy(), config)
    bench.feed(TRAY_A, 1)
    assert bench.next(Grid).t_ns.tolist() == [1]
    forge(Forger(bench.bus))
    warned = bench.health_with(lambda health: "cannot have published" in health.problem)
    for t_ns in range(2, 5):
        bench.feed(TRAY_A, t_ns)
    assert [bench.next(Grid).t_ns.tolist() for _ in range(3)] == [[2], [3], [4]]
    bench.end()
    assert warned.status == StageStatus.DEGRADED
    assert "feeder cannot have published" in warned.problem

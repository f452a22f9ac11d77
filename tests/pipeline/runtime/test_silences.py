"""Whether nothing comes because nothing is sent, or because a link may be cut."""

from __future__ import annotations

from pipeline.runtime.silences import Silences
from schemas.messages import Header, Health, Output, StageStatus
from schemas.topics import tray_key

KEY = tray_key("s", "a", "raw")


def health(published: int, status: StageStatus = StageStatus.OK) -> Health:
    return Health(
        header=Header("p", 0, ""),
        stage="acquisition",
        instance="a",
        status=status,
        t_ns=0,
        uptime_s=0.0,
        outputs=(Output(key=KEY, published=published), Output(key="another", published=9)),
    )


class Arrived:
    def __init__(self) -> None:
        self.number = 0

    def has_all_of(self, stream: tuple[str, str], published: int) -> bool:
        assert stream == (KEY, "p")
        return self.number >= published


def test_row_16_a_silence_is_shown_once_by_each_health_that_says_that_all_has_arrived():
    silences, arrived = Silences({KEY: "a"}), Arrived()
    assert silences.take("a"), "a producer that never publishes health shows nothing else"
    silences.add_health(health(5), arrived.has_all_of)
    assert not silences.take("a"), "five messages are on the way"
    arrived.number = 5
    assert not silences.take("a"), "that they have arrived now says nothing about later ones"
    silences.add_health(health(5), arrived.has_all_of)
    assert silences.take("a")
    assert not silences.take("a")


def test_after_a_producer_that_has_stopped_in_order_nothing_more_is_waited_for():
    silences, arrived = Silences({KEY: "a"}), Arrived()
    silences.add_health(health(5), arrived.has_all_of)
    arrived.number = 5
    silences.add_health(health(5, StageStatus.STOPPED), arrived.has_all_of)
    assert silences.take("a")
    assert silences.take("a")


def test_what_a_producer_that_has_stopped_in_order_has_sent_is_still_waited_for():
    silences, arrived = Silences({KEY: "a"}), Arrived()
    silences.add_health(health(5, StageStatus.STOPPED), arrived.has_all_of)
    assert not silences.take("a"), "its last messages are still being fetched"
    arrived.number = 5
    assert silences.take("a")
    assert silences.take("a")


def test_a_producer_that_begins_again_is_waited_for_again():
    silences, arrived = Silences({KEY: "a"}), Arrived()
    silences.add_health(health(5, StageStatus.STOPPED), arrived.has_all_of)
    silences.add_health(health(7), arrived.has_all_of)
    arrived.number = 5
    assert not silences.take("a"), "the seventh is on the way"

"""Whether nothing comes because nothing is sent, or because a link may be cut."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

from fantwin.pipeline.runtime.sessions import Session, Sessions, this_host
from fantwin.pipeline.runtime.silences import BEGINS_NS, MOST_DELAY_S, RESTART_S, Silences
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.health import Output
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import NS_PER_S
from tests.support import made_messages

KEY = tray_key("s", "a", "raw")
STARTING, OK, DEGRADED, STOPPED = StageStatus.STARTING, StageStatus.OK, StageStatus.DEGRADED, StageStatus.STOPPED


class Consumer:
    """A stage with one main input. A health arrives at once, unless its time of sending is given."""

    def __init__(self) -> None:
        self.now_s = 1e6
        self.arrived = 0
        self.sessions = Sessions()
        self.silences = Silences({KEY: "a"}, self.sessions, lambda: self.now_s)

    def hear(
        self,
        published: int,
        status: StageStatus = OK,
        producer: str = "p",
        *,
        has_more: bool = False,
        **fields: Any,
    ) -> None:
        own, another = (
            Output(key=KEY, published=published, has_more=has_more),
            Output(key="x", published=9, has_more=True),
        )
        about: dict[str, Any] = {
            "status": status,
            "t_ns": round(self.now_s * NS_PER_S),
            "outputs": (own, another),
            "stage": "acquisition",
        }
        health = made_messages.health(instance="a", producer=producer, **(about | fields))
        self.sessions.add_health(health, {KEY})
        self.silences.add_health(health, self._has_all_of)

    def _has_all_of(self, stream: tuple[str, str], published: int) -> bool:
        assert stream[0] == KEY
        return self.arrived >= published

    def is_shown(self) -> bool:
        return self.silences.take("a")


@pytest.fixture
def consumer() -> Consumer:
    return Consumer()


def test_row_16_a_silence_is_shown_once_by_each_health_that_says_that_all_was_processed_and_has_arrived(consumer):
    assert consumer.is_shown(), "a producer that never publishes health shows nothing else"
    consumer.hear(5)
    assert not consumer.is_shown(), "five messages are on the way"
    consumer.arrived = 5
    assert not consumer.is_shown(), "that they have arrived now says nothing about later ones"
    consumer.hear(5, has_more=True)
    assert not consumer.is_shown(), "it could not send for a while, and samples wait in it"
    consumer.hear(5)
    assert consumer.is_shown()
    assert not consumer.is_shown()


def test_row_16_a_health_that_was_cut_off_on_its_way_shows_nothing_also_after_one_of_another_producer(consumer):
    consumer.arrived = 5
    consumer.hear(5)
    assert consumer.is_shown()
    sent_ns = round(consumer.now_s * NS_PER_S)
    consumer.now_s += MOST_DELAY_S + 0.1
    consumer.hear(5, t_ns=sent_ns)
    assert not consumer.is_shown(), "samples were sent after it, and come next"
    consumer.hear(5)
    assert consumer.is_shown()
    consumer.now_s += 30.0
    consumer.hear(0, STARTING, "q")
    consumer.hear(5, t_ns=sent_ns)
    assert not consumer.is_shown()


def test_row_16_a_session_that_has_just_begun_shows_nothing_before_its_first_message(consumer):
    """It may still read what its device kept while none ran."""
    consumer.hear(0, STARTING)
    consumer.now_s += BEGINS_NS / NS_PER_S + 1.0
    for status in (STARTING, OK):
        consumer.hear(0, status)
        assert not consumer.is_shown()
    consumer.now_s += BEGINS_NS / NS_PER_S - 0.1
    consumer.hear(0)
    assert not consumer.is_shown(), "it counts from the end of its start"
    consumer.hear(1)
    assert not consumer.is_shown()
    consumer.arrived = 1
    consumer.hear(1)
    assert consumer.is_shown()


@pytest.mark.parametrize("ends", [STOPPED, DEGRADED, "killed"])
def test_row_11_what_a_producer_that_has_ended_has_sent_is_still_waited_for(consumer, ends):
    if ends == "killed":
        consumer.hear(5)
        consumer.silences.end("another")
        consumer.silences.end("p")
    else:
        consumer.hear(5, ends, is_last=True)
    if ends != STOPPED:  # in order, so that no other session is waited for
        consumer.now_s += RESTART_S
    assert not consumer.is_shown(), "its last messages are still being fetched"
    consumer.arrived = 5
    assert consumer.is_shown()
    assert consumer.is_shown()
    consumer.hear(7)
    assert not consumer.is_shown(), "it has begun again, and the seventh is on the way"


def test_row_11_after_a_crash_the_next_session_is_waited_for_a_few_seconds_only(consumer):
    consumer.arrived = 5
    consumer.hear(5, DEGRADED, is_last=True)
    consumer.now_s += RESTART_S - 0.1
    assert not consumer.is_shown(), "the next one reads what the device keeps meanwhile"
    consumer.now_s += 0.2
    assert consumer.is_shown()
    assert consumer.is_shown()


FIRST, SECOND = (
    Session("acquisition", "a", started, f"acquisition-a-0{started}", this_host(), started) for started in (1, 2)
)


@pytest.fixture
def of_two(consumer: Consumer) -> Consumer:
    """Two sessions have the tray. The one that started later is its owner; of its nine messages, four are kept."""
    for session in (FIRST, SECOND):
        consumer.sessions.update(session.key("s"), alive=True)
    consumer.arrived = 5
    consumer.hear(9, OK, SECOND.producer)
    assert not consumer.is_shown()
    return consumer


def test_row_11_a_session_that_does_not_own_the_tray_shows_nothing(of_two):
    for _ in range(2 * BEGINS_NS // NS_PER_S):
        of_two.now_s += 1.0
        of_two.hear(0, OK, FIRST.producer)
        assert not of_two.is_shown()
    of_two.hear(0, STOPPED, FIRST.producer)
    assert not of_two.is_shown()
    assert not of_two.is_shown(), "it was another session that ended"


def test_row_11_a_session_that_has_become_the_owner_shows_a_silence(of_two):
    of_two.sessions.update(SECOND.key("s"), alive=False)
    of_two.hear(5, OK, FIRST.producer)
    assert of_two.is_shown()


@pytest.mark.parametrize("stage", ["acquisition", "another"])
def test_row_11_a_producer_that_is_no_session_shows_nothing_where_a_session_publishes(of_two, stage):
    of_two.hear(5, OK, "stranger", stage=stage)
    assert not of_two.is_shown()


def token(process_id: int, host: str = this_host()) -> str:
    return Session("acquisition", "a", 1, "acquisition-a-01", host, process_id).key("s")


def test_row_11_a_session_without_a_token_was_killed_if_its_process_runs_no_more():
    now_s = 0.0
    sessions = Sessions(lambda: now_s)
    process = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)
    key = token(process.pid)
    try:
        sessions.update(key, alive=True)
        sessions.update(key, alive=False)
        assert sessions.take_killed() == [], "only its link was cut"
        cut_off: list[bool] = []
        for now_s in (1.9, 2.0, 59.9, 60.0):  # noqa: B007  read by the sessions
            cut_off.append(sessions.has_cut_off())
        assert cut_off == [False, True, True, False]
        now_s = 10.0
        sessions.update(key, alive=True)
        assert not sessions.has_cut_off(), "it is back"
        sessions.update(key, alive=False)
    finally:
        process.kill()
        process.communicate()
    now_s = 15.0
    assert not sessions.has_cut_off(), "it was killed"
    assert sessions.take_killed() == ["acquisition-a-01"]
    assert sessions.take_killed() == []


def test_row_11_whether_a_process_elsewhere_runs_is_not_known():
    sessions = Sessions()
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    for key in (token(process.pid), token(1, "elsewhere")):  # the first never ran where it can be seen from here
        sessions.update(key, alive=True)
        sessions.update(key, alive=False)
    assert sessions.take_killed() == []

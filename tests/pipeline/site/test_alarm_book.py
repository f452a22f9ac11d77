"""Current alarms whatever order messages come in, and whoever forges some."""

from __future__ import annotations

import itertools
from typing import Any

from fantwin.pipeline.site.alarm_book import AlarmBook
from fantwin.pipeline.site.fleet import Fan
from fantwin.schemas.enums import Transition
from fantwin.schemas.messages import Alarm
from tests.support.notified_alarms import TRAY, alarm, cleared

FAN = Fan(TRAY, 2)


def book_of(*messages: Alarm) -> AlarmBook:
    book = AlarmBook()
    for each in messages:
        book.add(each)
    return book


def newest(*messages: Alarm) -> Any:
    current = book_of(*messages).of(FAN)
    assert current is not None
    return current.newest


def test_the_message_that_a_scorer_sent_last_decides_in_any_order() -> None:
    sent = [alarm(fan=1), alarm(), cleared(), alarm(Transition.ACKNOWLEDGED, acknowledged=True, active=False)]
    for messages in itertools.permutations(sent):
        found = [(each.newest.fan, each.newest.active) for each in book_of(*messages).all()]
        assert found == [(1, True), (2, False)]
        assert newest(*messages).acknowledged


def test_of_several_scorers_the_one_that_came_last_decides_whatever_its_times() -> None:
    before, later = alarm(producer="killed", t_ns=900), cleared(producer="killed", t_ns=950)
    again = alarm(Transition.REPUBLISHED, producer="next", t_ns=960)
    assert newest(before, again) is again
    assert newest(before, again, later) is again, "what the former one said has come too late"
    replayed = alarm(producer="replay", t_ns=7)
    assert newest(before, again, replayed) is replayed


def test_forged_messages_with_the_next_numbers_of_a_scorer_hide_no_alarm() -> None:
    begun, raised = alarm(fan=1, sequence=19), alarm(sequence=20)
    forged = [cleared(sequence=number, onset_s=-5.0) for number in range(20, 40)]
    assert newest(begun, *forged, raised) is raised
    worse = alarm(Transition.SEVERITY, sequence=21)
    assert newest(begun, *forged, raised, worse) is worse

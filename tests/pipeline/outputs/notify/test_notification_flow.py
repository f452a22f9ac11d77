"""What a target hears, and when: messages and a clock go in, texts come out."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import pytest

from fantwin.pipeline.outputs.notify.config import NotifierConfig
from fantwin.pipeline.outputs.notify.notification_flow import FIRST_LOOK_NS, Changes, Notifications, Saved
from fantwin.pipeline.outputs.notify.wording import Level, Place, Text
from fantwin.schemas.enums import Feedback, Severity, Transition
from fantwin.schemas.messages import Alarm, Diagnosis
from fantwin.schemas.units import NS_PER_S
from tests.support.notified_alarms import START_NS, alarm, cleared

TARGET = {"name": "mail", "url_file": "mail.url"}
TEN_AT_NIGHT_NS = round(datetime(2026, 9, 21, 22, 0, tzinfo=UTC).timestamp()) * NS_PER_S


class Desk:
    """Notifications with a clock, and the file that they would be saved in."""

    def __init__(self, start_ns: int = START_NS, is_first: bool = False, **target: Any) -> None:
        self.now_ns = start_ns
        settings = target.pop("settings", {})
        self.config = NotifierConfig.model_validate(
            {"target": [TARGET | target], "page": "https://hall.example", **settings}
        )
        self.saved = Saved(is_first=is_first)
        self.heard: list[Alarm] = []
        self.begin()

    def begin(self) -> None:
        place = Place("hall", self.config.page)
        self.notifications = Notifications(self.config, place, self.saved, self.heard)

    def hear(self, *messages: Alarm) -> None:
        for message in messages:
            self.heard.append(message)
            self.notifications.add(message, self.now_ns)

    def wait(self, seconds: float) -> list[Text]:
        """The texts that are sent in this time."""
        texts: list[Text] = []
        end_ns = self.now_ns + round(seconds * NS_PER_S)
        step_ns = max(NS_PER_S, round(seconds / 1000.0 * NS_PER_S))  # of a day not each second
        while self.now_ns < end_ns:
            self.now_ns = min(end_ns, self.now_ns + step_ns)
            self.notifications.tick(self.now_ns)
            changes, self.notifications.changes = self.notifications.changes, Changes()
            texts += [each.text for each in changes.outgoing]
        return texts


def titles(texts: list[Text]) -> list[str]:
    return [text.title.removesuffix(" (hall)") for text in texts]


def test_an_alarm_is_raised_worse_and_cleared_and_each_is_said_once_with_cause_and_advice():
    desk = Desk()
    desk.hear(alarm())
    assert desk.wait(4) == [], "it waits for others that could go with it"
    (raised,) = desk.wait(2)
    assert raised.title == "WARNING, fan 2 of tray1 (hall)"
    assert raised.level == Level.WARNING
    assert raised.body.splitlines() == [
        "fan 2 of tray1 at hall: WARNING since 2026-09-21 14:13:20 UTC",
        "90 rpm below the twin (limit 50) at 2026-09-21 14:13:20 UTC",
        "Cause: more drag (airflow blocked, filter clogged), 80 % (drag +20 %), or more friction (bearing), 20 %",
        "What to do: see whether the airflow is free and the filter is clean",
        "Not acknowledged.",
        "As of 2026-09-21 14:13:25 UTC",
        "https://hall.example/#/fan/tray1/2",
    ]
    desk.hear(alarm(Transition.SEVERITY, severity=Severity.ALARM), alarm(Transition.DIAGNOSED, severity=Severity.ALARM))
    assert titles(desk.wait(10)) == ["Worse: ALARM, fan 2 of tray1"]
    said = {"operator_name": "ann", "comment": "a door was open", "marked_onset_t_ns": START_NS}
    marked = {"feedback": Feedback.FALSE_ALARM, "severity": Severity.ALARM, **said}
    desk.hear(
        alarm(Transition.MARKED_FALSE, **marked), alarm(Transition.SEVERITY), alarm(Transition.SEVERITY, **marked)
    )
    assert desk.wait(1000) == [], "feedback is for nobody else, and no severity is said twice"
    desk.hear(cleared(severity=Severity.ALARM))
    (over,) = desk.wait(10)
    assert (over.title, over.level) == ("Cleared: alarm, fan 2 of tray1 (hall)", Level.GOOD)
    assert "Deviation: 90 rpm below the twin (limit 50) at 2026-09-21 14:13:20 UTC" in over.body
    assert desk.wait(20_000) == [], "what is over is not sent again"


def test_it_is_sent_again_until_it_is_acknowledged_and_silenced_fans_send_nothing():
    desk = Desk(repeat_s=600)
    desk.hear(alarm())
    assert len(desk.wait(10)) == 1
    again = desk.wait(1300)
    assert titles(again) == ["Still: WARNING, fan 2 of tray1"] * 2
    assert "This is reminder 2." in again[1].body
    desk.hear(alarm(Transition.ACKNOWLEDGED, acknowledged=True, operator_name="ann"))
    assert desk.wait(2000) == []
    desk.hear(alarm(Transition.SEVERITY, severity=Severity.ALARM, acknowledged=True))
    (worse,) = desk.wait(10)
    assert "Acknowledged by ann." in worse.body
    desk.hear(alarm(Transition.SHELVED, fan=3, onset_s=5, shelved_until_t_ns=1), alarm(fan=5, out_of_service=True))
    assert desk.wait(2000) == []
    desk.hear(alarm(Transition.UNSHELVED, fan=3, onset_s=5))
    assert titles(desk.wait(10)) == ["WARNING, fan 3 of tray1"], "from now on it is presented"


def test_what_an_operator_shelves_while_its_message_waits_is_not_sent_and_sent_again_when_that_ends():
    desk = Desk()
    desk.hear(alarm(), alarm(Transition.SHELVED, shelved_until_t_ns=1))
    assert desk.wait(60) == []
    desk.hear(alarm(Transition.UNSHELVED))
    assert titles(desk.wait(60)) == ["Still: WARNING, fan 2 of tray1"]
    desk.hear(alarm(Transition.SHELVED, shelved_until_t_ns=1), cleared(shelved_until_t_ns=1))
    assert desk.wait(60) == []
    desk.hear(cleared())
    assert titles(desk.wait(60)) == ["Cleared: alarm, fan 2 of tray1"]


def test_lost_data_are_said_once_in_words():
    desk = Desk(repeat_s=600)
    desk.hear(alarm())
    desk.wait(10)
    desk.hear(alarm(Transition.DATA_LOST, stale=True, message="fan 2: not confirmed by data"))
    (lost,) = desk.wait(10)
    assert lost.title == "Not confirmed by data: WARNING, fan 2 of tray1 (hall)"
    desk.hear(alarm(Transition.DATA_RESTORED), alarm(Transition.DATA_LOST, stale=True))
    assert desk.wait(10) == []
    assert "Not confirmed by data: there are no samples to judge." in desk.wait(600)[0].body


def test_an_escalation_hears_only_what_nobody_has_acknowledged_for_long():
    desk = Desk(escalation_after_s=900, repeat_s=0)
    desk.hear(alarm(fan=1), alarm(fan=2))
    assert desk.wait(800) == []
    desk.hear(alarm(Transition.ACKNOWLEDGED, fan=1, acknowledged=True, operator_name="ann"))
    assert titles(desk.wait(200)) == ["Nobody has acknowledged: WARNING, fan 2 of tray1"]
    desk.hear(cleared(1), cleared(2))
    assert titles(desk.wait(100)) == ["Cleared: alarm, fan 2 of tray1"], "it never heard of the other"
    desk.hear(alarm(fan=3))
    assert len(desk.wait(1000)) == 1
    desk.hear(alarm(fan=3, onset_s=1000))
    assert desk.wait(100) == []
    desk.hear(cleared(3))
    assert titles(desk.wait(100)) == ["Cleared: alarm, fan 3 of tray1"], "of what it has heard begin it hears the end"


def test_a_target_hears_of_its_severity_and_trays_only():
    desk = Desk(severity="alarm", trays=["tray1"])
    desk.hear(alarm(), alarm(tray="tray2", severity=Severity.ALARM))
    assert desk.wait(60) == []
    desk.hear(alarm(Transition.SEVERITY, severity=Severity.ALARM))
    assert titles(desk.wait(60)) == ["ALARM, fan 2 of tray1"]


def test_a_power_cut_is_one_message_and_its_end_another():
    desk = Desk()
    tie = tuple(Diagnosis(cause=cause, probability=0.4) for cause in ("blocked", "no_power"))
    for fan in range(500):
        desk.hear(alarm(fan=fan % 200, tray=f"tray{fan // 200}", causes=tie))
        if fan % 50 == 49:
            assert desk.wait(1) == []
    for fan in range(200):
        desk.hear(alarm(Transition.SEVERITY, fan=fan, tray="tray0", severity=Severity.ALARM))
    (digest,) = desk.wait(100)
    assert digest.title == "500 alarms in 3 trays (hall): 200 ALARM, 300 WARNING"
    assert digest.level == Level.ALARM
    lines = digest.body.splitlines()
    assert lines[1:4] == ["tray0: 200 fans: 0-199", "tray1: 200 fans: 0-199", "tray2: 100 fans: 0-99"]
    assert "Most probable causes: blocked or no power 300" in digest.body, digest.body
    assert lines[-1] == "https://hall.example"
    assert len(digest.body) < 1000
    for fan in range(200):
        desk.hear(alarm(Transition.DATA_LOST, fan=fan, tray="tray0", severity=Severity.ALARM, stale=True))
    (lost,) = desk.wait(100)
    assert lost.title == "200 alarms in 1 tray (hall): 200 ALARM, 200 no longer confirmed by data"
    desk.hear(*(cleared(fan, tray="tray2") for fan in range(5)))
    (over,) = desk.wait(60)
    assert (over.title, over.level) == ("5 alarms cleared in 1 tray (hall)", Level.GOOD)
    assert over.body.startswith("5 alarms cleared in 1 tray at hall\ntray2: cleared: 5 fans: 0-4\n")


def test_while_more_fans_keep_coming_messages_become_rarer():
    desk = Desk()
    times: list[float] = []
    for second in range(400):
        desk.hear(alarm(fan=second))
        times += [second for _ in desk.wait(1)]
    assert len(times) == 3, times
    assert times[0] == pytest.approx(30, abs=2)
    assert times[1] - times[0] == pytest.approx(60, abs=2)
    desk.wait(300)
    texts: list[Text] = []
    for second in range(40):
        desk.hear(alarm(fan=5000 + second))
        texts += desk.wait(1)
    assert len(texts) == 1, "after a rest a message waits for short again"


def test_quiet_hours_hold_what_is_less_severe_and_say_it_at_their_end():
    desk = Desk(TEN_AT_NIGHT_NS, quiet_hours="22:00-06:00", repeat_s=3600)
    desk.hear(alarm(fan=1), alarm(fan=2), alarm(fan=3, severity=Severity.ALARM))
    assert titles(desk.wait(60)) == ["ALARM, fan 3 of tray1"]
    desk.hear(alarm(Transition.ACKNOWLEDGED, fan=3, severity=Severity.ALARM, acknowledged=True), cleared(1))
    desk.hear(alarm(Transition.SEVERITY, fan=2, severity=Severity.ALARM))
    (worse,) = desk.wait(60)
    assert worse.title == "ALARM, fan 2 of tray1 (hall)", "it was not heard of before"
    desk.hear(alarm(Transition.ACKNOWLEDGED, fan=2, severity=Severity.ALARM, acknowledged=True))
    desk.hear(alarm(fan=4))
    assert desk.wait(7.8 * 3600) == []
    (held,) = desk.wait(3600)
    assert held.body.startswith("Held during quiet hours:\n2 alarms in 1 tray at hall: 1 WARNING, 1 cleared")
    assert held.title.startswith("2 alarms in 1 tray")


def test_after_a_restart_nothing_is_said_twice_or_lost_and_what_was_missed_is_said():
    desk = Desk(repeat_s=0)
    history = [alarm(onset_s=1), cleared(onset_s=1), alarm(onset_s=50), alarm(fan=3, onset_s=60)]
    desk.hear(*history)
    assert len(desk.wait(60)) == 2
    desk.begin()
    missed = [alarm(fan=4, onset_s=100), cleared(fan=4, onset_s=100), cleared(onset_s=50)]
    desk.hear(*history, *missed)
    assert desk.wait(2) == []
    desk.begin()
    assert titles(desk.wait(60)) == ["Raised and cleared: alarm, fan 4 of tray1", "Cleared: alarm, fan 2 of tray1"]


def test_a_restarted_scorer_that_publishes_its_alarms_again_brings_no_message():
    desk = Desk(repeat_s=0)
    desk.hear(alarm())
    desk.wait(10)
    desk.hear(alarm(Transition.REPUBLISHED, producer="scorer-all-2", sequence=0))
    assert desk.wait(100) == []
    # one that begins without its state discards the alarm
    discarded = {"active": False, "severity": Severity.NONE, "onset_t_ns": 0, "acknowledged": True}
    desk.hear(alarm(Transition.REPUBLISHED, producer="scorer-all-3", sequence=0, **discarded))
    (over,) = desk.wait(10)
    assert "fan 2 of tray1 at hall: no alarm" in over.body


def test_messages_that_come_again_do_not_undo_what_came_after_them():
    desk = Desk(repeat_s=600)
    raised, acknowledged = alarm(), alarm(Transition.ACKNOWLEDGED, acknowledged=True)
    desk.hear(raised, acknowledged)
    desk.wait(1000)
    desk.begin()
    desk.hear(raised)
    assert desk.wait(1000) == [], "it is still acknowledged"
    desk.hear(alarm(onset_s=900, producer="scorer-all-2"), raised, cleared())
    assert titles(desk.wait(10)) == ["WARNING, fan 2 of tray1"], "what a former scorer says is old"
    desk.hear(cleared(onset_s=900, producer="scorer-all-2"))
    assert titles(desk.wait(10)) == ["Cleared: alarm, fan 2 of tray1"]


def test_the_first_notifier_of_a_site_says_what_is_presented_and_not_what_was():
    desk = Desk(is_first=True)
    desk.hear(*(message for n in range(50) for message in (alarm(onset_s=n), cleared(onset_s=n))))
    desk.hear(alarm(fan=3), alarm(fan=4), alarm(Transition.ACKNOWLEDGED, fan=4, acknowledged=True))
    assert desk.wait(FIRST_LOOK_NS / NS_PER_S) == []
    assert titles(desk.wait(10)) == ["WARNING, fan 3 of tray1"]


def test_a_clock_that_is_set_back_holds_nothing_up():
    desk = Desk(escalation_after_s=900, repeat_s=1800)
    desk.hear(alarm())
    desk.wait(60)
    desk.now_ns -= 86_400 * NS_PER_S
    assert titles(desk.wait(960)) == ["Nobody has acknowledged: WARNING, fan 2 of tray1"]
    desk.now_ns -= 86_400 * NS_PER_S
    assert titles(desk.wait(1860))[0] == "Still: WARNING, fan 2 of tray1"
    first = Desk(is_first=True)
    first.hear(alarm())
    assert first.wait(2) == []
    first.now_ns -= 86_400 * NS_PER_S
    assert titles(first.wait(20)) == ["WARNING, fan 2 of tray1"], "the first look takes as long as ever"

"""The notifier against real servers on loopback: mail, webhook, Alertmanager; outages, kills and restarts."""

from __future__ import annotations

import socket
import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.outputs.notify import sending
from fantwin.pipeline.outputs.notify.config import NotifierConfig
from fantwin.pipeline.outputs.notify.outbox import Outbox
from fantwin.pipeline.outputs.notify.sending import MAY_BE_REPEATED
from fantwin.pipeline.runtime.stage import StageError
from fantwin.pipeline.site.alarm_history import FILE, AlarmHistory
from fantwin.schemas.enums import Severity, Transition
from fantwin.schemas.messages import Alarm
from fantwin.schemas.units import NS_PER_S
from fantwin.stages.notifier import NotifierCore
from tests.support.message_receivers import ALERTMANAGER, HttpReceiver, MailServer, RunningAlertmanager
from tests.support.notified_alarms import START_NS, alarm, cleared, notifier_core, secret
from tests.support.running_chain import eventually


class Notifier:
    """A notifier whose clock the test moves; its senders run in real time."""

    def __init__(self, folder: Path, targets: list[dict[str, Any]], fans: int = 8, **settings: Any) -> None:
        self.config = NotifierConfig.model_validate({"target": targets, **settings})
        self._folder, self._fans = folder, fans
        self.now_ns = START_NS
        self.core: NotifierCore
        self.start()

    def start(self) -> None:
        self.core = notifier_core(self._folder, self.config, {"tray1": self._fans})
        self.wait(11)

    def hear(self, *messages: Alarm) -> None:
        for message in messages:
            self.core.step(message)
        self.wait(6)

    def wait(self, seconds: int) -> None:
        for _ in range(seconds):
            self.now_ns += NS_PER_S
            self.core.tick(self.now_ns)


@pytest.fixture
def mail() -> Iterator[MailServer]:
    server = MailServer()
    server.start()
    yield server
    server.stop()


@pytest.fixture
def started() -> Iterator[Callable[..., Notifier]]:
    running: list[Notifier] = []

    def start(*words: Any, **settings: Any) -> Notifier:
        running.append(Notifier(*words, **settings))
        return running[-1]

    yield start
    for each in running:
        each.core.abort()


@pytest.fixture(autouse=True)
def short_delays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sending, "FIRST_DELAY_S", 0.05)
    monkeypatch.setattr(sending, "LONGEST_DELAY_S", 0.2)
    monkeypatch.setattr("fantwin.pipeline.outputs.notify.mail_and_chat.MAIL_PAUSE_S", 0.0)


def mail_target(folder: Path, mail: MailServer, **more: Any) -> dict[str, Any]:
    return {"name": "mail", "url_file": secret(folder, "mail", mail.url), "repeat_s": 0, **more}


def test_a_mail_server_that_was_down_gets_all_once_and_in_order(tmp_path, mail, started):
    mail.stop()
    notifier = started(tmp_path, [mail_target(tmp_path, mail)])
    expected = []
    for fan in range(8):
        notifier.hear(alarm(fan=fan))
        expected.append(f"WARNING, fan {fan} of tray1 (hall)")
    problem = eventually(notifier.core.problem, "the outage is said")
    assert problem.startswith("target mail: not delivered (") and "refused" in problem
    assert notifier.core.counters()["messages_waiting"] == 8
    assert notifier.core.problem() == problem, "the same words, so that it is reported once"
    mail.start()
    eventually(lambda: len(mail.mails) >= 8, "all have arrived")
    assert mail.subjects() == expected
    assert eventually(lambda: not notifier.core.problem(), "it is over")
    eventually(lambda: notifier.core.counters()["messages_waiting"] == 0, "none is left")
    assert MAY_BE_REPEATED not in str(mail.mails)


def test_a_target_that_hangs_holds_up_neither_the_core_nor_its_end(tmp_path, mail, started):
    with socket.create_server(("127.0.0.1", 0)) as hanging:
        url = f"mailto://127.0.0.1:{hanging.getsockname()[1]}/?from=f@hall.example&to=a@hall.example&cto=600"
        hangs = {"name": "hangs", "url_file": secret(tmp_path, "hangs", url)}
        notifier = started(tmp_path, [hangs, mail_target(tmp_path, mail)])
        notifier.hear(alarm())
        eventually(lambda: mail.mails, "the other target has it")
        hung = notifier.core._senders["hangs"]
        eventually(lambda: hung._delivery_began_s is not None, "it hangs")
        notifier.hear(alarm(fan=3))
        notifier.core.close()
        assert hung.attempts == 1 and hung._thread.is_alive(), "it hangs until the end"
    file = sqlite3.connect(tmp_path / FILE)
    left = file.execute("SELECT under_way FROM message WHERE target = 'hangs' ORDER BY number").fetchall()
    file.close()
    assert left == [(1,), (0,)], "it is sent again after a restart"


def test_a_mail_that_alone_is_refused_does_not_hold_up_the_next_ones(tmp_path, mail, started):
    mail.refused_subjects.add("WARNING, fan 1 of tray1 (hall)")
    notifier = started(tmp_path, [mail_target(tmp_path, mail)])
    for fan in (0, 1, 2, 3):
        notifier.hear(alarm(fan=fan))
    eventually(lambda: notifier.core.counters()["messages_waiting"] == 0, "the others arrive")
    assert mail.subjects() == [f"WARNING, fan {fan} of tray1 (hall)" for fan in (0, 2, 3)]
    assert notifier.core.counters()["lost_messages"] == 1
    assert "lost: 1" in mail.mails[2][1]


def test_a_full_disk_is_said_nothing_is_forgotten_and_what_has_arrived_is_not_sent_again(
    tmp_path, mail, started, monkeypatch
):
    notifier = started(tmp_path, [mail_target(tmp_path, mail)])

    def full(*_: object, **__: object) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(Outbox, "save", full)
        notifier.hear(alarm(fan=0))
        assert "disk is full" in notifier.core.problem()
    with monkeypatch.context() as patched:
        patched.setattr(Outbox, "delivered", full)
        notifier.wait(5)
        eventually(lambda: mail.mails and "disk is full" in notifier.core.problem(), "it is sent, and not forgotten")
        notifier.hear(alarm(fan=1))
    eventually(lambda: len(mail.mails) >= 2 and not notifier.core.problem(), "the next one arrives")
    assert mail.subjects() == ["WARNING, fan 0 of tray1 (hall)", "WARNING, fan 1 of tray1 (hall)"]


def test_what_another_output_kept_while_the_notifier_was_away_is_sent_and_forged_messages_hide_nothing(
    tmp_path, mail, started
):
    notifier = started(tmp_path, [mail_target(tmp_path, mail)])
    notifier.hear(alarm(fan=0, sequence=10))
    notifier.core.close()
    page = AlarmHistory(tmp_path / FILE)
    page.add(alarm(fan=1, sequence=11))
    page.close()
    notifier.start()
    notifier.hear(*(cleared(3, sequence=number, onset_s=-9.0) for number in range(12, 32)), alarm(fan=3, sequence=12))
    eventually(lambda: len(mail.mails) >= 3, "all three are sent")
    assert mail.subjects() == [f"WARNING, fan {fan} of tray1 (hall)" for fan in (0, 1, 3)]


def test_a_fan_that_is_taken_out_of_the_configuration_is_not_spoken_of_any_more(tmp_path, mail, started):
    targets = [mail_target(tmp_path, mail) | {"repeat_s": 60}]
    before = started(tmp_path, targets)
    before.hear(alarm(fan=6), alarm(fan=1))
    eventually(lambda: len(mail.mails) == 2, "both are said")
    before.core.close()
    after = started(tmp_path, targets, fans=4)
    after.wait(120)
    eventually(lambda: len(mail.mails) >= 3, "the one that is there is sent again")
    assert mail.subjects()[2:] == ["Still: WARNING, fan 1 of tray1 (hall)"]


def test_an_alertmanager_is_given_its_alerts_when_they_change_and_not_with_each_look(tmp_path, started):
    receiver = HttpReceiver()
    url = secret(tmp_path, "m", f"http://127.0.0.1:{receiver.port}")
    notifier = started(tmp_path, [{"name": "m", "kind": "alertmanager", "url_file": url}])
    notifier.hear(alarm(fan=1))
    eventually(lambda: receiver.received, "it is given the alert")
    notifier.wait(30)
    notifier.hear(alarm(fan=2))
    eventually(lambda: any(len(alerts) == 2 for alerts in receiver.received), "it is given both")
    assert [len(alerts) for alerts in receiver.received] == [1, 2]
    receiver.stop()


@pytest.mark.skipif(ALERTMANAGER is None, reason="needs Debian's prometheus-alertmanager")
def test_an_alertmanager_has_what_is_presented_and_no_more(tmp_path, started, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.outputs.notify.alertmanager.RESEND_S", 0.5)
    manager = RunningAlertmanager(tmp_path)
    try:
        eventually(lambda: manager.alerts() is not None, "it answers")
        target = {"name": "prometheus", "kind": "alertmanager", "url_file": secret(tmp_path, "prometheus", manager.url)}
        notifier = started(tmp_path, [target], page="https://hall.example/")

        def has(*expected: tuple[str, str]) -> bool:
            alerts = manager.alerts() or []
            return sorted((a["labels"]["fan"], a["labels"]["severity"]) for a in alerts) == sorted(expected)

        notifier.hear(alarm(fan=1), alarm(fan=2), alarm(fan=3))
        eventually(lambda: has(("1", "warning"), ("2", "warning"), ("3", "warning")), "it has all")
        (found,) = [a for a in manager.alerts() or [] if a["labels"]["fan"] == "1"]
        assert found["labels"] == {
            "alertname": "FantwinFanAlarm",
            "site": "hall",
            "tray": "tray1",
            "fan": "1",
            "severity": "warning",
        }
        assert found["startsAt"] == "2026-09-21T14:13:20.000Z"
        assert found["endsAt"] > found["updatedAt"]
        assert "Cause: more drag" in found["annotations"]["description"]
        assert found["generatorURL"] == "https://hall.example/#/fan/tray1/1"
        eventually(
            lambda: [a for a in manager.alerts() or [] if a["updatedAt"] > found["updatedAt"]], "it is sent again"
        )
        notifier.hear(cleared(1), alarm(Transition.SEVERITY, fan=2, severity=Severity.ALARM))
        notifier.hear(alarm(Transition.SHELVED, fan=3, shelved_until_t_ns=1))
        eventually(lambda: has(("2", "alarm")), "one is over, one worse, one shelved")
        notifier.core.close()
        notifier.start()
        notifier.wait(5)
        assert has(("2", "alarm"))
        notifier.hear(cleared(2, severity=Severity.ALARM))
        eventually(has, "none is left")
    finally:
        manager.stop()


def test_secrets_that_others_read_and_urls_that_cannot_be_are_refused_without_showing_them(tmp_path, mail):
    def start(**target: Any) -> NotifierCore:
        return notifier_core(tmp_path, NotifierConfig.model_validate({"target": [{"name": "a", **target}]}))

    readable = secret(tmp_path, "readable", mail.url)
    readable.chmod(0o644)
    several = secret(tmp_path, "several", mail.url + ",bob@hall.example")
    unknown = secret(tmp_path, "unknown", "nothing://token123@host")
    for words, expected in (
        ({"url_file": readable}, "others may read it"),
        ({"url_file": tmp_path / "none"}, "cannot be read"),
        ({"url_file": several}, "has 2 recipients"),
        ({"url_file": unknown}, "apprise cannot use this URL (nothing://...)"),
        ({"url_file": readable, "trays": ["nowhere"]}, "there is no tray nowhere"),
    ):
        with pytest.raises(StageError) as refused:
            start(**words)
        assert expected in str(refused.value)
        assert "token123" not in str(refused.value)
    with pytest.raises(StageError, match="no targets"):
        notifier_core(tmp_path, NotifierConfig())

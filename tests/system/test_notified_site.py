"""The notifier as a process on a real bus: killed while its mail server is away, it forgets nothing."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.models import BusConfig
from fantwin.pipeline.site.alarm_history import FILE
from fantwin.schemas.codec import decode, encode, type_name
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Alarm
from fantwin.schemas.topics import BY_NAME, health_key, tray_key
from tests.support.message_receivers import MailServer
from tests.support.notified_alarms import alarm, cleared, secret
from tests.support.running_chain import RunningCommand, eventually

pytestmark = pytest.mark.slow

CONFIGURATION = """
site = "hall"
run_folder = "runs"
[bus]
endpoint = "{endpoint}"
[[tray]]
name = "tray1"
fans = 8
[[notifier.target]]
name = "mail"
url_file = "mail.url"
"""


@pytest.fixture
def mail() -> Iterator[MailServer]:
    server = MailServer()
    server.start()
    yield server
    server.stop()


def waiting(folder: Path) -> int:
    file = sqlite3.connect(f"file:{folder / 'runs' / FILE}?mode=ro", uri=True)
    try:
        return file.execute("SELECT COUNT(*) FROM message").fetchone()[0]
    finally:
        file.close()


def test_a_notifier_that_is_killed_during_an_outage_sends_all_once_and_in_order(tmp_path, endpoint, mail):
    config = tmp_path / "fantwin.toml"
    config.write_text(CONFIGURATION.format(endpoint=endpoint))
    secret(tmp_path, "mail", mail.url)
    words = ["up", "--only", "notifier", "-c", config]
    with Bus(BusConfig(endpoint=endpoint)) as bus:
        publisher = bus.publisher(
            tray_key("hall", "tray1", "alarm"), BY_NAME["alarm"], type_name(Alarm), "scorer-all-1"
        )

        reported: list[Health] = []
        bus.subscribe(
            health_key("hall", "notifier", "all"), lambda _key, payload: reported.append(decode(Health, payload))
        )

        def publish(fan: int, make: Callable[..., Alarm] = alarm) -> None:
            publisher.put(encode(make(fan=fan, sequence=publisher.published)))

        publish(7)
        publish(7, cleared)
        publish(0)
        notifier = RunningCommand(words)
        try:
            eventually(lambda: mail.mails, "what is presented when it starts is sent")
            mail.stop()
            for fan in (1, 2):
                publish(fan)
                eventually(lambda count=fan: waiting(tmp_path) == count, "it is in the outbox")
            notifier.kill()
            publish(3)
            publish(1, cleared)
            notifier = RunningCommand(words)
            eventually(lambda: waiting(tmp_path) == 4, "what came while it was dead is there, too")
            mail.start()
            eventually(lambda: waiting(tmp_path) == 0, "all is delivered")
            assert notifier.end() == 0, notifier.lines
            assert any("target mail: not delivered" in health.problem for health in reported), "the outage was said"
            assert not any(health.waiting_for for health in reported), "alarms are rare: nobody waits for them"
        finally:
            notifier.kill()
    raised = [f"WARNING, fan {fan} of tray1 (hall)" for fan in (0, 1, 2, 3)]
    assert mail.subjects() == [*raised, "Cleared: alarm, fan 1 of tray1 (hall)"]

"""Words of messages: every cause has an advice, and secrets of a URL are in no reason of a failure."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

import pytest

from pipeline.errors import UserError
from pipeline.notification.config import NotifierConfig
from pipeline.notification.fan_alarm import NamedCause
from pipeline.notification.gathering import ranges
from pipeline.notification.services import Service
from pipeline.notification.wording import Level, Place, Text, cause_line
from schemas.units import NS_PER_S
from scoring.diagnosis.advice import KNOWN_SOON
from scoring.diagnosis.shown_causes import CANNOT_TELL, CAUSES, WHAT_TO_DO, advice
from tests.support.message_receivers import HttpReceiver, MailServer, free_port

PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "notify.md"


def test_there_is_an_advice_for_every_cause():
    assert WHAT_TO_DO.keys() == CAUSES.keys() - {CANNOT_TELL}


def test_where_the_cause_is_unclear_its_evidence_says_what_to_do():
    unclear = (NamedCause(CANNOT_TELL, 1.0, "cannot tell yet: move the command to 0.6 for ten seconds, and back"),)
    assert cause_line(unclear) == "Cause: cannot tell yet: move the command to 0.6 for ten seconds, and back"
    soon = (NamedCause(CANNOT_TELL, 1.0, f"cannot tell yet: {KNOWN_SOON}"),)
    assert cause_line(soon) == "Cause: cannot tell yet: the page or `fantwin alarms` may show it by now"
    assert advice(unclear) == ""
    assert cause_line(()) == "Cause: unknown"


def test_a_time_that_no_calendar_has_is_said_to_be_unknown():
    assert Place("hall").clock(1 << 62) != ""
    assert Place("hall").clock(10**30 * NS_PER_S) == "at an unknown time"


def test_fans_are_listed_as_ranges():
    assert ranges([7, 1, 2, 3, 9]) == "1-3, 7, 9"
    assert ranges([]) == ""


@pytest.mark.parametrize(
    "url",
    [
        "json://ann:password123@127.0.0.1:{port}/token123",
        "mailto://ann:password123@127.0.0.1:{port}/?from=f@hall.example&to=token123@hall.example",
        "xmls://ann:password123@127.0.0.1:{port}/token123",
    ],
)
def test_no_reason_of_a_failure_shows_a_secret(url, capfd):
    receiver = HttpReceiver()
    receiver.status = 401
    for port in (free_port(), receiver.port):
        failure = Service(url.format(port=port)).deliver(Text("t", "b", Level.INFO))
        assert failure and failure.reason
        assert "password123" not in failure.reason and "token123" not in failure.reason
    receiver.stop()
    said = capfd.readouterr()
    assert "123" not in said.out + said.err


def test_the_urls_of_the_how_to_can_be_used():
    urls = re.findall(r"`((?:mailtos?|json)://[^`]+)`", PAGE.read_text(encoding="utf-8"))
    assert [Service(url) and url.partition(":")[0] for url in urls] == ["mailtos", "mailto", "json"]


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("mailtos://127.0.0.1:{port}/?from=f@hall.example&to=a@hall.example", "the mail server has no TLS: mailto://"),
        ("mailto://ann:secret@127.0.0.1:{port}/?from=f@hall.example&to=a@hall.example", "leave user and password out"),
        ("mailtos://127.0.0.1:{port}/?mode=ssl&from=f@hall.example&to=a@hall.example", "has no TLS at this port"),
    ],
)
def test_what_a_mail_server_does_not_have_is_said_with_what_to_do(url, words):
    server = MailServer()
    server.start()
    try:
        failure = Service(url.format(port=server.port)).deliver(Text("t", "b", Level.INFO))
    finally:
        server.stop()
    assert failure is not None
    assert words in failure.reason


def test_a_mail_without_an_address_to_send_from_is_refused_with_what_it_needs():
    with pytest.raises(UserError, match="a mail needs .* and a user or from=ADDRESS"):
        Service("mailto://mail.example?to=ann@hall.example")


def test_the_configuration_of_the_how_to_is_one():
    blocks = PAGE.read_text(encoding="utf-8").split("```toml\n")[1:]
    (found,) = [tomllib.loads(block.partition("```")[0]) for block in blocks]
    config = NotifierConfig.model_validate(found["notifier"])
    assert [target.name for target in config.target] == ["operators", "phone", "day_shift", "prometheus"]

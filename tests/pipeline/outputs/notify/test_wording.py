"""Words of messages: every cause has an advice, and secrets of a URL are in no reason of a failure."""

from __future__ import annotations

import pytest

from fantwin.pipeline.outputs.notify.mail_and_chat import Service
from fantwin.pipeline.outputs.notify.wording import Level, Text
from fantwin.scoring.diagnosis.causes import CANNOT_TELL, CAUSES, WHAT_TO_DO
from tests.support.message_receivers import HttpReceiver, MailServer
from tests.support.ports import free_port


def test_no_reason_of_a_failure_shows_a_secret(capfd):
    receiver = HttpReceiver()
    receiver.status = 401
    for url, port in (
        ("json://ann:password123@127.0.0.1:{port}/token123", free_port()),
        ("json://ann:password123@127.0.0.1:{port}/token123", receiver.port),
        ("xmls://ann:password123@127.0.0.1:{port}/token123", receiver.port),
        ("mailto://ann:password123@127.0.0.1:{port}/?from=f@hall.example&to=token123@hall.example", free_port()),
    ):
        failure = Service(url.format(port=port)).deliver(Text("t", "b", Level.INFO))
        assert failure and failure.reason
        assert "password123" not in failure.reason and "token123" not in failure.reason
    receiver.stop()
    said = capfd.readouterr()
    assert "123" not in said.out + said.err


def test_a_service_is_told_how_bad_it_is():
    receiver = HttpReceiver()
    service = Service(f"json://127.0.0.1:{receiver.port}/")
    for level in (Level.ALARM, Level.WARNING, Level.GOOD):
        assert service.deliver(Text("ALARM, fan 2", "Cause: more drag", level)) is None
    assert [each["type"] for each in receiver.received] == ["failure", "warning", "success"]
    assert (receiver.received[0]["title"], receiver.received[0]["message"]) == ("ALARM, fan 2", "Cause: more drag")
    receiver.stop()


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


def test_there_is_an_advice_for_every_cause():
    assert WHAT_TO_DO.keys() == CAUSES.keys() - {CANNOT_TELL}

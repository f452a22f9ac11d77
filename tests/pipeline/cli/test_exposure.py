"""A bus that others can reach without certificates: refused unless it is wanted, and said again and again."""

from __future__ import annotations

import threading

import pytest

from fantwin.pipeline.cli.exposure import checked_exposure, is_exposed
from fantwin.pipeline.config.settings import BusConfig

OPEN, LOCAL = "tcp/0.0.0.0:7447", "tcp/127.0.0.1:7447"
DRIVES = "whoever reaches it can drive the fans, forge samples and silence alarms"


def test_who_accepts_it_is_reminded_until_the_end(monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.cli.exposure.AGAIN_S", 0.001)
    said: list[str] = []
    often = threading.Event()

    def say(line: str) -> None:
        said.append(line)
        if len(said) == 3:
            often.set()

    with checked_exposure(BusConfig(endpoint=OPEN), say, insecure=True):
        assert often.wait(30)
    assert set(said) == {f"insecure: bus.endpoint = {OPEN!r}: {DRIVES}"}
    assert not [thread for thread in threading.enumerate() if thread.name.endswith("(remind)")]


@pytest.mark.parametrize("endpoint", ["tcp/:::7447", "tcp/[::]:7447", "tcp/0:7447", "tcp/::1:7447", "udp/nobody"])
def test_an_address_of_another_form_counts_as_one_that_others_reach_and_one_of_several_is_enough(endpoint):
    several = BusConfig.model_validate({"mode": "client", "endpoint": [LOCAL, endpoint]})
    assert is_exposed(BusConfig(endpoint=endpoint)) and is_exposed(several)


@pytest.mark.parametrize("endpoint", [LOCAL, "tcp/localhost:7447", "tcp/[::1]:7447", "unixsock-stream/tmp/fantwin"])
def test_within_this_host_there_is_nothing_to_say(endpoint):
    assert not is_exposed(BusConfig(endpoint=endpoint))

"""Samples over HTTP: each request says what became of its samples."""

from __future__ import annotations

import json
import socket
import ssl
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from http.client import HTTPConnection, HTTPSConnection
from pathlib import Path
from typing import Any

import pytest
import trustme

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.runtime.stage import Context
from fantwin.pipeline.sources.http.config import HttpConfig
from fantwin.pipeline.sources.http.source import HttpSource
from fantwin.pipeline.sources.json_samples import LARGEST_BYTES
from fantwin.pipeline.sources.source import (
    LinkUp,
    Reading,
    ReadingLimits,
    SourceContext,
    SourceEvent,
)
from fantwin.stages.acquisition import STAGE
from tests.support.delivered import Delivered
from tests.support.ports import free_port
from tests.support.running_acquisition import push_config
from tests.support.running_chain import eventually

SAMPLE = {"t": 1.0, "command": [0.5, 0.5], "speed": [100, 200]}
PATH = "/v1/trays/tray1"


def source_of(folder: Path = Path(), **settings: Any) -> HttpSource:
    config = HttpConfig.model_validate({"port": free_port(), **settings})
    limits = ReadingLimits(2, 0.0, 1.0, 5000.0)
    return HttpSource(config, SourceContext(2, "rpm", folder, "tray1", limits))


@contextmanager
def running(source: HttpSource, deliver: Any = None) -> Iterator[Delivered]:
    events = Delivered()
    source.start(deliver or events.append)
    if deliver is None:
        eventually(lambda: events, "it listens, or not")
    yield events
    source.stop()


def ask(source: HttpSource, body: Any = None, path: str = "", **headers: str) -> tuple[int, dict[str, Any], Any]:
    """Status, answer and headers of a request: GET without a body, else POST of it as JSON."""
    connection = HTTPConnection("127.0.0.1", source._config.port, timeout=20)
    text = body if isinstance(body, bytes) or body is None else json.dumps(body)
    connection.request(
        "GET" if body is None else "POST", path or PATH + ("" if body is None else "/samples"), text, headers
    )
    answer = connection.getresponse()
    content = answer.read()
    connection.close()
    is_json = answer.headers.get("content-type") == "application/json"
    return answer.status, json.loads(content) if is_json else {}, answer.headers


def test_an_answer_says_what_became_of_each_sample() -> None:
    source = source_of()
    wrong = [SAMPLE | {"command": [2, 0]}, SAMPLE | {"speed": [1]}, {"command": [0, 0]}]
    with running(source) as events:
        assert ask(source, SAMPLE)[:2] == (200, {"accepted": 1, "refused": 0})
        status, answer, _ = ask(source, [SAMPLE, *wrong, {"command": [0, 0], "speed": [9000, 1]}])
        assert (status, answer["accepted"], answer["refused"], answer["speeds_beyond_speed_max"]) == (200, 2, 3, 1)
        assert [(each["sample"], each["kind"]) for each in answer["reasons"]] == [
            (1, "time_order"),
            (2, "time_order"),
            (3, "malformed"),
        ]
        status, answer, _ = ask(source, wrong[0])
        assert (status, answer["accepted"], answer["reasons"][0]["kind"]) == (422, 0, "absurd_command")
        assert "command 2 is outside command_min = 0 to command_max = 1" in answer["reasons"][0]["reason"]
        assert ask(source, wrong[1])[1]["reasons"][0]["kind"] == "wrong_fan_count"
        assert ask(source, b'{"t": 1')[0] == 400
        assert ask(source, b" " * (LARGEST_BYTES + 1))[0] == 413
        assert ask(source, SAMPLE, path="/v1/trays/tray2/samples")[0] == 404
        assert ask(source, path=f"{PATH}/samples")[0] == 405
        counts = ask(source)[1]
        assert (counts["accepted"], counts["turned_away"]) == (3, 0)
        assert (counts["tray"], counts["fans"], counts["speed_unit"]) == ("tray1", 2, "rpm")
        eventually(lambda: len(events) >= 9, "all are delivered, so that acquisition counts them, too")
    assert isinstance(events[0], LinkUp)
    assert isinstance(events.items[0], Reading)


def test_an_acquisition_that_is_behind_turns_samples_away_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fantwin.pipeline.sources.http.source.MOST_WAITING", 20)
    source, may_go_on, delivered = source_of(), threading.Event(), []

    def deliver(event: SourceEvent) -> None:
        assert may_go_on.wait(20)
        delivered.append(event)

    with running(source, deliver):
        eventually(source.check, "it listens")
        samples = [{"command": [0, 0], "speed": [1, 1]}] * 10
        assert [ask(source, samples)[0] for _ in range(2)] == [200, 200]
        status, answer, headers = ask(source, SAMPLE)
        assert (status, answer, headers["Retry-After"]) == (429, {"error": "acquisition is behind", "accepted": 0}, "1")
        assert ask(source)[1]["turned_away"] == 1
        may_go_on.set()
        eventually(lambda: ask(source, SAMPLE)[0] == 200, "there is room again")
        eventually(lambda: len(delivered) == 2 + 20, "what was accepted is delivered")


def test_a_token_is_asked_for_and_beyond_loopback_it_is_required(tmp_path: Path) -> None:
    assert HttpConfig(host="::1").is_local and HttpConfig(host="localhost").is_local
    token = tmp_path / "token"
    token.write_text("secret\n")
    with pytest.raises(UserError, match="others may read it"):
        source_of(tmp_path, token_file="token")
    token.chmod(0o600)
    source = source_of(tmp_path, token_file="token", host="0.0.0.0")
    with running(source):
        assert ask(source, SAMPLE)[0] == ask(source)[0] == 401
        assert ask(source, SAMPLE, Authorization="Bearer wrong")[0] == 401
        assert ask(source, SAMPLE, Authorization="Bearer secret")[0] == 200


def test_a_check_does_not_mind_the_port_that_its_own_acquisition_has(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        config = push_config("tcp/127.0.0.1:7447", tmp_path, source=f'{{ kind = "http", port = {port} }}')
        section = config.sections["acquisition"]
        context = Context("plant", config.trays, section, tmp_path, tmp_path, started_t_ns=0)
        assert len(STAGE.check(context)) == 1
        assert STAGE.check(replace(context, is_running=True)) == []


def test_https(tmp_path: Path) -> None:
    authority = trustme.CA()
    issued = authority.issue_cert("127.0.0.1")
    issued.cert_chain_pems[0].write_to_path(str(tmp_path / "server.pem"))
    issued.private_key_pem.write_to_path(str(tmp_path / "server.key"))
    (tmp_path / "server.key").chmod(0o600)
    source = source_of(tmp_path, certificate="server.pem", key="server.key")
    with running(source):
        context = ssl.create_default_context()
        authority.configure_trust(context)
        connection = HTTPSConnection("127.0.0.1", source._config.port, context=context, timeout=20)
        connection.request("POST", f"{PATH}/samples", json.dumps(SAMPLE))
        assert connection.getresponse().status == 200
        connection.close()

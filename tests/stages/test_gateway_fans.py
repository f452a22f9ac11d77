"""Which fans the gateway shows as in alarm: page, API and metrics say the same."""

from __future__ import annotations

import base64
import http.client
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pipeline.presenting.fan_groups import FanGroup
from schemas.enums import FanState, Transition
from scoring.alarms.words_now import RETURNING
from tests.stages.test_gateway import NOW_NS, alarm, score
from tests.support.running_gateway import Client, RunningGateway

FAULTY = 2


@pytest.fixture
def gateway(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RunningGateway]:
    monkeypatch.setattr("pipeline.presenting.site_model.SILENT_AFTER_S", 1e9)
    running = RunningGateway(tmp_path)
    try:
        yield running
    finally:
        running.close()


def first_event(gateway: RunningGateway) -> Any:
    """The state of all fans as a page is sent it."""
    connection = http.client.HTTPConnection("127.0.0.1", gateway.port, timeout=20)
    connection.request("GET", "/api/v1/events")
    stream = connection.getresponse()
    assert stream.readline() == b"event: fleet\n"
    data = json.loads(stream.readline().removeprefix(b"data: "))
    connection.close()
    return data


class Shown:
    """What is said of the fan with the alarm now, in every place."""

    def __init__(self, gateway: RunningGateway) -> None:
        client = Client(gateway)

        def ask(path: str) -> Any:
            return client.ask("GET", path)[1]

        site, fleet = ask("/api/v1/site"), first_event(gateway)
        cell = base64.b64decode(fleet["classes"])[FAULTY]
        self.cell, self.group, self.cell_now = (site[name][cell] for name in ("classes", "groups", "now"))
        self.counts = fleet["counts"]
        self.fan = ask("/api/v1/fans/tray1/2")
        self.in_alarm = [each["fan"] for each in ask("/api/v1/fans?state=alarm")["fans"]]
        (self.alarm,) = ask("/api/v1/alarms?all=1")["alarms"]
        self.metrics = ask("/metrics")


@pytest.mark.parametrize(
    ("state", "words", "now"),
    [
        (FanState.STOPPED, "alarm, now stopped by its command", "stopped by its command"),
        (FanState.STARTING, "alarm, now starting", "starting"),
        (FanState.RETURNING, "alarm, now within its limits", RETURNING),
        (FanState.NORMAL, "alarm", ""),
    ],
)
def test_an_active_alarm_keeps_its_fan_in_alarm_whatever_its_newest_sample_says(state, words, now, gateway):
    gateway.feed(score(state=FanState.ALARM), alarm(), score(1.0, state=state))
    shown = Shown(gateway)
    assert (shown.cell, shown.group, shown.cell_now) == (words, FanGroup.ALARM, now)
    assert shown.counts == {"in_alarm": 1, "suspect": 0, "not_judged": 1, "silenced": 0}
    assert (shown.fan["in_alarm"], shown.fan["alarm"]["now"]) == (True, now)
    assert shown.in_alarm == [FAULTY]
    assert shown.alarm["now"] == now
    assert 'fantwin_fans_in_alarm{site="hall"} 1.0' in shown.metrics
    gateway.feed(alarm(Transition.SHELVED, 1, shelved_until_t_ns=NOW_NS + 10**12))
    shown = Shown(gateway)
    assert (shown.cell, shown.group) == (f"{words} (silenced)", FanGroup.SILENCED)
    assert (shown.counts["in_alarm"], shown.counts["silenced"], shown.in_alarm) == (0, 1, [])
    assert 'fantwin_fans_in_alarm{site="hall"} 0.0' in shown.metrics
    gateway.feed(alarm(Transition.CLEARED, 2, active=False), score(2.0))
    shown = Shown(gateway)
    assert (shown.group, shown.counts["in_alarm"], shown.counts["silenced"]) == (FanGroup.NORMAL, 0, 0)


def test_a_state_or_a_tray_that_is_none_is_refused_with_those_that_are(gateway):
    gateway.feed(score())
    client = Client(gateway)
    status, body, _ = client.ask("GET", "/api/v1/fans?state=alarms")
    groups = "alarm, suspect, not_judged, silenced, at_rest, normal"
    assert (status, body["error"]) == (422, f"state must be one of {groups}")
    assert client.ask("GET", "/api/v1/fans?tray=nowhere")[0] == 404
    asked = client.ask("GET", "/api/v1/openapi.json")[1]["paths"]["/api/v1/fans"]["get"]["parameters"]
    assert {"name": "state", "in": "query", "required": False} | {
        "schema": {"type": "string", "enum": groups.split(", ")}
    } in asked
    found = {group: len(client.ask("GET", f"/api/v1/fans?state={group}")[1]["fans"]) for group in FanGroup}
    assert found == {group: {"normal": 3, "not_judged": 1}.get(group, 0) for group in FanGroup}

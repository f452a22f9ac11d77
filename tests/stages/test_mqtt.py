"""The stage `mqtt` at a real broker: retained states and alarms, last will, broker away, requests, Home Assistant."""

from __future__ import annotations

import json
import socket
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import paho.mqtt.client as paho
import pytest
import trustme
from paho.mqtt.enums import CallbackAPIVersion

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.mqtt.config import MqttConfig
from fantwin.pipeline.runtime.stage import Context
from fantwin.schemas.enums import Action, FanState, Transition
from fantwin.schemas.messages import Alarm, Request
from fantwin.stages.mqtt import check
from tests.support.mosquitto import Listener, Mosquitto, needs_mosquitto, retained_by
from tests.support.ports import free_port
from tests.support.running_chain import eventually
from tests.support.running_core import FANS, SITE, TRAY
from tests.support.running_mqtt import ROOT, RunningMqtt
from tests.support.site_messages import alarm, granted, score

pytestmark = [needs_mosquitto, pytest.mark.usefixtures("never_silent")]
FAN = f"{ROOT}/{TRAY}/2"
ACCEPTING: dict[str, Any] = {"accept": ("acknowledge", "shelve")}


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    broker = Mosquitto(tmp_path)
    broker.start()
    yield broker
    broker.stop()


@pytest.fixture
def listener(broker: Mosquitto) -> Iterator[Listener]:
    listener = Listener(broker.port)
    yield listener
    listener.close()


@pytest.fixture
def started(broker: Mosquitto) -> Iterator[Callable[..., RunningMqtt]]:
    """Starts stages, which are closed before the broker."""
    running: list[RunningMqtt] = []

    def start(*words: Any, **settings: Any) -> RunningMqtt:
        running.append(RunningMqtt(*words, **settings))
        return running[-1]

    yield start
    for each in running:
        each.close()


def state_of(listener: Listener, topic: str = FAN) -> dict[str, Any]:
    return json.loads(listener.last(f"{topic}/state") or "{}")


def refused(_request: Request) -> list[Alarm]:
    return [alarm(Transition.REFUSED, message="fan 2: there is nothing to acknowledge")]


def test_states_alarms_and_status_are_retained(tmp_path, broker, listener, started):
    stage = started(tmp_path, broker.port)
    stage.feed(score())
    eventually(lambda: state_of(listener).get("state") == "normal", "the state is there")
    listener.publish(f"{FAN}/request", '{"action": "acknowledge"}')  # not heard by default
    assert state_of(listener) == {
        "name": "",
        "place": "",
        "state": "normal",
        "group": "normal",
        "in_alarm": False,
        "judged": True,
        "score": 0.5,
        "speed": 1000.0,
        "predicted_speed": 1010.0,
        "speed_unit": "rpm",
        "since": "2026-09-21T14:13:20.040Z",
        "time": "2026-09-21T14:13:20.040Z",
    }
    unjudged = state_of(listener, f"{ROOT}/{TRAY}/3")
    assert (unjudged["state"], unjudged["judged"]) == ("unknown: samples are missing", False)
    assert (unjudged["predicted_speed"], unjudged["score"]) == (None, 0.5)
    eventually(lambda: listener.last(f"{FAN}/alarm") == "null", "without an alarm it says so")
    stage.feed(alarm())
    eventually(lambda: state_of(listener)["in_alarm"], "an alarm changes the state at once")
    shown = json.loads(listener.last(f"{FAN}/alarm") or "")
    assert (shown["severity"], shown["causes"][0]["cause"], shown["presented"]) == ("alarm", "drag", True)
    assert json.loads(listener.last(f"{FAN}/alarm/transitions") or "")["transition"] == "raised"
    summary = {"fans": FANS, "in_alarm": 1, "suspect": 0, "not_judged": 1, "silenced": 0}
    eventually(lambda: json.loads(listener.last(f"{ROOT}/summary") or "{}") == summary, "the summary is there")
    assert isinstance(json.loads(listener.last(f"{ROOT}/stages") or ""), list)
    kept = retained_by(broker.port)
    assert kept[f"{ROOT}/status"] == "online"
    assert f"{FAN}/alarm/transitions" not in kept
    stage.feed(alarm(Transition.CLEARED, 1, active=False, acknowledged=True))
    eventually(lambda: listener.last(f"{FAN}/alarm") == "null", "the alarm is over")
    assert (stage.sent, listener.of(f"{FAN}/request/answer")) == ([], [])
    stage.close()
    assert retained_by(broker.port)[f"{ROOT}/status"] == "offline"


def test_a_broker_that_was_away_gets_all_that_is_retained_and_all_transitions_in_order(tmp_path, broker, started):
    stage = started(tmp_path, broker.port)
    stage.feed(score())
    eventually(lambda: f"{FAN}/state" in retained_by(broker.port), "it is published")
    broker.stop()
    eventually(lambda: "is away" in stage.problem(), "it says that the broker is away")
    said = stage.problem()
    for number in range(300):  # more than are under way at once
        raised = number % 2 == 0
        stage.feed(alarm(Transition.RAISED if raised else Transition.CLEARED, number, active=raised))
    stage.feed(score(1.0, state=FanState.ALARM))
    assert stage.counters()["waiting_transitions"] == 300
    assert stage.problem() == said, "it is said once, not at each try"
    broker.start()
    listener = Listener(broker.port)
    topic = f"{FAN}/alarm/transitions"
    eventually(lambda: len(listener.of(topic)) >= 300, "all transitions have come")
    numbers = [json.loads(text)["number"] for text in listener.of(topic)]
    assert numbers == sorted(numbers)
    assert len(set(numbers)) == 300
    kept = retained_by(broker.port)
    assert {kept[f"{ROOT}/status"], json.loads(kept[f"{FAN}/state"])["state"]} == {"online", "alarm"}
    assert f"{ROOT}/{TRAY}/0/state" in kept, "also what has not changed: the broker had forgotten it"
    eventually(lambda: stage.counters()["waiting_transitions"] == 0, "all are acknowledged")
    assert stage.problem() == ""
    listener.close()


def test_of_too_many_transitions_that_wait_the_oldest_are_lost_counted_and_said(tmp_path, started, monkeypatch):
    monkeypatch.setattr("fantwin.stages.mqtt.MOST_WAITING", 3)
    stage = started(tmp_path, free_port())
    stage.feed(*(alarm(Transition.SEVERITY, number) for number in range(5)))
    assert (stage.counters()["waiting_transitions"], stage.counters()["lost_transitions"]) == (3, 2)
    assert stage.problem().endswith("; more than 3 transitions of alarms wait, the oldest are lost")


def test_a_broker_that_hangs_holds_nobody_up_and_is_named(tmp_path, broker, monkeypatch):
    monkeypatch.setattr("fantwin.pipeline.outputs.mqtt.link.HANGS_AFTER_S", 0.2)
    stage = RunningMqtt(tmp_path, broker.port)
    stage.feed(score())
    eventually(lambda: f"{FAN}/state" in retained_by(broker.port), "it is published")
    broker.hang()
    for number in range(300):
        stage.feed(alarm(Transition.SEVERITY, number))
    eventually(lambda: "acknowledges nothing" in stage.problem(), "it is named")
    assert stage.counters()["waiting_transitions"] == 300
    broker.go_on()
    eventually(lambda: stage.counters()["waiting_transitions"] == 0, "it goes on")
    broker.hang()
    stage.close()


def test_the_last_will_of_a_connection_that_is_dead_comes_before_the_next_one_says_online(
    tmp_path, broker, listener, started
):
    dead = paho.Client(CallbackAPIVersion.VERSION2, f"fantwin-{SITE}-all")
    dead.will_set(f"{ROOT}/status", "offline", 1, retain=True)
    dead.connect("127.0.0.1", broker.port, keepalive=60)
    dead.loop_start()
    eventually(dead.is_connected, "it is connected")
    dead._thread_terminate = True  # its thread ends, as if the host had gone: its connection stays
    stage = started(tmp_path, broker.port)
    eventually(lambda: listener.last(f"{ROOT}/status") == "online", "it is there")
    assert listener.of(f"{ROOT}/status") == ["offline", "online"]
    stage.core._link._client.socket().shutdown(socket.SHUT_RDWR)  # as if its process had been killed
    eventually(lambda: "offline" in listener.of(f"{ROOT}/status")[2:], "its own last will")
    eventually(lambda: listener.last(f"{ROOT}/status") == "online", "it is back")


def test_requests_are_passed_on_under_the_configured_name_and_answered(tmp_path, broker, listener, started):
    stage = started(tmp_path, broker.port, granted, **ACCEPTING)
    topic = f"{FAN}/request"

    def ask(text: str, where: str = topic) -> dict[str, Any]:
        before = len(listener.of(f"{where}/answer"))
        listener.publish(where, text)
        eventually(lambda: len(listener.of(f"{where}/answer")) > before, "it is answered")
        return json.loads(listener.last(f"{where}/answer") or "")

    stage.feed(score(), alarm())
    eventually(lambda: listener.last(f"{ROOT}/status") == "online", "it is there")
    answer = ask('{"action": "acknowledge", "comment": "seen", "name": "ann", "id": "7"}')
    assert (answer["ok"], answer["id"], answer["answers"][0]["transition"]) == (True, "7", "acknowledged")
    (sent,) = stage.sent
    assert (sent.action, sent.fan, sent.header.tray) == (Action.ACKNOWLEDGE, 2, TRAY)
    assert (sent.operator_name, sent.comment) == ("mqtt", "seen (sent as ann)"), "nobody chooses his name"
    assert ask('{"action": "commission"}')["error"].startswith("commission is not accepted by MQTT here")
    assert "no such fan" in ask('{"action": "acknowledge"}', f"{ROOT}/{TRAY}/9/request")["error"]
    half = '{"action": "acknowledge", "id": "\\ud800"}'
    for malformed in ("{", "[]", half, '{"action": "explode"}', '{"action": "shelve", "duration_s": -1}', "x" * 9999):
        assert not ask(malformed)["ok"]
    wrong = ask('{"action": "shelve", "duration_s": "1h", "id": "8"}')
    assert (wrong["id"], wrong["ok"], wrong["error"].partition(":")[0]) == ("8", False, "duration_s")
    assert "operator_name" in ask('{"action": "acknowledge", "operator_name": "root"}')["error"]
    counts = stage.counters()
    assert (counts["malformed_requests"], counts["refused_requests"], counts["accepted_requests"]) == (8, 2, 1)
    assert len(stage.sent) == 1


def test_what_the_scorer_refuses_is_an_error_a_silent_scorer_too_and_a_retained_request_is_ignored(
    tmp_path, broker, listener, started, monkeypatch
):
    retained, answer_of = f"{ROOT}/{TRAY}/1/request", "{}/answer".format
    listener.publish(retained, '{"action": "acknowledge"}', retain=True)
    stage = started(tmp_path, broker.port, refused, **ACCEPTING)
    ignored = eventually(lambda: listener.last(answer_of(retained)), "it is answered")
    assert "retained requests are ignored" in ignored
    assert (stage.counters()["retained_requests"], stage.sent) == (1, [])
    eventually(lambda: listener.last(f"{ROOT}/status") == "online", "it is there")
    listener.publish(f"{FAN}/request", '{"action": "acknowledge"}')
    answer = json.loads(eventually(lambda: listener.last(f"{FAN}/request/answer"), "it is answered"))
    assert (answer["ok"], answer["error"]) == (False, "fan 2: there is nothing to acknowledge")
    monkeypatch.setattr("fantwin.pipeline.outputs.mqtt.requests.ANSWERED_WITHIN_S", 0.1)
    listener.publish(f"{ROOT}/{TRAY}/all/request", '{"action": "acknowledge"}')
    silent = eventually(lambda: listener.last(f"{ROOT}/{TRAY}/all/request/answer"), "it is answered")
    assert json.loads(silent)["error"] == f"tray {TRAY}: no scorer has answered"
    assert stage.sent[-1].fan == -1


def test_home_assistant_knows_the_fans(tmp_path, broker, started):
    def devices() -> set[str]:
        found = [topic for topic, text in retained_by(broker.port).items() if text and topic.startswith("homeassist")]
        return {topic.removeprefix(f"homeassistant/device/fantwin_{SITE}/").removesuffix("/config") for topic in found}

    started(tmp_path, broker.port, fans=2, home_assistant=["tray1"])
    eventually(lambda: devices() == {"site", f"{TRAY}-0", f"{TRAY}-1"}, "it has all devices")


def test_a_broker_that_refuses_a_password_or_whose_certificate_is_unknown_is_named(tmp_path):
    authority, users, password = trustme.CA(), tmp_path / "users", tmp_path / "password"
    authority.issue_cert("127.0.0.1").private_key_and_cert_chain_pem.write_to_path(str(tmp_path / "server.pem"))
    authority.cert_pem.write_to_path(str(tmp_path / "ca.pem"))
    subprocess.run(["mosquitto_passwd", "-b", "-c", users, "plant", "secret"], check=True, capture_output=True)
    files = [f"{name} {tmp_path / 'server.pem'}" for name in ("certfile", "keyfile")]
    broker = Mosquitto(tmp_path, *files, "allow_anonymous false", f"password_file {users}")
    broker.start()
    password.touch(0o600)
    url = f"mqtts://127.0.0.1:{broker.port}"
    known: dict[str, Any] = {"url": url.replace("//", "//plant@"), "ca": "ca.pem", "password_file": "password"}
    unknown: dict[str, Any] = {"url": url}
    try:
        for text, settings, problem, of_doctor in (
            ("secret", known, "", ""),
            ("wrong", known, "the broker refuses this client", "check user and password"),
            (
                "secret",
                unknown,
                "is away, or TLS fails: `fantwin doctor` says which",
                "check ca, and that the host is a name in the certificate of the broker",
            ),
        ):
            password.write_text(f"{text}\n")
            stage = RunningMqtt(tmp_path, broker.port, **settings)
            eventually(
                lambda: problem in stage.problem() and (problem or stage.counters()["connections"]),  # noqa: B023
                problem or "it is let in",
            )
            stage.close()
            config = MqttConfig(**settings)
            found = check(Context(SITE, (), config, tmp_path, tmp_path, 0))
            assert [of_doctor in each for each in found] == [True] * bool(of_doctor)
        password.chmod(0o644)
        config = MqttConfig(**known)
        assert "chmod 600" in check(Context(SITE, (), config, tmp_path, tmp_path, 0))[0]
    finally:
        broker.stop()


def test_doctor_names_a_broker_that_is_not_there_and_a_tray_that_there_is_not(tmp_path):
    port = free_port()
    config = MqttConfig(url=f"mqtt://127.0.0.1:{port}", home_assistant=("tray9",))
    unknown, away = check(Context(SITE, (TrayConfig(name=TRAY, fans=4),), config, tmp_path, tmp_path, 0))
    assert unknown == "[mqtt] home_assistant: there is no tray tray9"
    assert away == f"broker 127.0.0.1:{port}: cannot be reached: Connection refused; check url"

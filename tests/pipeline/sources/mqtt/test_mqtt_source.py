"""Samples from a real MQTT broker: JSON and single numbers, restarts of the broker, commands, users and TLS."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import paho.mqtt.client as paho
import pytest
from paho.mqtt.enums import CallbackAPIVersion

from fantwin.pipeline.sources.mqtt.config import MqttConfig
from fantwin.pipeline.sources.mqtt.source import FanValues, MqttSource
from fantwin.pipeline.sources.source import (
    LinkUp,
    Rejected,
    SourceContext,
)
from tests.support.delivered import Delivered
from tests.support.mqtt_broker import MqttBroker
from tests.support.ports import free_port
from tests.support.running_chain import eventually

SAMPLE = '{"t": 1.0, "command": [0.5, 0.5], "speed": [100, 200]}'
NUMBERS: dict[str, Any] = {"topic": "plant/fan{1}/rpm", "command_topic": "plant/fan{1}/pwm"}


@pytest.fixture(scope="module")
def broker() -> Iterator[MqttBroker]:
    broker = MqttBroker()
    broker.start()
    yield broker
    broker.close()


@pytest.fixture
def publish(broker: MqttBroker) -> Iterator[Callable[..., None]]:
    client = paho.Client(CallbackAPIVersion.VERSION2)
    client.connect("127.0.0.1", broker.port)
    client.loop_start()
    yield lambda topic, text, retain=False: client.publish(topic, text, 1, retain).wait_for_publish(10)
    client.disconnect()
    client.loop_stop()


def source_of(port: int, folder: Path = Path(), **settings: Any) -> MqttSource:
    config = MqttConfig.model_validate({"url": f"mqtt://127.0.0.1:{port}"} | (settings or {"topic": "plant/tray1"}))
    return MqttSource(config, SourceContext(2, "rpm", folder))


def message_of(topic: str, payload: bytes) -> paho.MQTTMessage:
    message = paho.MQTTMessage(topic=topic.encode())
    message.payload = payload
    return message


@contextmanager
def running(source: MqttSource) -> Iterator[Delivered]:
    events = Delivered()
    source.start(events.append)
    eventually(lambda: events, "it is connected, or not")
    yield events
    source.stop()


def test_a_message_that_the_broker_sends_again_is_left_out(broker: MqttBroker) -> None:
    source = source_of(broker.port)
    items = [
        item
        for is_again in (False, True, False)
        for batch in source.batches("plant/tray1", SAMPLE.encode(), 0, is_again=is_again)
        for item in batch.items
    ]
    assert [getattr(item, "kind", "reading") for item in items] == ["reading", "repeated", "reading"]
    ((retained,),) = (batch.items for batch in source.batches("plant/tray1", SAMPLE.encode(), 0, is_retained=True))
    assert isinstance(retained, Rejected) and (retained.kind, retained.harmless) == ("retained", True)


@pytest.mark.parametrize(
    ("settings", "own", "foreign"),
    [
        (NUMBERS, "plant/fan1/rpm", "old/2/rpm"),
        ({"topic": "plant/tray2"}, "plant/tray2", "plant/tray1"),
        ({"topic": "plant/+/tray2"}, "plant/a/tray2", "plant/a/tray1"),
        ({"topic": "$share/group/plant/#"}, "plant/tray2", "other/tray2"),
    ],
)
def test_a_topic_of_a_former_subscription_is_refused_and_unsubscribed(
    settings: dict[str, Any], own: str, foreign: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, events, unsubscribed = source_of(1, **settings), Delivered(), list[str]()
    monkeypatch.setattr(source._client, "unsubscribe", unsubscribed.append)
    source._deliver = events.append
    for topic in (foreign, own, foreign):
        source._on_message(None, None, message_of(topic, b"100" if settings is NUMBERS else SAMPLE.encode()))
    kinds = [item.kind for item in events.refused]
    assert kinds.count("foreign_topic") == 2 and "malformed" not in kinds
    assert set(unsubscribed) == {foreign}


def test_numbers_of_single_fans_become_readings_of_the_tray(broker: MqttBroker, publish: Callable[..., None]) -> None:
    publish("plant/fan1/pwm", "0.4", retain=True)
    publish("plant/fan2/rpm", "900", retain=True)
    with running(source_of(broker.port, **NUMBERS)) as events:
        publish("plant/fan1/rpm", "1000")  # the command of fan 2 is not known yet
        publish("plant/fan2/pwm", "0.6")
        for fan, rpm in ((1, "1001"), (2, "2000"), (1, "1002"), (1, "1003"), (2, "2001"), (2, "fast")):
            publish(f"plant/fan{fan}/rpm", rpm)
        eventually(lambda: getattr(events.items[-1], "kind", "") == "malformed" if events.items else False, "all came")
    readings = events.readings
    assert [reading.command for reading in readings] == [(0.4, 0.6)] * 3
    speeds = [tuple("-" if math.isnan(v) else f"{v:g}" for v in reading.speed) for reading in readings]
    assert speeds == [("1001", "2000"), ("1002", "-"), ("1003", "2001")]
    kinds = [item.kind for item in events.refused]
    assert kinds == ["retained", "no_command", "malformed"]
    publish("plant/fan1/pwm", "", retain=True)
    publish("plant/fan2/rpm", "", retain=True)


def test_a_changed_command_ends_the_reading_that_waits() -> None:
    values = FanValues(2)
    values.set_command(0, 0.5)
    assert values.set_speed(1, 20.0) == []
    assert values.lacks_commands and values.set_command(1, 0.5) is None
    assert values.set_speed(0, 10.0) == []
    ended = values.set_command(0, 0.7)
    assert ended is not None and ended.command == (0.5, 0.5) and ended.speed[0] == 10.0
    assert values.set_command(0, 0.7) is None, "the same again changes nothing"


@pytest.mark.parametrize(
    ("topic", "expected"),
    [
        ("out", [("out", {"command": [0.5, None]})]),
        ("out/{0}", [("out/0", 0.5)]),
    ],
)
def test_commands_are_published(broker: MqttBroker, topic: str, expected: list[tuple[str, Any]]) -> None:
    heard: list[tuple[str, Any]] = []
    client = paho.Client(CallbackAPIVersion.VERSION2)
    client.on_message = lambda _c, _d, message: heard.append((message.topic, json.loads(message.payload)))
    subscribed: list[int] = []
    client.on_subscribe = lambda *_rest: subscribed.append(1)
    client.connect("127.0.0.1", broker.port)
    client.subscribe("out/#")
    client.loop_start()
    eventually(lambda: subscribed, "it listens")
    source = source_of(broker.port, topic="plant/tray1", send_topic=topic)
    assert "is not connected" in source.send((0.5, math.nan), ())
    with running(source):
        assert source.send((0.5, math.nan), ()) == ""
        assert ("no set-points" in source.send((), (100.0, 200.0))) == ("{0}" in topic)
        eventually(lambda: heard, "it is heard")
    assert heard[:1] == expected
    client.disconnect()
    client.loop_stop()
    assert "no send_topic" in source_of(broker.port).send((0.5, 0.5), ())


@pytest.mark.skipif(shutil.which("mosquitto") is None, reason="needs mosquitto: amqtt forgets a client that has left")
def test_with_a_client_id_the_broker_keeps_messages_while_acquisition_is_away(tmp_path: Path) -> None:
    port = free_port()
    (tmp_path / "mosquitto.conf").write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
    process = subprocess.Popen(["mosquitto", "-c", tmp_path / "mosquitto.conf"], stderr=subprocess.DEVNULL)
    try:
        settings: dict[str, Any] = {"topic": "plant/kept", "client_id": "fantwin-tray1"}
        eventually(lambda: source_of(port, **settings).check() == [], "the broker answers")
        with running(source_of(port, **settings)) as events:
            assert isinstance(events[0], LinkUp)
        client = paho.Client(CallbackAPIVersion.VERSION2)
        client.connect("127.0.0.1", port)
        client.loop_start()
        for number in range(3):
            client.publish("plant/kept", SAMPLE.replace("1.0", f"{number}.0"), 1).wait_for_publish(10)
        client.disconnect()
        client.loop_stop()
        with running(source_of(port, **settings)) as events:
            eventually(lambda: len(events.items) == 3, "what was published meanwhile comes")
        assert [reading.clock_us for reading in events.readings] == [0, 1_000_000, 2_000_000]
    finally:
        process.terminate()
        process.wait()

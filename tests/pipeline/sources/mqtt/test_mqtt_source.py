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

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.mqtt.config import MqttConfig
from fantwin.pipeline.sources.mqtt.fan_values import FanValues
from fantwin.pipeline.sources.mqtt.source import MqttSource
from fantwin.pipeline.sources.source import (
    LinkUp,
    Reading,
    ReadingLimits,
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


ITHO = b'{"temp":21.2,"Fan setpoint (rpm)":1221,"Fan speed (rpm)":1218,"Ventilation setpoint (%)":42}'
SENSOR = b'{"Time":"2026-06-09T00:10:36","COUNTER":{"C1":2412},"RPM":1206}'
STATE = b'{"Time":"2026-06-09T00:10:36","POWER1":"%s","FanSpeed":3}'
NAN = math.nan


@pytest.mark.parametrize(
    ("fans", "settings", "messages", "expected"),
    [
        pytest.param(
            1,
            {"topic": "v", "speed_key": "/Fan speed (rpm)", "command_key": "/Ventilation setpoint (%)"},
            [("v", ITHO), ("v", ITHO.replace(b"42", b"50"))],
            [((42.0,), (1218.0,)), ((50.0,), (1218.0,))],
            id="one JSON with both (ithowifi)",
        ),
        pytest.param(
            1,
            {
                "topic": "tele/fan/SENSOR",
                "speed_key": "/RPM",
                "command_topic": "tele/fan/STATE",
                "command_key": "/FanSpeed",
                "switch_key": "/POWER1",
            },
            [
                ("tele/fan/SENSOR", SENSOR),
                ("tele/fan/STATE", STATE % b"OFF"),
                ("tele/fan/SENSOR", SENSOR),
                ("tele/fan/STATE", STATE % b"ON"),
                ("tele/fan/SENSOR", SENSOR),
            ],
            ["no_command", ((0.0,), (1206.0,)), ((3.0,), (1206.0,))],
            id="a fan that is off although its level is 3 (Tasmota)",
        ),
        pytest.param(
            1,
            {
                "topic": "room/sensor/fan_speed/state",
                "command_topic": "room/fan/supply/speed_level/state",
                "switch_topic": "room/fan/supply/state",
            },
            [("room/fan/supply/state", b"ON"), ("room/fan/supply/speed_level/state", b"40")]
            + [("room/sensor/fan_speed/state", payload) for payload in (b"1206.00", b"nan", b"fast")],
            [((40.0,), (1206.0,)), ((40.0,), (NAN,)), "malformed"],
            id="topics with names (ESPHome)",
        ),
        pytest.param(
            1,
            {"topic": "rpm", "command_topic": "z2m/fan", "command_key": "/speed", "switch_key": "/state"},
            [
                ("z2m/fan", b'{"state":"ON","speed":254}'),
                ("rpm", b"1200"),
                ("z2m/fan", b'{"state":"OFF"}'),
                ("rpm", b"9"),
            ],
            [((254.0,), (1200.0,)), ((0.0,), (9.0,))],
            id="a message without what has not changed (Zigbee2MQTT)",
        ),
        pytest.param(
            1,
            {"topic": "speed", "command_topic": "power"},
            [
                ("power", b"on"),
                ("speed", b"1 206"),
                ("speed", b"1206 rpm"),
                ("power", b"off"),
                ("speed", b"20.1 Hz"),
                ("power", b"unavailable"),
                ("speed", b"unavailable"),
                ("power", b"42 %"),
                ("speed", b"1200 1/min"),
            ],
            [
                "malformed",
                ((100.0,), (1206.0,)),
                "malformed",
                "unknown_command",
                ((42.0,), (1200.0,)),
            ],
            id="ON and OFF, units, unavailable",
        ),
        pytest.param(
            2,
            {"topic": "rack", "speed_key": "/fans/{0}/rpm", "command_key": "/fans/{0}/pwm"},
            [
                ("rack", b'{"fans":[{"rpm":"900","pwm":10},{"rpm":null,"pwm":20}]}'),
                ("rack", b'{"fans":3}'),
                ("rack", b"x"),
            ],
            [((10.0, 20.0), (900.0, NAN)), "malformed", "malformed"],
            id="all fans in one JSON",
        ),
        pytest.param(
            2,
            {"topic": ["cpu/rpm", "rear/rpm"], "command_topic": "pwm"},
            [("pwm", b"60"), ("cpu/rpm", b"900"), ("rear/rpm", b"1100")],
            [((60.0, 60.0), (900.0, 1100.0))],
            id="a list of topics, one command for all",
        ),
    ],
)
def test_what_devices_publish_is_read_as_they_do(
    fans: int, settings: dict[str, Any], messages: list[tuple[str, bytes]], expected: list[Any]
) -> None:
    config = MqttConfig.model_validate({"url": "mqtt://broker", **settings})
    limits = ReadingLimits(fans, 0.0, 300.0 if "z2m" in str(settings) else 100.0, 20_000.0)
    source = MqttSource(config, SourceContext(fans, "rpm", Path(), limits=limits))
    items = [item for topic, text in messages for batch in source.batches(topic, text, 0) for item in batch.items]
    found: list[Any] = []
    for item in items:
        assert isinstance(item, Reading | Rejected)
        refused = item if isinstance(item, Rejected) else limits.why_refused(item)
        found.append(refused.kind if refused else (getattr(item, "command", ()), getattr(item, "speed", ())))
    assert str(found) == str(expected)


def test_an_old_speed_that_the_broker_had_kept_is_left_out_and_its_command_is_taken() -> None:
    settings = {"topic": "v", "speed_key": "/Fan speed (rpm)", "command_key": "/Ventilation setpoint (%)"}
    config = MqttConfig.model_validate({"url": "mqtt://broker", **settings})
    source = MqttSource(config, SourceContext(1, "rpm", Path()))
    ((kept,),) = (batch.items for batch in source.batches("v", ITHO, 0, is_retained=True))
    assert isinstance(kept, Rejected) and kept.kind == "retained"
    ((partial,),) = (batch.items for batch in source.batches("v", b'{"Fan speed (rpm)": 900}', 0))
    assert isinstance(partial, Reading) and (partial.command, partial.speed) == ((42.0,), (900.0,))
    ((nothing,),) = (batch.items for batch in source.batches("v", b'{"temp":21.2}', 0))
    assert (
        isinstance(nothing, Rejected) and nothing.detail == "v has nothing at /Ventilation setpoint (%); there is: temp"
    )


@pytest.mark.parametrize(
    ("fans", "settings", "line"),
    [
        (2, {"topic": "a", "command_topic": "b"}, "topic has one speed for 2 fans: number them in braces"),
        (2, {"topic": ["a"], "command_topic": "b"}, "fans = 2, and the list of topics of the speed names 1"),
        (2, {"topic": ["a", "a"], "command_topic": "b"}, "a would be the speed of two fans"),
    ],
)
def test_topics_that_are_not_those_of_the_fans_are_refused(fans: int, settings: dict[str, Any], line: str) -> None:
    with pytest.raises(UserError, match=line):
        MqttSource(MqttConfig.model_validate({"url": "mqtt://broker", **settings}), SourceContext(fans, "rpm", Path()))


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

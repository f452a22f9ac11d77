"""Samples from an MQTT broker, and commands back to it.

All runs in the thread of paho's client, which also connects again when the broker was away. While acquisition is
behind, that thread waits, so that the broker keeps what comes (with QoS 1 or 2). What the broker had retained is no new
sample: it is counted and left out, but for the commands of fans, which hold until the next one.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.extras import require
from fantwin.pipeline.sources.json_samples import JsonSamplesError, batches_of, command_json, parse_samples
from fantwin.pipeline.sources.mqtt.client import NOT_REACHED, connection_problems, new_client, refusal
from fantwin.pipeline.sources.mqtt.config import MqttConfig, are_of_each_fan, topic_of
from fantwin.pipeline.sources.mqtt.connection import KEEPALIVE_S
from fantwin.pipeline.sources.mqtt.fan_values import FanValues
from fantwin.pipeline.sources.own_json import (
    LONGEST_NUMBER,
    OwnJson,
    is_of_each_fan,
    is_switched_on,
    number_of,
    of_fan,
    value_at,
)
from fantwin.pipeline.sources.source import (
    LinkDown,
    LinkUp,
    Reading,
    ReadingBatch,
    Rejected,
    SourceContext,
    SourceEvent,
)
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK
from fantwin.pipeline.timebase.receipt_times import ReceiptTimes

if TYPE_CHECKING:
    from paho.mqtt.client import Client, MQTTMessage


class _Place(NamedTuple):
    """What a topic has of a fan: speed, command or switch, at a pointer of the device's own JSON or alone."""

    what: str
    fan: int
    pointer: str


MOST_RECENT = 64
"""messages by which one that the broker sends again is recognised"""
QOS = 1
"""of subscriptions and commands: the broker keeps what comes while this client is away, and sends it again"""


class MqttSource:
    """A `SampleSource`."""

    def __init__(self, config: MqttConfig, context: SourceContext) -> None:
        """Prepare the client; it does not connect yet.

        Raises:
            UserError: the extra is not installed, or a password or certificate cannot be read.
        """
        require("source mqtt", "devices", "paho")
        self._config = config
        self._deliver: Callable[[SourceEvent], None] = lambda _event: None
        self._receipts = ReceiptTimes()
        self._values = FanValues(context.fans, has_switch="switch" in config.places)
        self._speed_unit = context.speed_unit
        self._command_of_on = context.limits.command_max if context.limits else 1.0
        self._topics: dict[str, list[_Place]] = {config.patterns[0]: []}
        """subscribed topics, and what they have of fans"""
        if config.has_values:
            self._topics = _topics(config, context.fans)
        self._recent: deque[tuple[str, bytes]] = deque(maxlen=MOST_RECENT)
        self._is_up = False
        self._is_refused = False
        """true if the broker has refused the client; it ends the connection next"""
        self._stopping = False
        self._folder = context.folder
        self._client = client = new_client(config, context.folder, config.client_id, is_kept=bool(config.client_id))
        client.on_connect = self._on_connect
        client.on_connect_fail = self._on_connect_fail
        client.on_disconnect = self._on_disconnect
        client.on_subscribe = self._on_subscribe
        client.on_message = self._on_message

    @property
    def name(self) -> str:
        """The broker and the topics."""
        return f"mqtt {self._config.host}:{self._config.port} {' and '.join(self._config.patterns)}"

    @property
    def settings_to_check(self) -> str:
        """Settings that may differ from what is published."""
        names = ("topic", *OwnJson.model_fields, "command_topic", "switch_topic", "switch_key")
        return ", ".join(f"{name} = {value!r}" for name in names if (value := getattr(self._config, name)))

    def start(self, deliver: Callable[[SourceEvent], None]) -> None:
        """Connect in a thread of its own, again and again where it fails."""
        self._deliver = deliver
        self._client.connect_async(self._config.host, self._config.port, keepalive=KEEPALIVE_S)
        self._client.loop_start()

    def stop(self) -> None:
        """Leave the broker."""
        self._stopping = True
        self._client.disconnect()
        self._client.loop_stop()

    def send(self, command: tuple[float, ...], set_point: tuple[float, ...]) -> str:
        """Publish a command, if the configuration has a topic for it and the broker is there. Set-points only go as
        JSON."""
        topic = self._config.send_topic
        if not topic:
            return self._config.why_no_commands
        if not self._is_up:
            return f"{self.name} is not connected"
        if not are_of_each_fan(topic):
            is_sent = self._publish(str(topic), command_json(command, set_point))
        elif not all(map(math.isnan, set_point)):
            return f"{topic} takes commands, no set-points"
        else:
            is_sent = all(
                self._publish(topic_of(topic, fan), f"{value:.9g}")
                for fan, value in enumerate(command)
                if not math.isnan(value)
            )
        return "" if is_sent else f"{self.name} did not take it"

    def check(self) -> list[str]:
        """Problems before the start: the broker does not answer, or does not accept this client."""
        # with an id of its own: the broker ends the connection of another client with the same one
        client = new_client(self._config, self._folder)
        return connection_problems(client, self._config, self.name)

    def _publish(self, topic: str, text: str) -> bool:
        return self._client.publish(topic, text, qos=QOS).rc == 0

    def _down(self, reason: str) -> None:
        self._is_up = False
        if not self._stopping:
            self._deliver(LinkDown(reason))

    def _on_connect(self, client: Client, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._is_refused = True
            self._down(refusal(reason))
            return
        client.subscribe([(topic, QOS) for topic in self._topics])

    def _on_subscribe(self, _client: Any, _data: Any, _mid: Any, reasons: Any, _properties: Any) -> None:
        failures = [str(reason) for reason in reasons if reason.is_failure]
        if failures:
            self._down(f"the broker refuses the subscription: {failures[0]}; check the rights of this user")
            return
        self._is_up = True
        self._deliver(LinkUp())

    def _on_connect_fail(self, _client: Any, _data: Any) -> None:
        self._down(NOT_REACHED)

    def _on_disconnect(self, _client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if not self._is_refused:
            self._down(f"the connection to the broker ended: {reason}; it is opened again")
        self._is_refused = False

    def _on_message(self, _client: Any, _data: Any, message: MQTTMessage) -> None:
        received_t_ns, payload = HOST_CLOCK.now_ns(), bytes(message.payload)
        try:
            topic = message.topic
            batches = self.batches(topic, payload, received_t_ns, message.retain, message.dup)
            if not self._is_own(topic):
                self._client.unsubscribe(topic)
        except Exception as error:  # noqa: BLE001  it would end the thread, and with it the source
            detail = f"unexpected {type(error).__name__}: {error}"
            batches = [_refused(received_t_ns, payload, Rejected("malformed", detail, is_sample=True))]
        for batch in batches:
            self._deliver(batch)

    def _is_own(self, topic: str) -> bool:
        """Return whether this tray subscribes to a topic. With a client_id, the broker keeps earlier subscriptions."""
        from paho.mqtt.client import topic_matches_sub  # noqa: PLC0415  an extra

        return topic in self._topics or any(topic_matches_sub(_unshared(each), topic) for each in self._topics)

    def batches(
        self, topic: str, payload: bytes, received_t_ns: int, is_retained: bool = False, is_again: bool = False
    ) -> list[ReadingBatch]:
        """Samples of a message. is_retained: the broker had kept it. is_again: the broker may have sent it before."""
        if not self._is_own(topic):
            detail = f"{topic} is not a topic of this tray: the earlier subscription of client_id is ended"
            return [_refused(received_t_ns, payload, Rejected("foreign_topic", detail, harmless=True))]
        if self._config.has_values:
            items = self._items_of_value(topic, payload, is_retained)
            return [ReadingBatch(received_t_ns, tuple(items), len(payload))]
        if is_retained:
            return [_refused(received_t_ns, payload, Rejected("retained", "a sample of before", harmless=True))]
        if is_again and (topic, payload) in self._recent:
            return [_refused(received_t_ns, payload, Rejected("repeated", "sent twice by the broker", harmless=True))]
        self._recent.append((topic, payload))
        try:
            found = parse_samples(payload)
        except JsonSamplesError as error:
            return [_refused(received_t_ns, payload, Rejected("malformed", f"{topic}: {error}", is_sample=True))]
        return batches_of(found, received_t_ns, self._receipts, len(payload))

    def _items_of_value(self, topic: str, payload: bytes, is_retained: bool) -> list[Reading | Rejected]:
        """What the values of a message end or complete: those of commands first, as they hold for its speeds."""
        found: list[tuple[_Place, Any]] = []
        failures: list[str] = []
        for place in self._topics[topic]:
            try:
                found.append((place, value_at(_json(payload), place.pointer) if place.pointer else _text(payload)))
            except ValueError as error:
                failures.append(str(error))
        items: list[Reading | Rejected] = []
        if not found:  # a device may leave out what has not changed
            items.append(Rejected("malformed", f"{topic} has {failures[0]}"))
        for place, value in found:
            items += self._items_of(topic, place, value, is_retained)
        return items

    def _items_of(self, topic: str, place: _Place, value: Any, is_retained: bool) -> list[Reading | Rejected]:
        at = f" at {place.pointer}" if place.pointer else ""
        no_number = Rejected("malformed", f"{topic} has {value!r:.40}{at}, which is no {_KIND[place.what]}")
        if place.what == "switch":
            is_on = is_switched_on(value)
            ended = None if is_on is None else self._values.set_switch(place.fan, is_on)
            return [no_number] if is_on is None else [ended] if ended else []
        if place.what == "command":
            command = number_of(value, on=self._command_of_on)
            ended = None if command is None else self._values.set_command(place.fan, command)
            return [no_number] if command is None else [ended] if ended else []
        speed = number_of(value, speed_unit=self._speed_unit)
        if speed is None:
            return [no_number]
        if is_retained:
            return [Rejected("retained", "a speed of before", harmless=True)]
        readings = self._values.set_speed(place.fan, speed)
        if not readings and self._values.lacks_commands:
            return [Rejected("no_command", "the command of a fan is not known yet", harmless=True)]
        return list(readings)


_KIND = {"speed": "speed", "command": "number", "switch": "ON or OFF"}


def _topics(config: MqttConfig, fans: int) -> dict[str, list[_Place]]:
    """What each topic has, commands before speeds. Raises UserError where the topics are not those of all fans."""
    found: dict[str, list[_Place]] = {}
    for what in ("switch", "command", "speed"):
        if what not in config.places:
            continue
        topics, key = config.places[what]
        if not isinstance(topics, str) and len(topics) != fans:
            raise UserError(f"fans = {fans}, and the list of topics of the {what} names {len(topics)}")
        if what == "speed" and fans > 1 and not (are_of_each_fan(topics) or is_of_each_fan(key)):
            raise UserError(
                f"topic has one speed for {fans} fans: number them in braces, as in plant/fan{{1}}/rpm, or list topics"
            )
        for fan in range(fans):
            found.setdefault(topic_of(topics, fan), []).append(_Place(what, fan, of_fan(key, fan)))
    for topic, places in found.items():
        speeds = [place.pointer for place in places if place.what == "speed"]
        commands = {place.pointer for place in places if place.what == "command"}
        if len(set(speeds)) < len(speeds) or commands & set(speeds):
            raise UserError(
                f"source mqtt: {topic} would be the speed of two fans, or speed and command: give each a place"
            )
    return found


def _json(payload: bytes) -> Any:
    try:
        return json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"no JSON ({str(error) or 'nested too deeply'}): {payload[:LONGEST_NUMBER]!r}") from error


def _text(payload: bytes) -> str:
    return payload[: LONGEST_NUMBER + 1].decode(errors="replace")


def _unshared(pattern: str) -> str:
    """The topics that a subscription is for: one that is shared ($share/GROUP/...) begins with its group."""
    return pattern.split("/", 2)[-1] if pattern.startswith("$share/") else pattern


def _refused(received_t_ns: int, payload: bytes, rejected: Rejected) -> ReadingBatch:
    return ReadingBatch(received_t_ns, (rejected,), len(payload))

"""The connection to the broker: paho's client in its thread, which connects again with growing delays.

The core publishes while `is_up`, and at most `WINDOW` messages without an acknowledgement: a broker that is slow, or
hangs, fills no memory here. What was under way when the connection broke, the client sends again by itself.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from fantwin.pipeline.outputs.mqtt.config import MqttConfig
from fantwin.pipeline.outputs.mqtt.outbox import Outgoing
from fantwin.pipeline.sources.mqtt.client import new_client, refusal
from fantwin.pipeline.sources.mqtt.connection import KEEPALIVE_S

if TYPE_CHECKING:
    from paho.mqtt.client import Client, MQTTMessage

WINDOW = 200
MOST_REQUESTS = 256
"""that wait for the core; of more, the newest are dropped"""
HANGS_AFTER_S = 10.0
STOPPED_WITHIN_S = 3.0
CONNECT_TIMEOUT_S = 3.0
QOS = 1


class Received(NamedTuple):
    """A request from the broker. is_retained: it had kept it."""

    topic: str
    payload: bytes
    is_retained: bool


class BrokerLink:
    """The connection by paho. All but `stop` return at once.

    Attributes:
        dropped_requests: because too many came at once.
    """

    def __init__(
        self,
        config: MqttConfig,
        folder: Path,
        client_id: str,
        will: Outgoing,
        requests: Sequence[str],
    ) -> None:
        """Nothing is connected yet.

        will: what the broker publishes if this process dies. requests: patterns that are subscribed to.

        Raises:
            UserError: a password or certificate cannot be read.
        """
        self._address = f"{config.host}:{config.port}"
        self._config = config
        self._requests = tuple(requests)
        self._lock = threading.Lock()
        self._under_way: dict[int, float] = {}
        """by number, since when, on the monotonic clock"""
        self._acknowledged: list[int] = []
        self._early: set[int] = set()
        """acknowledged before `publish` returned"""
        self._asked: list[Received] = []
        self.dropped_requests = 0
        self._is_up = False
        self._sessions = 0
        self._refused = ""
        self._refused_subscription = ""
        client = self._client = new_client(config, folder, client_id)
        client.will_set(will.topic, will.text, QOS, will.is_retained)
        client.max_inflight_messages_set(WINDOW)
        client.connect_timeout = CONNECT_TIMEOUT_S
        client.on_connect = self._on_connect
        client.on_connect_fail = self._on_connect_fail
        client.on_disconnect = self._on_disconnect
        client.on_subscribe = self._on_subscribe
        client.on_message = self._on_message
        client.on_publish = self._on_publish

    def start(self) -> None:
        """Connect, again and again where it fails."""
        self._client.connect_async(self._config.host, self._config.port, keepalive=KEEPALIVE_S)
        self._client.loop_start()

    @property
    def sessions(self) -> int:
        """How often a connection was made: a new one may have a broker that has forgotten everything."""
        return self._sessions

    def room(self) -> int:
        """How many messages may be published now."""
        with self._lock:
            return WINDOW - len(self._under_way) if self._is_up else 0

    def publish(self, message: Outgoing) -> int:
        """Hand over a message; returns its number."""
        number = self._client.publish(message.topic, message.text, QOS, message.is_retained).mid
        with self._lock:
            if number in self._early:
                self._early.discard(number)
                self._acknowledged.append(number)
            else:
                self._under_way[number] = time.monotonic()
        return number

    def acknowledged(self) -> Sequence[int]:
        """The numbers of messages that the broker has, since the last call."""
        with self._lock:
            found, self._acknowledged = self._acknowledged, []
        return found

    def received(self) -> Sequence[Received]:
        """What has come since the last call."""
        with self._lock:
            found, self._asked = self._asked, []
        return found

    def problem(self) -> str:
        """What is wrong now; empty if nothing is."""
        if self._refused:
            return self._refused
        if not self._is_up and self._config.tls and not self._sessions:  # the client does not say why
            return f"the broker {self._address} is away, or TLS fails: `fantwin doctor` says which"
        if not self._is_up:
            return f"the broker {self._address} is away: what is new is published when it is back"
        with self._lock:
            since_s = next(iter(self._under_way.values()), None)
        if since_s is not None and time.monotonic() - since_s > HANGS_AFTER_S:
            return f"the broker {self._address} acknowledges nothing: it hangs, or is overloaded"
        return self._refused_subscription

    def stop(self, last: Outgoing) -> None:
        """Publish a last message, if the broker is there, and leave it."""
        thread = threading.Thread(target=self._stop, args=(last,), daemon=True)
        thread.start()
        thread.join(STOPPED_WITHIN_S)  # the client may wait longer for a broker that does not answer

    def _stop(self, last: Outgoing) -> None:
        if self._is_up:
            with suppress(RuntimeError, ValueError):  # the connection broke meanwhile
                self._client.publish(last.topic, last.text, QOS, last.is_retained).wait_for_publish(STOPPED_WITHIN_S)
        self._client.disconnect()
        self._client.loop_stop()

    def _on_connect(self, client: Client, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._refused = refusal(reason)
            return
        self._refused = self._refused_subscription = ""
        if self._requests:
            client.subscribe([(pattern, QOS) for pattern in self._requests])
        self._sessions += 1
        self._is_up = True

    def _on_subscribe(self, _client: Any, _data: Any, _mid: int, reasons: Any, _properties: Any) -> None:
        failures = [str(reason) for reason in reasons if reason.is_failure]
        if failures:
            self._refused_subscription = (
                f"the broker refuses the subscription to requests: {failures[0]}; check the rights of this user"
            )

    def _on_connect_fail(self, _client: Any, _data: Any) -> None:
        self._is_up, self._refused = False, ""

    def _on_disconnect(self, _client: Any, _data: Any, _flags: Any, _reason: Any, _properties: Any) -> None:
        self._is_up = False
        with self._lock:  # those under way are sent again
            self._under_way = dict.fromkeys(self._under_way, time.monotonic())

    def _on_message(self, _client: Any, _data: Any, message: MQTTMessage) -> None:
        try:
            topic = message.topic
        except UnicodeDecodeError:  # it would end the thread
            return
        with self._lock:
            if len(self._asked) < MOST_REQUESTS:
                self._asked.append(Received(topic, bytes(message.payload), message.retain))
            else:
                self.dropped_requests += 1

    def _on_publish(self, _client: Any, _data: Any, mid: int, _reason: Any, _properties: Any) -> None:
        with self._lock:
            if self._under_way.pop(mid, None) is None:
                self._early.add(mid)
            else:
                self._acknowledged.append(mid)

"""The replay's producer on the bus, with its own sequence numbers, health and liveliness token."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import replace

from fantwin.pipeline.bus.publisher import Publisher
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.runtime.health import HealthBuilder
from fantwin.pipeline.timebase.stage_clock import REPLAY
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.health import Output
from fantwin.schemas.messages import Clock, Message
from fantwin.schemas.topics import ALL_TRAYS, BY_NAME, alive_key, health_key, tray_key, tray_of


class Sender:
    """Publishes recorded messages under the site's keys with new headers, the clock of each tray, and health."""

    def __init__(self, bus: Bus, site: str, trays: Collection[str]) -> None:
        """Join the bus; `trays` are the trays of the site."""
        self.producer = f"{REPLAY}-all-{bus.id}"
        self.sent: Counter[str] = Counter()
        """messages sent, by topic"""
        self._bus = bus
        self._site = site
        self._publishers: dict[str, Publisher] = {}
        self._clocks = {tray: self._publisher(tray_key(site, tray, "clock"), "clock") for tray in trays}
        self._health = self._publisher(health_key(site, REPLAY, ALL_TRAYS), "health")
        self._builder = HealthBuilder(REPLAY, ALL_TRAYS, time.time_ns(), may_drop=False)
        self.publish_health(StageStatus.STARTING)
        bus.declare_alive(alive_key(site, REPLAY, ALL_TRAYS))
        bus.require_rights()

    def send(self, entry: Envelope) -> None:
        """Publish a message; blocks while a reader is behind.

        Raises:
            UserError: the site has no such tray.
        """
        tray = tray_of(entry.key)
        if tray not in self._clocks:
            raise UserError(f"the recording has a tray {tray!r}, the configuration has none of that name: see -c")
        key = tray_key(self._site, tray, entry.topic)
        if key not in self._publishers:
            self._publishers[key] = self._publisher(key, entry.topic)
        self._put(self._publishers[key], entry.message, tray)
        self.sent[entry.topic] += 1

    def publish_clock(self, t_ns: int, rate: float) -> None:
        """Publish recorded time and the rate at which it passes."""
        for tray, publisher in self._clocks.items():
            self._put(publisher, Clock(t_ns=t_ns, rate=rate), tray)

    def publish_health(self, status: StageStatus = StageStatus.OK, problem: str = "") -> None:
        """Publish health with the number of sent messages, so that a reader that missed the last ones asks for them."""
        health = self._builder.build(
            status=status,
            problems=[problem],
            inputs=(),
            outputs=[Output(key=key, published=count) for key, count in self.published().items()],
            counters={},
            now_ns=time.time_ns(),
        )
        self._put(self._health, replace(health, is_last=status == StageStatus.STOPPED), "")

    def published(self) -> Mapping[str, int]:
        """Messages sent, by key."""
        return {key: publisher.published for key, publisher in self._publishers.items()}

    def _publisher(self, key: str, topic: str) -> Publisher:
        return self._bus.publisher(key, BY_NAME[topic], type_name(BY_NAME[topic].message), self.producer)

    def _put(self, publisher: Publisher, message: Message, tray: str) -> None:
        publisher.put(encode(replace(message, header=Header(self.producer, publisher.published, tray))))

"""A real stage on a secured bus, run in a thread of this process, and an acquisition that feeds it, for tests."""

from __future__ import annotations

from dataclasses import replace
from typing import Self

import numpy as np

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.runtime.sessions import Session
from fantwin.pipeline.runtime.stage import load_stage
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.header import Header
from fantwin.schemas.health import Health, Output
from fantwin.schemas.messages import Raw
from fantwin.schemas.topics import BY_NAME, health_key, tray_key
from tests.support.made_messages import filled, health
from tests.support.running_stage import RunningStage
from tests.support.secured_site import SITE, SecuredSite

SAMPLES, STEP_NS = 10, 10_000_000
"""of a message: 0.1 s at 100 Hz"""


class SecuredStage(RunningStage):
    """Runs until the block ends."""

    def __init__(self, site: SecuredSite, name: str, *settings: str) -> None:
        config = parse_config(site.config.text, site.config.path, settings, stages=(name,))
        super().__init__(load_stage(name), config)

    def __enter__(self) -> Self:
        self.wait_until_ready()
        return self


class Sender:
    """An acquisition of tray a as the others see it: its token, its samples, its health."""

    def __init__(self, bus: Bus, name: str) -> None:
        self.producer = f"acquisition-all-{name}"
        session = Session("acquisition", "all", HOST_CLOCK.now_ns(), self.producer, "host", 1)
        bus.declare_alive(session.key(SITE))
        self._raw = bus.publisher(tray_key(SITE, "a", "raw"), BY_NAME["raw"], type_name(Raw), self.producer)
        self._health = bus.publisher(
            health_key(SITE, "acquisition", "all"), BY_NAME["health"], type_name(Health), self.producer
        )
        self._began_ns = HOST_CLOCK.now_ns() - STEP_NS * SAMPLES
        self.sent: list[bytes] = []

    def send(self) -> None:
        """The next samples, which continue those before without a gap."""
        number = self._raw.published
        message = replace(samples(self._began_ns, number), header=Header(self.producer, number, "a"))
        self.sent.append(encode(message))
        self._raw.put(self.sent[-1])

    @property
    def newest_ns(self) -> int:
        """The time of the last sample that was sent."""
        return self._began_ns + STEP_NS * (SAMPLES * self._raw.published - 1)

    def send_health(self) -> None:
        """That it is there, and what it publishes."""
        outputs = (Output(key=self._raw.key, published=self._raw.published),)
        about = {"sequence": self._health.published, "t_ns": HOST_CLOCK.now_ns(), "outputs": outputs}
        self._health.put(encode(health("acquisition", producer=self.producer, **about)))


def samples(began_ns: int, number: int) -> Raw:
    """Message `number` of a tray of two fans."""
    t_ns = began_ns + STEP_NS * (SAMPLES * number + np.arange(SAMPLES))
    return filled(Raw, SAMPLES, 2, host_receive_t_ns=t_ns, command=0.5, speed_rad_s=100.0)


def counter(health: Health | None, name: str) -> int:
    """A counter of a health; 0 if it has none of this name."""
    return next((each.value for each in (health.counters if health else ()) if each.name == name), 0)

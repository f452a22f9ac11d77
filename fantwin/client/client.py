"""A connection to the bus of a site."""

from __future__ import annotations

import logging
import threading
import time
from types import TracebackType
from typing import Any, Self

from fantwin.client.errors import NotAllowedError, NotReceivedError, SendError
from fantwin.client.tray import READING, Tray
from fantwin.pipeline.bus.errors import BusError
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.roles import SOURCE
from fantwin.pipeline.config.settings import BusConfig
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import SpeedUnit

_LOG = logging.getLogger(__name__)
KEPT_SAMPLES = 100_000
"""of one tray that are kept here while acquisition is away: 17 minutes at 100 Hz"""


def connect(endpoint: str = "tcp/127.0.0.1:7447", site: str = "site", **bus: Any) -> Client:
    """Connect to the bus of a site.

    endpoint: `bus.endpoint` of the configuration. site: its `site`. bus: other settings of its `[bus]`, such as
    `mode="client"` where processes meet at `fantwin router`, and `security={"folder": ...}` where it has
    certificates: the folder has ca.pem, source.pem and source.key, of role `source`, and a relative one starts at the
    working directory.

    Raises:
        BusError: the endpoint cannot be used, or nobody answers there as fantwin does.
        pydantic.ValidationError: no such setting.
    """
    settings = BusConfig(endpoint=endpoint, **bus)
    if settings.security and settings.mode == "peer":  # a peer takes messages itself, and knows no roles of the site
        raise BusError('security needs mode="client": who may do what is checked by `fantwin router`')
    return Client(Bus(settings, listens=False, roles=(SOURCE,)), site)


class Client:
    """A connection. It ends with `close`, or with its `with` block."""

    def __init__(self, bus: Bus, site: str) -> None:
        self._bus = bus
        self._site = site
        self._trays: dict[str, Tray] = {}

    def tray(
        self,
        name: str,
        *,
        speed_unit: SpeedUnit = "rad/s",
        kept_samples: int = KEPT_SAMPLES,
        timeout_s: float = 5.0,
    ) -> Tray:
        """Take up a tray, to publish its samples.

        speed_unit: of the speeds given to `publish`. kept_samples: so many are kept while acquisition is away or
        behind. timeout_s: how long to wait for its acquisition; `math.inf`: until it is there.

        Raises:
            NotAllowedError: the certificate may not publish samples of this tray, or the router refuses it.
            NoAcquisitionError: no acquisition of this tray is at work, or its source is not `push`.
            ClientError: there is no such unit.
            ValueError: it was taken up before.
        """
        if name in self._trays:
            raise ValueError(f"tray {name} was taken up before")
        self._bus.wait_for_others(threading.Event())
        if problem := self._bus.why_not_published(self._site, tray_key(self._site, name, READING)):
            raise NotAllowedError(f"tray {name}: {problem}; use one of role {SOURCE!r}, or '{SOURCE}.{name}'")
        tray = Tray(self._bus, self._site, name, speed_unit, kept_samples, timeout_s)
        self._trays[name] = tray
        return tray

    def close(self, timeout_s: float = 5.0) -> None:
        """Wait until acquisition has received all samples, at most so long, and leave the bus.

        Raises:
            NotReceivedError: it has not received all.
            SendError: a thread that sends has failed.
        """
        until_s = time.monotonic() + timeout_s
        errors: list[NotReceivedError | SendError] = []
        for tray in self._trays.values():
            try:
                tray.wait_received(max(0.0, until_s - time.monotonic()))
            except (NotReceivedError, SendError) as error:
                errors.append(error)
            tray.stop()
        self._bus.close()
        if errors:
            raise errors[0] if len(errors) == 1 else NotReceivedError("; ".join(map(str, errors)))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        except (NotReceivedError, SendError) as not_received:
            if error is None:
                raise
            _LOG.warning("%s", not_received)  # the other error is the one to raise

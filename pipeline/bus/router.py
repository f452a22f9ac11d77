"""A router: the meeting point of processes on several hosts or in containers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import zenoh

from fantwin.pipeline.bus.errors import BusError, reason
from fantwin.pipeline.bus.opening import given_up_soon
from fantwin.pipeline.bus.rights import SiteRoles, access_control, answer_rights
from fantwin.pipeline.bus.router_link import LEASE_MS, RETRY
from fantwin.pipeline.bus.settings import Settings

if TYPE_CHECKING:
    from fantwin.pipeline.bus.credentials import Credentials

QUEUE_BATCHES = 16
"""of 64 KiB for each client, the most that Zenoh allows: for what is sent to a client that has vanished"""
LONGEST_WAIT_US = 1_000_000
"""a client that takes nothing for so long while its queue is full is cut off, and connects again. Until then the router
does not read from whoever sends to it. That must be well below the lease: after it, the router would take the senders
for gone as well, and Zenoh does not give back its subscriptions to a client that comes back meanwhile (zenoh #2806).
"""


@contextmanager
def open_router(
    endpoint: str,
    credentials: Credentials | None = None,
    site: SiteRoles | None = None,
    zenoh_settings: Mapping[str, Any] | None = None,
    others: Sequence[str] = (),
) -> Iterator[None]:
    """A router that listens on `endpoint` until the block ends.

    credentials, site: with both, only clients with a certificate of the same authority connect, and each may do only
    what its role may do in this site.
    others: endpoints of other routers of the site. It connects to each of them as soon as that is there, and again.

    Raises:
        BusError: it cannot listen there.
    """
    settings = Settings()
    try:
        settings.set("mode", "router")
        settings.set("listen/endpoints", [endpoint])
        settings.set("connect/endpoints", list(others))
        settings.set("connect/timeout_ms", -1)
        settings.set("connect/exit_on_failure", False)
        settings.set("connect/retry", RETRY)
        settings.set("transport/link/tx/lease", int(LEASE_MS))
        settings.set("transport/link/tx/queue/size/data", QUEUE_BATCHES)
        settings.set("transport/link/tx/queue/congestion_control/block/wait_before_close", LONGEST_WAIT_US)
        settings.set("scouting/multicast/enabled", False)
        settings.secure(credentials)
        if credentials and site:
            settings.set("access_control", access_control(site))
        settings.pass_through(zenoh_settings or {})
        session = zenoh.open(settings.config)
    except zenoh.ZError as error:
        raise BusError(f"the router cannot listen on {endpoint!r}: {reason(error)}; is one running already?") from error
    try:
        answering = answer_rights(session, site) if site else None
        with given_up_soon():
            yield
        if answering is not None:
            answering.undeclare()
    finally:
        session.close()

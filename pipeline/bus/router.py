"""A router: the meeting point of processes on several hosts or in containers."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import zenoh

from pipeline.bus.errors import BusError, reason
from pipeline.bus.link import LEASE_MS, RETRY

QUEUE_BATCHES = "16"
"""of 64 KiB for each client, the most that Zenoh allows: for what is sent to a client that has vanished"""
LONGEST_WAIT_US = "1000000"
"""a client that takes nothing for so long while its queue is full is cut off, and connects again. Until then the router
does not read from whoever sends to it. That must be well below the lease: after it, the router would take the senders
for gone as well, and Zenoh does not give back its subscriptions to a client that comes back meanwhile (zenoh #2806).
"""


@contextmanager
def open_router(endpoint: str, others: Sequence[str] = ()) -> Iterator[None]:
    """A router that listens on `endpoint` until the block ends.

    others: endpoints of other routers of the site. It connects to each of them as soon as that is there, and again.

    Raises:
        BusError: it cannot listen there.
    """
    conf = zenoh.Config()
    try:
        conf.insert_json5("mode", '"router"')
        conf.insert_json5("listen/endpoints", json.dumps([endpoint]))
        conf.insert_json5("connect/endpoints", json.dumps(list(others)))
        conf.insert_json5("connect/timeout_ms", "-1")
        conf.insert_json5("connect/exit_on_failure", "false")
        conf.insert_json5("connect/retry", json.dumps(RETRY))
        conf.insert_json5("transport/link/tx/lease", LEASE_MS)
        conf.insert_json5("transport/link/tx/queue/size/data", QUEUE_BATCHES)
        conf.insert_json5("transport/link/tx/queue/congestion_control/block/wait_before_close", LONGEST_WAIT_US)
        conf.insert_json5("scouting/multicast/enabled", "false")
        session = zenoh.open(conf)
    except zenoh.ZError as error:
        raise BusError(f"the router cannot listen on {endpoint!r}: {reason(error)}; is one running already?") from error
    try:
        yield
    finally:
        session.close()

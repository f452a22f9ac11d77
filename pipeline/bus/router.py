"""A router: the meeting point of processes on several hosts or in containers."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager

import zenoh

from pipeline.bus.errors import BusError, reason
from pipeline.bus.link import LEASE_MS


@contextmanager
def open_router(endpoint: str) -> Iterator[None]:
    """A router that listens on `endpoint` until the block ends.

    Raises:
        BusError: it cannot listen there.
    """
    conf = zenoh.Config()
    try:
        conf.insert_json5("mode", '"router"')
        conf.insert_json5("listen/endpoints", json.dumps([endpoint]))
        conf.insert_json5("transport/link/tx/lease", LEASE_MS)
        conf.insert_json5("scouting/multicast/enabled", "false")
        session = zenoh.open(conf)
    except zenoh.ZError as error:
        raise BusError(f"the router cannot listen on {endpoint!r}: {reason(error)}; is one running already?") from error
    try:
        yield
    finally:
        session.close()

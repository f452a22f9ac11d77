"""A process that publishes noise on a secured bus as fast as it can, for tests: FOLDER ENDPOINT ROLE KEY MESSAGES.

FOLDER has the certificates. It publishes so many messages at least, and goes on until its standard input closes; then
it prints how many it has sent, all of which the router has had by then.
"""

from __future__ import annotations

import sys
import threading
from pathlib import Path

import zenoh

from tests.support.secured_site import SecuredSite

NOISE = bytes([255]) * 8000


def flood(folder: str, endpoint: str, role: str, key: str, messages: int) -> int:
    """How many it has sent."""
    site, ended, sent = SecuredSite(Path(folder), endpoint, is_new=False), threading.Event(), 0
    publisher = site.session(role).declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    while sent < messages or not ended.is_set():
        publisher.put(NOISE)
        sent += 1
    site.flush(role)
    return sent


if __name__ == "__main__":
    print(flood(sys.argv[1], sys.argv[2], sys.argv[3], sys.argv[4], int(sys.argv[5])), flush=True)

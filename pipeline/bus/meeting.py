"""A process that joins the bus for a moment, through which peers meet again that a cut link has left apart.

Zenoh does not reconnect two peers that discovered each other through a third one. A new peer, however, is told of all
peers and introduces them to one another. It runs in a process of its own, because a session that cannot reach its
endpoint takes ten seconds to close, and a process that ends meanwhile is aborted.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress

import zenoh

STAYS_S = 5.0
"""time that the process stays: enough for all peers to connect, and the interval between two attempts"""
MOST_S = 30.0
"""after this long it ends, also if Zenoh hangs"""


class Meeting:
    """Starts the process, one at a time. It ends by itself."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def is_under_way(self) -> bool:
        """Whether the process is running."""
        return self._process is not None and self._process.poll() is None

    def begin(self, conf: zenoh.Config) -> None:
        """Start the process with these settings. If the system cannot start it, the next call tries again."""
        with suppress(OSError):
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "fantwin.pipeline.bus.meeting"],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
            assert self._process.stdin
            with self._process.stdin as settings:
                settings.write(str(conf).encode())


def main() -> None:
    """Join with the settings from standard input, and leave."""
    signal.alarm(round(MOST_S))
    _session = zenoh.open(zenoh.Config.from_json5(sys.stdin.read()))
    time.sleep(STAYS_S)
    os._exit(0)  # closing may take ten seconds, and the others see that the link has gone


if __name__ == "__main__":
    main()

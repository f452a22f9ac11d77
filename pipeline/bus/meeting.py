"""A process that joins the bus for a moment, through which peers meet again that a cut link has left apart.

Zenoh does not connect again two peers that had found each other through a third one. But whoever joins is told of all
peers, and tells them of one another. It is a process of its own because a session that cannot reach its endpoint takes
ten seconds to close, and Zenoh ends a process that ends meanwhile with an abort.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from contextlib import suppress

import zenoh

STAYS_S = 5.0
"""long enough for all to connect, and the time between two attempts"""


class Meeting:
    """The process, which ends by itself."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def begin(self, conf: zenoh.Config) -> None:
        """Let a process join with these settings, unless one is there. A system that has no process left is asked the
        next time."""
        if self._process is not None and self._process.poll() is None:
            return
        with suppress(OSError):
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "pipeline.bus.meeting"],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                start_new_session=True,
            )
            assert self._process.stdin
            self._process.stdin.write(str(conf).encode())
            self._process.stdin.close()


def main() -> None:
    """Join with the settings from standard input, and leave."""
    session = zenoh.open(zenoh.Config.from_json5(sys.stdin.read()))
    time.sleep(STAYS_S)
    del session
    os._exit(0)


if __name__ == "__main__":
    main()

"""A host clock that can be set, for the processes of a self-test only.

The scratch site puts a `sitecustomize.py` that imports this module on the path of its processes. Their wall clock then
reads the host's clock plus the nanoseconds in a file. Monotonic clocks are left alone.
"""

from __future__ import annotations

import mmap
import os
import time
from pathlib import Path

VARIABLE = "FANTWIN_SELFTEST_CLOCK"
"""environment variable with the path of the file: 8 bytes, a signed little-endian offset in ns"""


def set_offset_ns(path: Path, offset_ns: int) -> None:
    """Set the clock of the processes that read this file."""
    with path.open("r+b" if path.exists() else "w+b") as file:
        file.write(offset_ns.to_bytes(8, "little", signed=True))


def install() -> None:
    """Make `time.time_ns` and `time.time` of this process follow the file that `VARIABLE` names."""
    with Path(os.environ[VARIABLE]).open("rb") as file:
        offset = mmap.mmap(file.fileno(), 8, access=mmap.ACCESS_READ)
    host_time_ns = time.time_ns

    def time_ns() -> int:
        return host_time_ns() + int.from_bytes(offset[:8], "little", signed=True)

    time.time_ns = time_ns
    time.time = lambda: time_ns() / 1e9

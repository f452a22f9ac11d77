"""What recordings must survive: a writer that is killed, and a disk that is full."""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def kill_a_recorder(path: Path, flushed: int) -> None:
    """Another process writes, flushes, and dies of kill -9 with unflushed messages."""
    program = f"""
import os, signal, sys
from pathlib import Path
from tests.support.written_recordings import RAW_KEY, raw
from fantwin.pipeline.recordings.writing import RecordingWriter
writer = RecordingWriter(Path(sys.argv[1]), {{}})
for sequence in range({flushed}):
    writer.add_message(RAW_KEY, raw(sequence), sequence)
writer.flush()
for sequence in range({flushed}, {flushed} + 3):
    writer.add_message(RAW_KEY, raw(sequence), sequence)
os.kill(os.getpid(), signal.SIGKILL)
"""
    child = subprocess.run([sys.executable, "-c", program, path], cwd=Path(__file__).parents[2], check=False)
    assert child.returncode == -signal.SIGKILL


@contextmanager
def disk_of(size: int) -> Iterator[None]:
    """Files of this process cannot grow beyond `size` bytes: the system writes a part, then refuses."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)

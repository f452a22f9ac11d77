"""A small disk for tests: a file system of its own in memory."""

from __future__ import annotations

import subprocess
from pathlib import Path

SIZE_BYTES = 8 << 20


def mount(place: Path) -> bool:
    """Mount an empty disk of `SIZE_BYTES`. Returns False where that is not permitted."""
    words = ["mount", "-t", "tmpfs", "-o", f"size={SIZE_BYTES}", "tmpfs", str(place)]
    try:
        return subprocess.run(words, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False


def unmount(place: Path) -> None:
    """Unmount it, even while files are open."""
    subprocess.run(["umount", "-l", str(place)], capture_output=True, check=False)

"""A wheel as `pip` would build and unpack it, without an index."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

BUILD = "import sys, setuptools.build_meta as backend; print(backend.build_wheel(sys.argv[1]))"


def unpacked_wheel(source: Path, folder: Path) -> Path:
    """The folder that the wheel of a project is unpacked to, as site-packages would be; both are made in `folder`."""
    subprocess.run([sys.executable, "-c", BUILD, folder], cwd=source, capture_output=True, check=True)
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder / "installed")
    return folder / "installed"

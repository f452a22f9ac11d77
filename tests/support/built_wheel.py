"""A wheel as `pip` would build and unpack it, without an index."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = ("fantwin", *sorted(link.readlink().name for link in (ROOT / "fantwin").iterdir() if link.is_symlink()))
_FILES = ("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE", "requirements-image.lock")
BUILD = "import sys, setuptools.build_meta as backend; print(backend.build_wheel(sys.argv[1]))"


def copied_source(folder: Path) -> Path:
    """What the wheel of this checkout is made from, copied into a new folder: a build leaves its traces there."""
    for name in FOLDERS:
        shutil.copytree(ROOT / name, folder / name, symlinks=True, ignore=shutil.ignore_patterns("__pycache__"))
    for name in _FILES:
        shutil.copy(ROOT / name, folder)
    return folder


def wheel_of(source: Path, folder: Path) -> Path:
    """The wheel of a project, made in `folder`."""
    subprocess.run([sys.executable, "-c", BUILD, folder], cwd=source, capture_output=True, check=True)
    (wheel,) = folder.glob("*.whl")
    return wheel


def unpacked_wheel(source: Path, folder: Path) -> Path:
    """The folder that the wheel of a project is unpacked to, as site-packages would be; both are made in `folder`."""
    with zipfile.ZipFile(wheel_of(source, folder)) as archive:
        archive.extractall(folder / "installed")
    return folder / "installed"

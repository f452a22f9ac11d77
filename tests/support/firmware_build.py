"""The firmware of firmware/, built for tests: for the chip, with its simulator, and in parts for this machine."""

from __future__ import annotations

import fcntl
import hashlib
import shutil
import subprocess
import tempfile
from pathlib import Path

import pytest

FIRMWARE = Path(__file__).parents[2] / "firmware"
SIMAVR = Path("/usr/include/simavr/sim_avr.h")


def built(target: str, **settings: str | int) -> Path:
    """Make a target of firmware/Makefile; returns the folder it is in. Equal builds are made once."""
    words = [f"{name}={value}" for name, value in sorted(settings.items())]
    key = hashlib.sha256(" ".join([str(FIRMWARE), *words]).encode()).hexdigest()[:12]
    folder = Path(tempfile.gettempdir()) / f"fantwin-firmware-{key}"
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        command = ["make", "-s", "-C", str(FIRMWARE), target, f"BUILD={folder}", *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def parts_library() -> Path:
    """The parts without hardware as a library of this machine; skips the test without a compiler."""
    if not shutil.which("cc"):
        pytest.skip("no C compiler (cc)")
    return built("library") / "libfirmware.so"


def firmware_file(**settings: str | int) -> Path:
    """The firmware for the chip; skips the test without its compiler."""
    if not shutil.which("avr-gcc"):
        pytest.skip("no compiler for the ATmega328P: apt-get install gcc-avr avr-libc")
    return built("all", **settings) / "fan_board.elf"


def simulator_file() -> Path:
    """The simulator of the board; skips the test without simavr."""
    if not SIMAVR.exists() or not shutil.which("cc"):
        pytest.skip("no simulator of the ATmega328P: apt-get install libsimavr-dev libelf-dev")
    return built("simulator") / "simulator"

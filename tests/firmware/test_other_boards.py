"""The sketch for ESP32 and Pico, compiled for this machine against a stub of their cores; no board has run it."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from fantwin.schemas.wire import CommandFrame, Decoder, DeviceCounters, Sample, encode
from tests.support.firmware_build import FIRMWARE

BOARD = Path(__file__).with_name("board_on_a_pc.h")
WARNINGS = ["-Wall", "-Wextra", "-Werror"]
NAN = float("nan")


@pytest.mark.parametrize(
    ("board", "full", "half"), [("ESP32", 0, 512), ("ARDUINO_ARCH_RP2040", 0, 320)], ids=["ESP32", "Pico"]
)
def test_a_board_sends_samples_takes_commands_and_drives_inverted_pins(
    tmp_path: Path, board: str, full: int, half: int
) -> None:
    if not shutil.which("c++") or not shutil.which("cc"):
        pytest.skip("no C and C++ compiler (cc, c++)")
    defines = [f"-D{board}", "-DFANS=3", *WARNINGS]
    sources = sorted((FIRMWARE / "src").glob("*.c"))  # all that the Arduino IDE compiles, those for the Uno included
    objects = [tmp_path / f"{source.stem}.o" for source in sources]
    program = tmp_path / "board"
    for source, compiled in zip(sources, objects, strict=True):
        subprocess.run(["cc", "-std=gnu11", "-c", *defines, source, "-o", compiled], check=True)
    sketch = ["-std=gnu++17", "-include", BOARD, "-x", "c++", FIRMWARE / "firmware.ino", "-x", "none"]
    subprocess.run(["c++", *defines, *sketch, *objects, "-lm", "-o", program], check=True)
    typed = encode("binary", CommandFrame((0.5, NAN, 0.0)))
    done = subprocess.run([program], input=typed, capture_output=True, check=True)

    found = Decoder("binary", 3).feed(done.stdout)
    samples = [each for each in found if isinstance(each, Sample)]
    counters = [each for each in found if isinstance(each, DeviceCounters)]
    assert len(samples) + len(counters) == len(found)
    assert [each.sequence for each in samples] == list(range(100))
    assert [each.clock_us for each in samples] == [20_000 * number for number in range(100)]
    assert samples[40].speed == (3000.0, 0.0, 0.0) and samples[40].command == (1.0, 1.0, 1.0)
    assert samples[-1].command == (0.5, 1.0, 0.0)
    assert [each.counts[0] for each in counters] == [0, 1], "frames taken"
    pins = [int(word) for word in done.stderr.split()]
    assert pins[:2] == [half, full] and pins[2] == 2 * half

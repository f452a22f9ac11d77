"""The sketch of the example `arduino`, compiled for this machine: its lines are those that fantwin reads."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from fantwin.schemas.wire import Decoder, Sample

SKETCH = Path(__file__).parents[2] / "examples" / "arduino" / "arduino.ino"
BOARD = Path(__file__).with_name("arduino_on_a_pc.h")


def test_the_sketch_prints_samples_and_takes_commands(tmp_path: Path) -> None:
    if not shutil.which("c++"):
        pytest.skip("no C++ compiler (c++)")
    program = tmp_path / "sketch"
    words = ["c++", "-std=c++11", "-Wall", "-Werror", "-include", BOARD, "-x", "c++", SKETCH, "-o", program]
    compiled = subprocess.run(words, capture_output=True, text=True, check=False)
    assert compiled.returncode == 0, compiled.stderr
    shown = subprocess.run([program], capture_output=True, check=True).stdout
    found = Decoder("text", 2, "host").feed(b"\n" + shown)
    samples = [each for each in found if isinstance(each, Sample)]
    assert samples == found
    assert [each.sequence for each in samples] == list(range(100))
    assert [each.clock_us for each in samples] == [10_000 * k for k in range(100)]
    assert samples[10].speed == (3000.0, 0.0)
    assert (samples[10].command, samples[-1].command) == ((0.5, 0.5), (0.5, 0.75))
    assert shown.endswith(b"# duties 127 191\n")

"""How long a recording can be at most."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.recordings.length import longest_s
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Raw
from fantwin.schemas.topics import tray_key
from fantwin.schemas.units import NS_PER_S

SAMPLES = 2
"""of a message, a second apart"""


def recorded(path: Path, set_back_s: int = 0, pace: int = 1) -> Path:
    """A hundred seconds, in the middle of which the host's clock is set back; replayed at a pace."""
    with RecordingWriter(path, {"site": "plant"}) as writer:
        for number in range(50):
            t_ns = (np.arange(SAMPLES) + number * SAMPLES - (set_back_s if number > 24 else 0)) * NS_PER_S
            nothing = np.zeros((SAMPLES, 1))
            message = Raw(
                header=Header("acquisition-1", number, "tray1"),
                fans=1,
                host_receive_t_ns=t_ns + 10**15,
                command=nothing,
                speed_rad_s=nothing,
            )
            writer.add_message(tray_key("plant", "tray1", "raw"), message, 10**15 + int(t_ns[-1]) // pace)
            writer.flush()
    return writer.path


@pytest.mark.parametrize("pace", [1, 10])
def test_the_length_is_that_of_the_samples_and_not_of_the_time_it_took_to_record_them(tmp_path: Path, pace: int):
    assert longest_s(recorded(tmp_path / "r.mcap", pace=pace), 10**15) == 99.0


@pytest.mark.parametrize("set_back_s", [30, 3600])
def test_a_host_clock_that_was_set_back_shortens_nothing(tmp_path: Path, set_back_s: int):
    pause_s = SAMPLES
    assert 99.0 - pause_s <= longest_s(recorded(tmp_path / "r.mcap", set_back_s), 10**15) < math.inf


def test_a_recording_without_an_index_can_have_any_length(tmp_path: Path):
    path = recorded(tmp_path / "r.mcap")
    path.write_bytes(path.read_bytes()[:-100])
    assert longest_s(path, 10**15) == math.inf

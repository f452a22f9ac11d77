"""Excerpts of a recording, read by its index: what they cost, and that they are those of the whole recording."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.recordings.excerpts import ExcerptReader
from fantwin.pipeline.recordings.reading import RecordingError
from fantwin.pipeline.recordings.training_runs import read_runs
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas import envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Array, Raw
from fantwin.schemas.topics import tray_key

START_NS = 1_800_000_000_000_000_000
RATE_HZ, SECONDS, FANS, BLOCK = 20, 1200, 2, 10
SAMPLES = RATE_HZ * SECONDS
LINE_DELAY_S = 2e-3
TENTH_OF_MS = 1e-4


def times_ns() -> Array:
    """When samples were received: on time, and later at random."""
    late_s = np.random.default_rng(1).exponential(LINE_DELAY_S, SAMPLES)
    return START_NS + ((np.arange(SAMPLES) / RATE_HZ + late_s) * 1e9).astype(np.int64)


def clock_us() -> Array:
    """A recording of a device whose clock wraps after half the recording, and is 30 ppm slow."""
    since_us = np.arange(SAMPLES) * (1e6 / RATE_HZ) * (1.0 - 30e-6)
    return (since_us.astype(np.int64) + 2**32 - 600_000_000) % 2**32


def written(
    path: Path, *, has_clock: bool, trays: tuple[str, ...] = ("tray1",), hidden: int = 0, block: int = BLOCK
) -> Path:
    """A long recording. hidden: so many first samples have no command. block: samples a message."""
    received, clock = times_ns(), clock_us()
    number = np.arange(SAMPLES, dtype=float)
    command = np.where(number < hidden, np.nan, number)
    with RecordingWriter(path, {"speed_unit": "rpm"}, overwrite=True) as writer:
        for sequence, first in enumerate(range(0, SAMPLES, block)):
            rows = slice(first, min(first + block, SAMPLES))
            for tray in trays:
                raw = Raw(
                    header=Header("acquisition", sequence, tray),
                    fans=FANS,
                    host_receive_t_ns=received[rows],
                    device_clock_us=clock[rows].astype(np.uint32) if has_clock else np.array([], np.uint32),
                    command=np.stack([command[rows]] * FANS, axis=1),
                    speed_rad_s=np.stack([number[rows]] * FANS, axis=1),
                )
                writer.add_message(tray_key("plant", tray, "raw"), raw, int(received[rows][-1]))
            if sequence % 100 == 99 or block > BLOCK:
                writer.flush()
    return path


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The sequence numbers of the messages that are decoded."""
    found: list[int] = []
    original = envelope.decode

    def counting(kind: type, payload: bytes) -> object:
        message = original(kind, payload)
        found.append(message.header.sequence)
        return message

    monkeypatch.setattr(envelope, "decode", counting)
    return found


@pytest.fixture(scope="module")
def with_clock(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("clock") / "r.mcap", has_clock=True)


@pytest.fixture(scope="module")
def without_clock(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("none") / "r.mcap", has_clock=False)


def test_an_excerpt_and_commands_are_found_without_decoding_the_recording(with_clock: Path, decoded: list[int]) -> None:
    reader = ExcerptReader(with_clock)
    decoded.clear()
    (run,) = reader.read(600.0, 610.0).runs
    assert len(run.t_s) == 10 * RATE_HZ
    assert len(decoded) < 0.2 * SAMPLES / BLOCK, "100 s of 1200"
    decoded.clear()
    t_s, command = reader.commands(10.0)
    assert len(decoded) < 0.06 * SAMPLES / BLOCK
    assert np.all(np.diff(t_s) < 11.0) and len(t_s) == pytest.approx(SECONDS / 10.0, rel=0.05)
    assert command[:, 0] == pytest.approx(RATE_HZ * t_s, abs=1.0)
    assert len(reader.commands(1.0)[0]) == pytest.approx(SECONDS, rel=0.1)
    with pytest.raises(RecordingError, match="fewer than two raw samples from 5000 s to 5060 s"):
        reader.read(5000.0, 5060.0)


def test_without_a_device_clock_an_excerpt_is_that_of_the_whole_recording(without_clock: Path) -> None:
    reader, path = ExcerptReader(without_clock), without_clock
    for from_s, to_s in ((0.0, 5.0), (33.3, 93.3), (1190.0, 2000.0)):
        (run,), (expected,) = reader.read(from_s, to_s).runs, read_runs(path, from_s=from_s, to_s=to_s).runs
        np.testing.assert_array_equal(run.t_s, expected.t_s)
        np.testing.assert_array_equal(run.speed_rad_s, expected.speed_rad_s)
        np.testing.assert_array_equal(run.command, expected.command)


def test_with_a_device_clock_times_are_within_a_tenth_of_a_millisecond_and_steps_are_the_same(with_clock: Path) -> None:
    reader = ExcerptReader(with_clock)
    (whole,) = read_runs(with_clock).runs
    for from_s in (0.0, 40.0, 550.0, 620.0, 1100.0):
        (run,) = reader.read(from_s, from_s + 60.0).runs
        expected_s = whole.t_s[np.isin(whole.speed_rad_s[:, 0], run.speed_rad_s[:, 0])]
        assert run.t_s == pytest.approx(expected_s, abs=TENTH_OF_MS)
        assert np.diff(run.t_s) == pytest.approx(np.diff(expected_s), rel=1e-5)


def test_a_damaged_chunk_is_left_out_and_said(tmp_path: Path, without_clock: Path) -> None:
    path, content = tmp_path / "r.mcap", bytearray(without_clock.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    reader = ExcerptReader(path)
    assert reader.read(0.0, 60.0).damage == ""
    found = reader.read(0.0, 1200.0)
    assert "damaged chunks left out: 1" in found.damage
    assert sum(len(run.t_s) for run in found.runs) < SAMPLES


def test_recordings_that_an_index_does_not_suit_are_read_whole(tmp_path: Path) -> None:
    late = written(tmp_path / "late.mcap", has_clock=False, hidden=SAMPLES // 2)
    (run,) = ExcerptReader(late).read(0.0, 10.0).runs
    (expected,) = read_runs(late, from_s=0.0, to_s=10.0).runs
    np.testing.assert_array_equal(run.speed_rad_s, expected.speed_rad_s)
    several = written(tmp_path / "several.mcap", has_clock=False, trays=("a", "b"))
    with pytest.raises(RecordingError, match="several trays, a, b"):
        ExcerptReader(several).read(0.0, 10.0)


def test_an_excerpt_may_lie_within_one_long_message_whose_time_is_that_of_its_last_sample(tmp_path: Path) -> None:
    reader = ExcerptReader(written(tmp_path / "long.mcap", has_clock=True, block=4000))  # 200 s
    for from_s, to_s in ((0.0, 60.0), (250.0, 310.0), (390.0, 450.0)):
        (run,) = reader.read(from_s, to_s).runs
        assert len(run.t_s) == pytest.approx((to_s - from_s) * RATE_HZ, abs=1)

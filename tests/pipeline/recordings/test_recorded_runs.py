"""Recordings as runs: time, command and speed as the model maker needs them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.recordings.reading import RecordingError
from fantwin.pipeline.recordings.training_runs import read_runs
from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.enums import TachoKind
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Raw, StatedTacho
from fantwin.schemas.tacho import INSTANTANEOUS, Tacho
from fantwin.schemas.topics import tray_key

START_NS = 1_800_000_000_000_000_000


def record(path: Path, *messages: Raw) -> Path:
    with RecordingWriter(path, {"speed_unit": "rpm"}, overwrite=True) as writer:
        for message in messages:
            writer.add_message(tray_key("plant", message.header.tray, "raw"), message, START_NS)
    return path


def raw(host_ns, clock_us=(), command=None, speed=None, tray="tray1", fans=1) -> Raw:
    samples = len(host_ns)
    return Raw(
        header=Header("acquisition", 0, tray),
        fans=fans,
        host_receive_t_ns=np.array(host_ns, np.int64),
        device_clock_us=np.array(clock_us, np.uint32),
        command=np.ones((samples, fans)) if command is None else np.array(command, float).reshape(samples, fans),
        speed_rad_s=np.arange(float(samples * fans)).reshape(samples, fans)
        if speed is None
        else np.array(speed, float),
    )


def test_the_device_clock_gives_the_time_also_when_it_wraps_and_without_one_the_time_of_receipt_does(tmp_path):
    rng = np.random.default_rng(1)
    clock_us = (2**32 - 500_000 + np.arange(100) * 10_000) % 2**32
    received_ns = START_NS + np.arange(100) * 10_000_000 + rng.integers(0, 5_000_000, 100)
    (run,) = read_runs(record(tmp_path / "r.mcap", raw(received_ns, clock_us))).runs
    np.testing.assert_allclose(run.t_s, np.arange(100) * 0.01, rtol=0, atol=2e-4)
    (run,) = read_runs(record(tmp_path / "r.mcap", raw([START_NS, START_NS + 7, START_NS + 10**9]))).runs
    np.testing.assert_allclose(run.t_s, [0, 7e-9, 1], rtol=0, atol=1e-12)


def test_a_device_that_restarts_begins_a_run(tmp_path):
    before = raw(START_NS + np.arange(50) * 10_000_000, 10**9 + np.arange(50) * 10_000)
    after = raw(START_NS + 10**9 + np.arange(60) * 10_000_000, np.arange(60) * 10_000)
    first, second = read_runs(record(tmp_path / "r.mcap", before, after)).runs
    assert (len(first.t_s), len(second.t_s)) == (50, 60)
    assert second.t_s[0] == pytest.approx(1.0)


def test_repeated_samples_count_once_and_late_ones_are_sorted_in(tmp_path):
    clock_us = np.array([0, 10_000, 10_000, 30_000, 20_000, 40_000])
    speed = [[0.0], [1.0], [1.0], [3.0], [2.0], [4.0]]
    (run,) = read_runs(record(tmp_path / "r.mcap", raw(START_NS + clock_us * 1000, clock_us, speed=speed))).runs
    assert run.speed_rad_s[:, 0].tolist() == [0, 1, 2, 3, 4]
    assert np.all(np.diff(run.t_s) > 0)


def test_missing_speeds_stay_missing_and_missing_commands_are_held(tmp_path):
    message = raw(
        START_NS + np.arange(4) * 10**7, command=[np.nan, 5, np.nan, 7], speed=[[1.0], [np.nan], [3.0], [4.0]]
    )
    (run,) = read_runs(record(tmp_path / "r.mcap", message)).runs
    assert run.command[:, 0].tolist() == [5, 5, 7]
    np.testing.assert_array_equal(run.speed_rad_s[:, 0], [np.nan, 3, 4])


def test_a_fan_that_something_else_drives_for_long_is_no_example_of_its_last_command(tmp_path):
    times = START_NS + np.arange(8) * 250_000_000
    command = [5.0, np.nan, np.nan, np.nan, np.nan, 7.0, 7.0, 7.0]
    (run,) = read_runs(record(tmp_path / "r.mcap", raw(times, command=command))).runs
    assert run.command[:, 0].tolist() == [5, 5, 5, 7, 7, 7] and np.diff(run.t_s).max() == 0.75


def test_a_tray_is_chosen_where_there_are_several(tmp_path):
    times = START_NS + np.arange(3) * 10**7
    path = record(tmp_path / "r.mcap", raw(times, tray="a"), raw(times, tray="b", fans=2))
    assert read_runs(path, tray="b").runs[0].command.shape == (3, 2)
    with pytest.raises(RecordingError, match="several trays, a, b: choose one with --tray"):
        read_runs(path)
    with pytest.raises(RecordingError, match="no raw samples of tray 'c'"):
        read_runs(path, tray="c")


def test_parts_and_fans_that_do_not_exist_are_an_error(tmp_path):
    path = record(tmp_path / "r.mcap", raw(START_NS + np.arange(3) * 10**7))
    with pytest.raises(RecordingError, match="fewer than two raw samples from 5 s to inf s"):
        read_runs(path, from_s=5.0)
    with pytest.raises(RecordingError, match="the tray has fans 0 to 0; see --fans"):
        read_runs(path, fans=[1])
    with pytest.raises(RecordingError, match="no raw samples in this recording"):
        read_runs(record(tmp_path / "empty.mcap"))
    times = START_NS + np.arange(3) * 10**7
    with pytest.raises(RecordingError, match="the number of fans changes from 1 to 2"):
        read_runs(record(tmp_path / "r.mcap", raw(times), raw(times + 10**9, fans=2)))


def test_what_the_messages_state_to_measure_counts_where_the_metadata_say_nothing(tmp_path):
    stated = Tacho(kind="average", window_s=1.0, update_s=1.5)
    messages = [replace(raw([START_NS + k]), tachos=(StatedTacho.of(stated),)) for k in range(3)]
    assert read_runs(record(tmp_path / "r.mcap", *messages)).tacho == (stated,)
    assert read_runs(record(tmp_path / "r.mcap", raw([START_NS, START_NS + 1]))).tacho == INSTANTANEOUS
    unknown = [replace(each, tachos=(StatedTacho(TachoKind(99)),)) for each in messages]
    with pytest.raises(RecordingError, match="raw messages state a tacho that is not one of this version"):
        read_runs(record(tmp_path / "r.mcap", *unknown))

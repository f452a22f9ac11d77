import json
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import serial

from fantwin.pipeline.cli.simulation.simulate import simulate
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.recordings.reading import read_metadata, read_recording
from fantwin.pipeline.sources.simulated.device import PseudoTerminal
from fantwin.schemas import wire
from fantwin.schemas.messages import Raw
from fantwin.schemas.tacho import Tacho
from tests.support.running_chain import RunningCommand, eventually

KEEP = float("nan")


@contextmanager
def simulated(folder: Path, *words: Path, **options: Any) -> Iterator[tuple[threading.Event, threading.Thread]]:
    """`fantwin simulate` in a thread, once its line is there, and what stops it; link and truth lie in the folder."""
    stop = threading.Event()
    files = {"link": folder / "tray", "truth": folder / "truth.json", "wait": True}
    thread = threading.Thread(target=simulate, args=words, kwargs=files | options)
    with patch("fantwin.pipeline.cli.simulation.simulate.stop_on_signals", lambda: stop):
        thread.start()
        eventually((folder / "tray").is_symlink, "the line is there")
    yield stop, thread
    stop.set()
    thread.join(10.0)
    assert not thread.is_alive()


def truth_of(folder: Path) -> dict:
    return json.loads((folder / "truth.json").read_text())


class Reader:
    """The host end of the link."""

    def __init__(self, port: Path, protocol: wire.Protocol = "binary", fans: int = 8) -> None:
        self.serial = serial.Serial(str(port), timeout=5.0, exclusive=True)
        self.protocol: wire.Protocol = protocol
        self.decoder = wire.Decoder(protocol, fans)
        self.samples: list[wire.Sample] = []
        self.faults: list[wire.Fault] = []
        self.counters: list[wire.DeviceCounters] = []

    def read_some(self) -> bool:
        """Whether the device still exists."""
        try:
            data = self.serial.read(1)
            data += self.serial.read(self.serial.in_waiting)
        except OSError:
            return False
        assert data, "nothing came for 5 s"
        for frame in self.decoder.feed(data):
            if isinstance(frame, wire.Sample):
                self.samples.append(frame)
            elif isinstance(frame, wire.DeviceCounters):
                self.counters.append(frame)
            else:
                assert isinstance(frame, wire.Fault)
                self.faults.append(frame)
        return True

    def read_until(self, samples: int) -> None:
        while len(self.samples) < samples:
            assert self.read_some(), "the device is gone"

    def read_all(self) -> None:
        while self.read_some():
            pass

    def send(self, frame: wire.Frame) -> None:
        self.serial.write(wire.encode(self.protocol, frame))


def test_a_reader_gets_every_sample_of_the_tray_that_a_recording_holds_and_the_truth_counts_the_same(
    tmp_path: Path,
) -> None:
    recording = tmp_path / "same.mcap"
    simulate(
        recording=recording, duration=2.0, seed=9, overrides=["epoch_ns=0"], fault=["inlet:fan=1,start=0.5,stop=1"]
    )
    with simulated(tmp_path, duration=2.0, seed=9, fault=["inlet:fan=1,start=0.5,stop=1"]):
        opened_ns = time.time_ns()
        reader = Reader(tmp_path / "tray")
        reader.read_all()
    truth = truth_of(tmp_path)
    assert reader.faults == []
    assert [sample.sequence for sample in reader.samples] == list(range(200))
    assert truth["complete"]
    assert (truth["samples_sent"], truth["samples_dropped"], truth["samples_unsent"]) == (200, 0, 0)
    assert truth["start_ns"] >= opened_ns
    (fault,) = truth["faults"]
    assert (fault["kind"], fault["fan"], fault["size"]) == ("inlet", 1, 1.6)
    assert fault["start_ns"] - truth["start_ns"] == pytest.approx(0.5e9, abs=11e6)
    assert fault["stop_ns"] - truth["start_ns"] == pytest.approx(1.0e9, abs=11e6)
    assert len(truth["parameters"]) == truth["fans"] == 8
    assert not (tmp_path / "tray").is_symlink()
    raw = raw_of(recording)
    clocks, speeds = (
        np.concatenate([getattr(each, name) for each in raw]) for name in ("device_clock_us", "speed_rad_s")
    )
    assert clocks.tolist() == [sample.clock_us for sample in reader.samples]
    assert np.array_equal(speeds.astype(np.float32), [sample.speed for sample in reader.samples])


def test_a_signal_completes_the_truth_and_removes_the_link(tmp_path: Path) -> None:
    files = ("--link", tmp_path / "tray", "--truth", tmp_path / "truth.json")
    process = RunningCommand(["simulate", *files, "--wait-for-reader", "--fault", "rotor:fan=0,start=0"])
    try:
        eventually((tmp_path / "tray").is_symlink, "the line is there")
        reader = Reader(tmp_path / "tray")
        reader.read_until(5)
        running = truth_of(tmp_path)
        process.process.send_signal(signal.SIGTERM)
        reader.read_all()
        assert process.process.wait(10.0) == 0
    finally:
        process.kill()
    assert not running["complete"]
    truth = truth_of(tmp_path)
    assert truth["complete"]
    assert truth["start_ns"] == running["start_ns"]
    assert truth["samples_sent"] == len(reader.samples)
    assert truth["faults"][0]["stop_ns"] == truth["end_ns"] > truth["start_ns"]
    assert not (tmp_path / "tray").is_symlink()


def test_commands_and_set_points_show_in_the_samples(tmp_path: Path) -> None:
    with simulated(tmp_path, fans=2, overrides=["speed_unit=rpm", "noise_rad_s=0"]) as (stop, _):
        reader = Reader(tmp_path / "tray", fans=2)
        reader.read_until(1)
        reader.send(wire.CommandFrame((0.25, KEEP)))
        reader.send(wire.SetPointFrame((KEEP, 3000.0)))
        spoilt = bytearray(wire.encode("binary", wire.CommandFrame((0.75, KEEP))))
        spoilt[-3] ^= 3
        reader.serial.write(b"\0hello\0" + spoilt)
        reader.read_until(300)
        stop.set()
        reader.read_all()
    assert reader.samples[299].command[0] == 0.25
    assert reader.samples[299].speed[1] == pytest.approx(3000.0, rel=0.05)
    truth = truth_of(tmp_path)
    assert (truth["commands_received"], truth["set_points_received"], truth["commands_refused"]) == (1, 1, 2)
    assert [counters.uptime_s for counters in reader.counters[:3]] == [0, 1, 2]
    counts = dict(zip(wire.DEVICE_COUNTERS, reader.counters[2].counts, strict=True))
    assert {name: count for name, count in counts.items() if count} == {"frames": 2, "bad_length": 1, "bad_crc": 1}


def test_a_link_never_replaces_a_file_but_does_replace_a_stale_link(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    with pytest.raises(UserError, match="exists and is not a symbolic link"):
        PseudoTerminal(file)
    assert file.read_text() == "mine"
    link = tmp_path / "tray"
    link.symlink_to("/nowhere")
    first = PseudoTerminal(link)
    assert str(link.readlink()) == first.port
    second = PseudoTerminal(link)
    first.close()
    assert str(link.readlink()) == second.port  # the link is the second one's now
    second.close()
    assert not link.is_symlink()


def raw_of(path: Path) -> list[Raw]:
    return [entry.message for entry in read_recording(path) if isinstance(entry.message, Raw)]


def test_a_recording_holds_the_tray_and_the_same_seed_and_epoch_give_the_same_bytes(tmp_path: Path) -> None:
    one, two, other = (tmp_path / name for name in ("one.mcap", "two.mcap", "other.mcap"))
    for path, seed in ((one, 3), (two, 3), (other, 4)):
        options = {"duration": 3.05, "fans": 2, "fault": ["inlet:fan=1,start=1,stop=2"]}
        overrides = ["lost=0.1", f"epoch_ns={10**18}"]
        simulate(recording=path, seed=seed, overrides=overrides, truth=tmp_path / "truth.json", **options)
    with pytest.raises(UserError, match="exists; name another file"):
        simulate(recording=one, duration=1.0)
    assert one.read_bytes() == two.read_bytes()
    assert one.read_bytes() != other.read_bytes()
    messages = raw_of(other)
    truth = truth_of(tmp_path)
    sequence = np.concatenate([raw.device_sequence for raw in messages])
    t_ns = np.concatenate([raw.host_receive_t_ns for raw in messages])
    assert len(sequence) == truth["samples_sent"] == 305 - truth["samples_dropped"]
    assert t_ns[0] - 10**18 == pytest.approx(sequence[0] * 1e7, abs=1e6)
    assert np.all(np.diff(t_ns) > 0)
    assert truth["faults"][0]["start_ns"] - 10**18 == pytest.approx(1e9, abs=5e6)
    assert all(raw.speed_rad_s.shape == (len(raw.host_receive_t_ns), 2) for raw in messages)


def test_a_rack_of_4_pin_fans_is_recorded_with_counts_of_its_window(tmp_path: Path) -> None:
    recording, truth = tmp_path / "rack.mcap", tmp_path / "truth.json"
    windows = [1.0, 1.0, 0.5, 0.5]
    tachos = "".join(f'[[tacho]]\nkind = "count"\nwindow_s = {window_s}\n' for window_s in windows)
    scenario = tmp_path / "rack.toml"
    rack = 'fan = "4-pin"\nfans = 4\nrate_hz = 10\nprofile = "thermostat"\nmissing_readings = 0.05\n'
    scenario.write_text(rack + tachos, encoding="utf-8")
    simulate(scenario, recording=recording, truth=truth, duration=60.0, fault=["blocked:fan=1,start=30"])
    messages = raw_of(recording)
    speed = np.concatenate([raw.speed_rad_s for raw in messages])
    counts = speed * 2 * np.array(windows) / (2 * np.pi)
    read = np.isfinite(counts)
    assert counts[read] == pytest.approx(np.round(counts[read]))
    assert 0.02 < 1.0 - read.mean() < 0.08
    assert np.nanmax(speed[330:, 1]) == 0.0
    said = truth_of(tmp_path)
    assert said["fan"] == "4-pin"
    assert [tacho["window_s"] for tacho in said["tacho"]["measurement"]] == windows
    assert {(tacho["kind"], tacho["pulses"]) for tacho in said["tacho"]["measurement"]} == {("count", 2)}
    assert said["parameters"][2]["duty_min"] == 0.2
    assert read_metadata(recording).tacho("tray1") == tuple(Tacho(kind="count", window_s=each) for each in windows)


TABLE = """t ms,duty,rpm,rpm2
1000,10,0,5
1004,20,60,
1004.5,30,120,7
1300,40,180,8
9000,50,240,9
"""


def test_a_measured_file_is_played_with_its_recorded_times_and_units(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_text(TABLE)
    scenario = tmp_path / "played.toml"
    columns = 'time = "t ms:ms"\ncommand = ["duty"]\nspeed = ["rpm:rpm", "rpm2:rpm"]\n'
    scenario.write_text(f'speed_unit = "rpm"\n[file]\npath = "run.csv"\nto_s = 1\n{columns}', encoding="utf-8")
    with simulated(tmp_path, scenario):
        reader = Reader(tmp_path / "tray", fans=2)
        reader.read_all()
    assert [sample.clock_us for sample in reader.samples] == [0, 4000, 4500, 300_000]
    assert [sample.command for sample in reader.samples] == [(10.0, 10.0), (20.0, 20.0), (30.0, 30.0), (40.0, 40.0)]
    assert [sample.speed[0] for sample in reader.samples] == pytest.approx([0.0, 60.0, 120.0, 180.0])
    assert np.isnan(reader.samples[1].speed[1])
    truth = truth_of(tmp_path)
    assert (truth["complete"], truth["samples_sent"], truth["faults"]) == (True, 4, [])

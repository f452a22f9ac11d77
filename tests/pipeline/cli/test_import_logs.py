"""`fantwin import` of the logs of other systems: fields by name or pattern become the samples of fans."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.recordings.training_runs import read_runs
from fantwin.schemas.messages import Raw
from fantwin.schemas.tacho import Tacho
from tests.support.fantwin_command import error_of, fantwin
from tests.support.written_logs import write_rosbag, write_ulog
from tests.support.written_recordings import raw_columns

RPM = 2 * np.pi / 60
T_S = np.arange(0, 4, 0.02)
COMMANDS = np.column_stack([0.3 + 0.2 * np.sin(T_S), np.full(len(T_S), 0.5)])
SPEEDS = np.rint(6000 * COMMANDS)


def ulog(folder: Path) -> Path:
    """Commands at 250 Hz, readings at 50 Hz of two of four outputs."""
    path = folder / "flight.ulg"
    fast_us = np.arange(1000, 4_000_000, 4000)
    outputs = [(int(us), *np.interp(us / 1e6, T_S, COMMANDS[:, 0]).repeat(4)) for us in fast_us]
    escs = [(round(t * 1e6) + 9000, *(int(r), 12.0), *(int(s), 12.1)) for t, (r, s) in zip(T_S, SPEEDS, strict=True)]
    topics = {
        "actuator_outputs": ("uint64_t timestamp;float[4] output;", outputs),
        "esc_status": ("uint64_t timestamp;esc_report[2] esc;", escs),
    }
    write_ulog(path, topics)
    return path


def test_ulog_with_commands_held_at_the_times_of_the_readings(tmp_path: Path) -> None:
    recording = tmp_path / "r.mcap"
    words = ("--command", "actuator_outputs.output[*]", "--speed", "esc_status.esc[{fan}].esc_rpm:rpm")
    result = fantwin("import", ulog(tmp_path), *words, "-o", recording)
    assert result.exit_code == 0, result.output
    assert result.stdout.startswith(f"{recording}: 200 samples of 2 fans over 4.0 s, 20 ms apart (median)")
    assert (
        "left out, because only one of command and speed is there: actuator_outputs.output[2], actuator"
        in result.stdout
    )
    assert "commands at 250 Hz, speeds at 50 Hz; each speed has the command held then" in result.stdout
    t_ns, command, speed_rad_s = raw_columns(recording)
    np.testing.assert_allclose(t_ns / 1e9, T_S + 0.009, atol=1e-9)
    np.testing.assert_allclose(speed_rad_s / RPM, SPEEDS, rtol=1e-12)
    held_us = (t_ns // 1000 - 1000) // 4000 * 4000 + 1000  # the last command before the reading
    expected = np.interp(np.minimum(held_us, 3_997_000) / 1e6, T_S, COMMANDS[:, 0])
    np.testing.assert_allclose(command, np.column_stack([expected] * 2), rtol=1e-6)
    assert read_runs(recording).speed_unit == "rpm"
    volts = ("--channel", "supply_voltage_v=esc_status.esc[*].esc_voltage", "--force")
    assert fantwin("import", tmp_path / "flight.ulg", *words, *volts, "-o", recording).exit_code == 0
    (first, *_) = [entry.message for entry in read_recording(recording)]
    assert isinstance(first, Raw)
    np.testing.assert_allclose(first.supply_voltage_v, [[12.0, 12.1]], rtol=1e-6)
    np.testing.assert_allclose(raw_columns(recording)[2] / RPM, SPEEDS, rtol=1e-12)


def test_electrical_speeds_and_the_tacho_that_is_declared(tmp_path: Path) -> None:
    path, recording = ulog(tmp_path), tmp_path / "r.mcap"
    words = ("--command", "actuator_outputs.output[*]", "--speed", "esc_status.esc[*].esc_rpm:erpm", "-o", recording)
    fantwin("import", path, *words, "--poles", 14, "--tacho", "count:window_s=0.02")
    np.testing.assert_allclose(raw_columns(recording)[2] / RPM, SPEEDS / 7, rtol=1e-12)
    assert read_runs(recording).tacho == (Tacho(kind="count", window_s=0.02),) * 2


@pytest.mark.parametrize("storage", ["sqlite3", "mcap"])
def test_a_ros_bag_with_times_of_its_messages(tmp_path: Path, storage: str) -> None:
    bag, recording = tmp_path / "bag", tmp_path / "r.mcap"
    write_rosbag(bag, 100 + T_S, COMMANDS, SPEEDS, mcap=storage == "mcap")
    words = ("--command", "/fans/command.data[*]", "--speed", "/fans/state.velocity[*]:rad/s", "-o", recording)
    result = fantwin("import", bag, *words, "--json")
    assert result.exit_code == 0, result.output
    summary = json.loads(result.stdout)
    assert (summary["samples"], summary["fans"]) == (200, 2)
    assert summary["notes"] == ["/fans/command: messages without a time of their own; that of the bag is used"]
    t_ns, command, speed_rad_s = raw_columns(recording)
    np.testing.assert_allclose(t_ns / 1e9, 100 + T_S, atol=1e-9)
    np.testing.assert_array_equal(command, COMMANDS)
    np.testing.assert_allclose(speed_rad_s / RPM, SPEEDS, rtol=1e-12)


def test_a_preview_shows_the_fields_with_their_rates_and_the_command_that_imports_the_log(tmp_path: Path) -> None:
    path, field = ulog(tmp_path), "esc_status.esc[1].esc_rpm"
    (shown,) = json.loads(fantwin("import", path, "--preview", "--json").stdout)["files"]
    found = {each["name"]: each for each in shown["columns"]}
    assert (found[field]["values"], found[field]["rate_hz"]) == (200, pytest.approx(50))
    lines = fantwin("import", path, "--preview").stdout.splitlines()
    assert lines[0] == f"{path}: ULog, {len(found)} fields"
    assert any(line.startswith(field) for line in lines)
    assert lines[-1].startswith(f"to import it: fantwin import {path} --command ")
    path.write_bytes(path.read_bytes()[:20])
    assert "this ULog has no fields with numbers; is it damaged?" in error_of("import", path, "--preview")

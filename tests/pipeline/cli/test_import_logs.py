"""`fantwin import` of the logs of other systems: fields by name or pattern become the samples of fans."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.recordings.reading import read_recording
from fantwin.pipeline.recordings.training_runs import read_runs
from fantwin.pipeline.sources.column_file import ColumnFile
from fantwin.pipeline.sources.tables.profiles import profile_of
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
    without = "/fans/command: messages without a time of their own; that of the bag is used"
    never = "/fans/command.data[1] is 0.5 throughout: a twin needs steps of the command"
    assert summary["notes"] == [without, never]
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
    assert lines[0] == f"{path}: PX4: ULog, {len(found)} fields"
    assert any(line.startswith(field) for line in lines)
    assert lines[-1].startswith(f"to import it: fantwin import {path} --command ")
    path.write_bytes(path.read_bytes()[:20])
    said = error_of("import", path, "--preview")
    assert said.endswith("no field with numbers in this ULog: it ends before its data, or has texts only")


ONLINE = ("uint64_t timestamp;uint8_t esc_count;uint8_t esc_online_flags;esc_report[8] esc;",)


def quad(path: Path, *, silent: int = -1, motors: bool = False) -> Path:
    """Four motors in eight slots, 300 samples; the motor `silent` is offline in every tenth. motors: commands of newer
    autopilots, NaN for motors that are not there and, in the last 50 samples, for those that are stopped."""
    commands = np.array([1300.0, 1700.0, 1200.0, 1500.0])[np.arange(300) // 60 % 4]
    escs, outputs = [], []
    for k, command in enumerate(commands):
        off = [m for m in range(4) if m == silent and k % 10 == 0]
        slots = [(0, 0.0) if m >= 4 or m in off else (int(8 * command) - 8000 + m, 23.5) for m in range(8)]
        t_us = 5_000_000 + 100_000 * k
        escs.append((t_us, 4, 15 - sum(1 << m for m in off), *(value for slot in slots for value in slot)))
        told = np.nan if motors and k >= 250 else command
        outputs.append((t_us, *[told] * 4, *[np.nan if motors else 0.0] * 8))
    name = "actuator_motors" if motors else "actuator_outputs"
    field = "control" if motors else "output"
    write_ulog(path, {"esc_status": (*ONLINE, escs), name: (f"uint64_t timestamp;float[12] {field};", outputs)})
    return path


def test_a_px4_log_gives_the_motors_that_are_there_and_no_speed_while_their_esc_is_offline(tmp_path: Path) -> None:
    log, recording = quad(tmp_path / "quad.ulg", silent=2), tmp_path / "r.mcap"
    (shown,) = json.loads(fantwin("import", log, "--preview", "--json").stdout)["files"]
    known = [["--command", "actuator_outputs.output[0]"], ["--speed", "esc_status.esc[0].esc_rpm:rpm"]]
    assert [shown["options"][:2], shown["options"][8:10]] == known
    volts = ("--channel", "supply_voltage_v=esc_status.esc[*].esc_voltage")
    result = json.loads(fantwin("import", log, *volts, "-o", recording, "--json").stdout)
    assert (result["fans"], result["samples"], result["speeds_missing"]) == (4, 300, 30)
    assert any(
        note.startswith("left out, because the speed is always 0 or missing: esc_status") for note in result["notes"]
    )
    silent = (
        "esc_status.esc[2].esc_rpm and 1 more: 60 values left out, where the bit of the motor in esc_status.esc_online"
    )
    assert any(note.startswith(silent) for note in result["notes"])
    speeds = raw_columns(recording)[2]
    assert np.isnan(speeds[::10, 2]).all()
    assert np.isfinite(speeds[:, [0, 1, 3]]).all()
    assert np.nanmin(speeds) > 1000 * RPM


def test_a_motor_that_is_stopped_has_no_command_and_so_no_speed(tmp_path: Path) -> None:
    log, recording = quad(tmp_path / "new.ulg", motors=True), tmp_path / "r.mcap"
    result = json.loads(fantwin("import", log, "-o", recording, "--json").stdout)
    assert (result["fans"], result["speeds_missing"]) == (4, 200)
    speeds = "esc_status.esc[0].esc_rpm and 3 more: 200 values left out"
    stopped = f"{speeds}, where their commands are NaN, as the motors were stopped"
    assert stopped in result["notes"]
    assert np.isnan(raw_columns(recording)[2][250:]).all()


def test_readings_that_a_px4_log_repeats_are_not_taken_for_new_ones(tmp_path: Path) -> None:
    """ESCs that answer in turn: each sample has one new reading, and the old one of the other."""
    outputs, escs, read = [], [], [(0, 0), (0, 0)]
    for k in range(200):
        t_us, command = 1_000_000 + 10_000 * k, 0.2 + 0.1 * (k // 20 % 5)
        read[k % 2] = (t_us - 500, 1000 + 10 * k)
        outputs.append((t_us, command, command))
        escs.append((t_us, *read[0], *read[1]))
    escs[150] = (4_213_092_985_657_280_000, *escs[150][1:])  # a damaged time
    topics = {
        "actuator_outputs": ("uint64_t timestamp;float[2] output;", outputs),
        "esc_status": ("uint64_t timestamp;timed_report[2] esc;", escs),
    }
    write_ulog(tmp_path / "a.ulg", topics)
    result = json.loads(fantwin("import", tmp_path / "a.ulg", "-o", tmp_path / "r.mcap", "--json").stdout)
    repeated = "esc_status.esc[0].esc_rpm and 1 more: 200 values left out, where readings are repeated, by their own"
    assert any(note.startswith(repeated) for note in result["notes"])
    assert any("1 row dropped: the time contradicts the rows around (row 151)" in note for note in result["notes"])
    speeds = raw_columns(tmp_path / "r.mcap")[2] / RPM
    kept = np.delete(np.arange(200), 150)
    for fan in range(2):
        measured = np.isfinite(speeds[:, fan])
        expected = kept[kept % 2 == fan]
        np.testing.assert_array_equal(kept[measured], expected)
        np.testing.assert_allclose(speeds[measured, fan], 1000 + 10 * expected, rtol=1e-9)


def test_a_damaged_log_is_read_as_far_as_possible_and_nothing_else_is_printed(tmp_path: Path) -> None:
    log = quad(tmp_path / "quad.ulg")
    data = bytearray(log.read_bytes())
    data[len(data) // 2 :] = bytes(len(data) - len(data) // 2)
    log.write_bytes(data)
    shown = fantwin("import", log, "--preview")
    assert shown.stdout.startswith(f"{log}: ULog, ")
    assert "corruption" not in shown.output
    assert "the file is damaged: what could be read was read" in shown.stdout


def test_a_command_that_never_changes_is_named_with_its_field_and_later_with_its_fan(tmp_path: Path) -> None:
    times_us = range(0, 3_000_000, 100_000)
    outputs = [(t, 0.1 * (k % 7), 0.5) for k, t in enumerate(times_us)]
    escs = [(t, 100 * (k % 7), 12.0, 3000 + k % 3, 12.0) for k, t in enumerate(times_us)]
    topics = {
        "actuator_outputs": ("uint64_t timestamp;float[2] output;", outputs),
        "esc_status": ("uint64_t timestamp;esc_report[2] esc;", escs),
    }
    write_ulog(tmp_path / "a.ulg", topics)
    result = json.loads(fantwin("import", tmp_path / "a.ulg", "-o", tmp_path / "r.mcap", "--json").stdout)
    assert "actuator_outputs.output[1] is 0.5 throughout: a twin needs steps of the command" in result["notes"]
    for name, *words in (("report",), ("train", "-o", tmp_path / "t.onnx")):
        said = error_of(name, *words, tmp_path / "r.mcap", "--fans", "1-1")
        assert said.splitlines()[-1] == "fan 1: the command never changes; record steps between three levels or more"


@pytest.mark.parametrize(
    ("command", "speed"),
    [
        ("actuator_motors.control[0]", "esc_status.esc[0].esc_rpm"),
        ("actuator_outputs.output[0]", "esc_status.esc[0].esc_rpm"),
        ("/fmu/out/actuator_outputs.output[0]", "/fmu/out/esc_status.esc[0].esc_rpm"),
        ("/uav1/mavros/rc/out.channels[0]", "/uav1/mavros/esc_status.esc_status[0].rpm"),
    ],
)
def test_the_fields_of_motors_are_known_in_logs_and_bags(command: str, speed: str) -> None:
    log = ColumnFile()
    log.names = [speed, "input_rc.values[0]"]
    assert profile_of(log) is None
    log.names = [*log.names, "actuator_outputs.output[0]", command]  # the motors count, where both are there
    known = profile_of(log)
    assert known
    fans = known.fans_in(log)
    assert (fans.command, fans.speed) == ((command,), (speed,))

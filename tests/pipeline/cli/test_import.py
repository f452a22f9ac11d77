"""`fantwin import`: a measured table becomes a recording that holds the same numbers."""

import json
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.recordings.reading import read_metadata, read_recording
from fantwin.pipeline.recordings.training_runs import read_runs
from fantwin.pipeline.replay.resolve_config import default_config, first_raw
from fantwin.schemas.messages import Array
from fantwin.schemas.tacho import Tacho
from fantwin.twin.models.physical import PhysicalModel
from tests.support.fantwin_command import fantwin
from tests.support.twin_files import write_twin
from tests.support.written_recordings import raw_columns


def measured(folder: Path, rows: int = 1234, start_s: float = 0.0) -> tuple[Path, Array]:
    """A table of two fans and its numbers: time, command, two speeds in rpm."""
    rng = np.random.default_rng(3)
    t_s = start_s + np.round(np.cumsum(rng.uniform(0.008, 0.012, rows)), 6)
    values = np.column_stack([t_s, rng.integers(0, 100, rows), rng.normal(3000, 10, (rows, 2)).round(3)])
    path = folder / "measured.csv"
    np.savetxt(path, values, delimiter=",", header="t,u,y1,y2", comments="", fmt="%.6f")
    return path, values


ARGUMENTS = ("--time", "t:s", "--command", "u", "--speed", "y1:rpm", "--speed", "y2:rpm")


def test_the_recording_holds_the_numbers_of_the_table(tmp_path):
    path, values = measured(tmp_path)
    recording = tmp_path / "r.mcap"
    result = fantwin("import", path, *ARGUMENTS, "-o", recording)
    assert result.exit_code == 0
    assert result.stdout.startswith(f"{recording}: 1234 samples of 2 fans over 12.3 s")
    t_ns, command, speed_rad_s = raw_columns(recording)
    np.testing.assert_allclose(t_ns / 1e9, values[:, 0], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(command, values[:, [1, 1]])
    np.testing.assert_allclose(speed_rad_s / (2 * np.pi / 60), values[:, 2:], rtol=1e-14)
    (shown,) = json.loads(fantwin("info", recording, "--json").stdout)["files"]
    assert shown["duration_s"] == pytest.approx(values[-1, 0] - values[0, 0], abs=1e-6), "from the first to the last"


def test_columns_beside_command_and_speed_go_into_the_recording_and_out_into_tables(tmp_path):
    path = tmp_path / "measured.csv"
    rows = [f"{k / 100},{0.5},{100 + k},{99 + k},{12 - k / 1000},{11.5},{'' if k % 2 else 21.5}" for k in range(40)]
    path.write_text("\n".join(["t,u,y1,y2,v1,v2,air", *rows, rows[-1]]) + "\n")
    recording = tmp_path / "r.mcap"
    given = (
        *("--channel", "supply_voltage_v=v1", "--channel", "supply_voltage_v=v2"),
        *("--channel", "temperature_c=air"),
    )
    arguments = ("--time", "t", "--command", "u", "--speed", "y1", "--speed", "y2")
    summary = json.loads(fantwin("import", path, *arguments, *given, "-o", recording, "--json").stdout)
    assert summary["columns"] == ["supply_voltage_v", "temperature_c"]
    assert (summary["repeated"], summary["speeds_missing"]) == (1, 0)
    (run,) = read_runs(recording).runs
    k = np.arange(40)
    np.testing.assert_allclose(
        run.auxiliary["supply_voltage_v"], np.column_stack([12 - k / 1000, 0 * k + 11.5]), rtol=1e-6
    )
    expected = np.where(k % 2, np.nan, 21.5)[:, np.newaxis]
    np.testing.assert_array_equal(run.auxiliary["temperature_c"], np.repeat(expected, 2, axis=1))
    assert fantwin("export", recording, "--to", "csv", "--topic", "raw", "-o", tmp_path / "raw.csv").exit_code == 0
    table = np.genfromtxt(tmp_path / "raw.csv", delimiter=",", names=True)
    np.testing.assert_allclose(table["supply_voltage_v"][1::2], 11.5)
    np.testing.assert_array_equal(np.isnan(table["temperature_c"]), np.repeat(k % 2 == 1, 2))
    assert np.isnan(table["current_a"]).all()


def test_json_output_has_the_counts_and_times_before_zero_are_kept(tmp_path):
    path, values = measured(tmp_path, start_s=-5.0)
    fantwin("import", path, *ARGUMENTS, "-o", tmp_path / "r.mcap")
    np.testing.assert_allclose(raw_columns(tmp_path / "r.mcap")[0] / 1e9, values[:, 0], rtol=0, atol=1e-9)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:100], lines[99], *lines[400:]]) + "\n")
    summary = json.loads(fantwin("import", path, *ARGUMENTS, "-o", tmp_path / "r.mcap", "--force", "--json").stdout)
    assert summary["samples"] == 1234 - 300
    assert (summary["rows"], summary["repeated"], summary["gaps"], summary["fans"]) == (935, 1, 1, 2)
    assert summary["duration_s"] == pytest.approx(values[-1, 0] - values[0, 0])
    assert summary["median_rate_hz"] == pytest.approx(100, rel=0.02)
    assert summary["speed_unit"] == "rpm"


def test_units_that_were_not_given_are_reported_with_their_option(tmp_path):
    path, _ = measured(tmp_path, rows=20)
    words = ("import", path, "--time", "t", "--command", "u", "--speed", "y1", "-o", tmp_path / "r.mcap")
    assumption = (
        "no unit given, times in s and speeds in rad/s assumed; if that is wrong, use for example --time t:ms and "
        "--speed y1:rpm"
    )
    assert fantwin(*words).stdout.splitlines()[1:] == [f"  {assumption}"]
    assert json.loads(fantwin(*words, "--force", "--json").stdout)["assumed"] == assumption


def test_the_recording_has_unit_source_and_tray_in_its_metadata_and_is_the_same_bytes_again(tmp_path):
    path, _ = measured(tmp_path)
    for name in ("r.mcap", "again.mcap"):
        fantwin("import", path, *ARGUMENTS, "-o", tmp_path / name, "--tray", "bench-2")
    assert (tmp_path / "r.mcap").read_bytes() == (tmp_path / "again.mcap").read_bytes()
    head = read_metadata(tmp_path / "r.mcap")
    assert head.speed_unit("bench-2") == "rpm"
    assert head.metadata["source"] == "measured.csv"
    entries = list(read_recording(tmp_path / "r.mcap"))
    assert {entry.key for entry in entries} == {"fantwin/imported/bench-2/raw"}
    assert {entry.message.header.tray for entry in entries} == {"bench-2"}
    assert [entry.message.header.sequence for entry in entries] == list(range(14))


def test_the_tachos_are_in_the_recording_and_in_the_configuration_made_for_it(tmp_path):
    path, _ = measured(tmp_path)
    recording = tmp_path / "r.mcap"
    tachos = ("--tacho", "count:window_s=1,update_s=0.25", "--tacho", "count:window_s=0.5,update_s=0.25")
    assert fantwin("import", path, *ARGUMENTS, *tachos, "-o", recording).exit_code == 0
    expected = tuple(Tacho(kind="count", window_s=window_s, update_s=0.25) for window_s in (1.0, 0.5))
    assert read_runs(recording).tacho == expected
    assert read_runs(recording, fans=[1]).tacho == expected[1:]
    metadata = read_metadata(recording)
    twin = write_twin(tmp_path / "twin.onnx", PhysicalModel(), 2)
    config = default_config(recording, metadata, first_raw([recording], metadata), twin, (), ())
    assert config.tray("tray1").tacho == expected


def test_speeds_that_look_counted_are_pointed_out_unless_they_are_declared_so(tmp_path):
    t_s = np.arange(0.0, 60.0, 0.1)
    rpm = 30.0 * np.rint((1200.0 + 600.0 * np.sin(np.floor(t_s) / 5.0)) / 30.0)
    path = tmp_path / "counted.csv"
    np.savetxt(path, np.column_stack([t_s, rpm, rpm]), delimiter=",", header="t,u,y", comments="")
    arguments = ("import", path, "--time", "t:s", "--command", "u", "--speed", "y:rpm", "-o", tmp_path / "r.mcap")
    result = fantwin(*arguments)
    assert "hint: fan 0: readings are multiples of 30 rpm and change every 1.00 s: a count over 1 s" in result.stderr
    declared = fantwin(*arguments, "--tacho", "count:window_s=1", "--force")
    assert "hint" not in declared.stderr

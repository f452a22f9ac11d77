"""Twins made and calibrated from tables are those that the commands make of the same samples."""

from __future__ import annotations

import json
import warnings
from functools import partial
from pathlib import Path

import pandas as pd
import pytest

import fantwin
from tests.support import fan_data
from tests.support.fan_tables import RPM
from tests.support.fantwin_command import as_typed

train = partial(fantwin.train, iterations=3, networks=1)


def table_of(seed: int, duration_s: float = 30.0) -> pd.DataFrame:
    """One healthy fan, with the commands as percent and the speeds in rpm."""
    run = fan_data.rough_run(seed, duration_s)
    return pd.DataFrame({"time": run.t_s, "command": run.command[:, 0], "speed_rpm": run.speed_rad_s[:, 0] * RPM})


@pytest.fixture(scope="module")
def twin() -> fantwin.Twin:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fantwin.FantwinWarning)
        return train(table_of(1), validate=table_of(2, 10.0), name="own", command_unit="%")


def imported(table: pd.DataFrame, path: Path) -> Path:
    table.to_csv(path.with_suffix(".csv"), index=False)
    words = ("--time", "time:s", "--command", "command", "--speed", "speed_rpm:rpm", "-o", path)
    done = as_typed("import", path.with_suffix(".csv"), *words)
    assert not done.returncode, done.stderr
    return path


def test_a_table_gives_the_twin_that_the_command_makes_of_its_import(twin, tmp_path):
    healthy, held_out = imported(table_of(1), tmp_path / "a.mcap"), imported(table_of(2, 10.0), tmp_path / "b.mcap")
    words = ("--validate", held_out, "--iterations", 3, "--networks", 1, "--command-unit", "%", "--name", "own")
    done = as_typed("train", healthy, *words, "-o", tmp_path / "own.onnx")
    assert not done.returncode, done.stderr
    card = fantwin.load(tmp_path / "own.onnx").card
    for name in ("parameters", "sigma_rad_s", "kind", "command_unit", "speed_range_rad_s", "network", "name"):
        assert getattr(twin.card, name) == getattr(card, name), name
    assert [each.name for each in twin.card.training.data] == ["table-1.mcap"]
    assert repr(twin) == "Twin('own', hybrid, 1 fan, 100 Hz, not calibrated)"
    of_recording = train(healthy, validate=held_out)
    assert of_recording.card.parameters == card.parameters


def test_a_twin_of_one_fan_serves_each_fan_of_a_table(twin):
    run = table_of(3, 20.0)
    both = pd.concat([run.assign(fan="left"), run.assign(fan="right", speed_rpm=run["speed_rpm"] * 1.2)])
    predicted = twin.predict(both)
    left, right = (predicted[predicted["fan"] == fan].reset_index(drop=True) for fan in ("left", "right"))
    assert (left["residual_rpm"].std() < 1.5 * fan_data.NOISE_RAD_S * RPM) and right["residual_rpm"].mean() > 100.0
    alone = twin.predict(run)
    names = ["time", "command", "predicted_rpm", "lower_rpm", "residual_rpm"]
    pd.testing.assert_frame_equal(left[names], alone[names])


def test_calibration_by_tables_is_that_of_the_command(twin, tmp_path):
    tables = [table_of(seed, 10.0) for seed in (4, 5)]
    calibrated = fantwin.calibrate(twin, tables, false_alarms_per_day=8, extrapolate=True)
    file = twin.save(tmp_path / "own.onnx")
    recordings = [imported(table, tmp_path / f"{number}.mcap") for number, table in enumerate(tables)]
    done = as_typed("calibrate", file, *recordings, "--false-alarms-per-day", 8, "--extrapolate")
    assert not done.returncode, done.stderr
    of_command, of_tables = fantwin.load(file).card.calibration, calibrated.card.calibration
    assert of_command and of_tables and not twin.card.calibration
    for name in ("priors", "limit_factor", "fan_hours", "found", "false_alarms_per_day"):
        assert of_tables[name] == of_command[name], name
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not calibrated.score(table_of(6, 10.0))["alarm"].to_numpy().any()


def test_evaluate_is_that_of_the_command_and_data_that_made_the_twin_do_not_test_it(twin, tmp_path):
    table = table_of(7, 20.0)
    found = twin.evaluate(table)
    file, recording = twin.save(tmp_path / "own.onnx"), imported(table, tmp_path / "run.mcap")
    done = as_typed("evaluate", file, recording, "--json")
    assert found == json.loads(done.stdout) == twin.evaluate(recording)
    assert (found["assessment"] != "not tested", found["speed_unit"], len(found["fans"])) == (True, "rpm", 1)
    for made_it, used in (
        (table_of(1), "the table: used in training"),
        (table_of(2, 10.0), "the table: used to choose the model"),
    ):
        judged = twin.evaluate(made_it)
        assert judged["assessment"] != "as declared" and used in judged["warnings"][0], judged["warnings"]
    with pytest.warns(fantwin.FantwinWarning, match="table 1: the twin was trained on it, so its errors are too small"):
        fantwin.calibrate(twin, table_of(1), false_alarms_per_day=8, extrapolate=True)
    assert dir(fantwin) == sorted(fantwin.__all__)


def test_warnings_and_errors_call_fans_as_the_table_does(twin):
    run = table_of(3, 20.0)
    slow = {f"rpm{fan}": run["speed_rpm"] * factor for fan, factor in ((1, 1.0), (2, 0.6))}
    table = pd.DataFrame({"time": run["time"], "command": run["command"], **slow})
    columns = fantwin.Columns(speed="rpm*:rpm")
    with pytest.warns(
        fantwin.FantwinWarning,
        match=r"^table: the twin does not follow fan 2: rmse .* times its sigma: a fault, or not its twin",
    ):
        assert set(twin.alarms(table, columns)["fan"]) == {2}
    found = twin.evaluate(table, columns)
    assert [fan["fan"] for fan in found["fans"]] == [1, 2]
    assert found["headline"].startswith("The twin does not follow fan 2: rmse")
    named = fantwin.Columns(speed={"CPU": "rpm1:rpm", "rear": "rpm2:rpm"})
    assert twin.evaluate(table, named)["headline"].startswith("The twin does not follow rear: rmse")
    with pytest.raises(fantwin.FantwinError, match="^fan 1: fewer than ten measured speeds"):
        fantwin.train(table.assign(rpm1=float("nan")), columns, model="physical")


def test_what_data_do_not_show_is_said_and_what_is_too_little_is_refused(twin):
    with pytest.warns(fantwin.FantwinWarning, match="too short"):
        fantwin.train(table_of(1, 4.0), model="physical")
    with pytest.raises(
        fantwin.FantwinError, match=r"that takes 72; .*, or add `extrapolate=True`: then it is only a target"
    ):
        fantwin.calibrate(twin, table_of(4, 20.0), false_alarms_per_day=1)
    with pytest.raises(fantwin.FantwinError, match="kind 'linear' is unknown; use one of physical"):
        fantwin.train(table_of(1, 20.0), model="linear")
    with pytest.raises(fantwin.FantwinError, match="`tacho` counts: "):
        fantwin.train(table_of(1, 20.0), tacho="counts")


def test_training_and_calibration_show_a_bar_on_a_terminal_and_nothing_in_a_pipe(twin, monkeypatch, capsys):
    def shown() -> str:
        fantwin.train(table_of(1, 4.0), model="physical")
        fantwin.calibrate(twin, table_of(4, 10.0), false_alarms_per_day=8, extrapolate=True)
        return capsys.readouterr().err

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fantwin.FantwinWarning)
        assert shown() == ""
        monkeypatch.setenv("FORCE_COLOR", "1")  # what rich takes for a terminal
        monkeypatch.setenv("TERM", "xterm")
        assert "identification" in (bars := shown()) and "calibrating" in bars

"""Scores of a table are those of an offline replay of the same samples, in the library and the unit of the table."""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

import fantwin
from fantwin import read_arrays
from fantwin.interface.twin import DEMO
from fantwin.pipeline.recordings.reading import read_metadata
from tests.support.fan_tables import RPM, long_table, record, wide_table
from tests.support.fantwin_command import as_typed
from tests.support.made_once import MadeOnce

GOLDEN = Path(__file__).parents[1] / "support" / "data" / "golden.mcap"


@pytest.fixture(scope="module")
def recording(made_once: MadeOnce) -> Path:
    return made_once("fan table", record) / "recorded.mcap"


@pytest.fixture(scope="module")
def wide(recording: Path) -> pd.DataFrame:
    return wide_table(recording)


@pytest.fixture(scope="module")
def twin() -> fantwin.Twin:
    return fantwin.load()


@pytest.fixture(scope="module")
def scored(twin: fantwin.Twin, wide: pd.DataFrame) -> pd.DataFrame:
    return twin.score(wide)


def replayed(recording: Path, twin: Path, folder: Path) -> tuple[dict[str, np.ndarray], list[dict]]:
    """The columns of scores and the alarms of `fantwin replay --offline`."""
    whole = folder / "whole.mcap"
    done = as_typed("replay", recording, "--offline", "--twin", twin, "-o", whole, "--json")
    assert not done.returncode, done.stderr
    blocks = list(read_arrays(whole, "score"))
    names = ("t_ns", "predicted_speed_rad_s", "deviation_rad_s", "score", "state", "valid", "band_variance")
    return {name: np.concatenate([b[name] for b in blocks]) for name in names}, json.loads(done.stdout)["alarms"]


def assert_equal_decisions(table: pd.DataFrame, alarms: pd.DataFrame, of_replay: dict, alarms_of_replay: list) -> None:
    """The table of one tray, its times in s, has what a replay has, whose messages have seven digits."""
    fans = of_replay["score"].shape[1]
    assert (len(table), len(alarms_of_replay)) == (of_replay["score"].size, len(alarms))
    assert np.array_equal(table["time"].to_numpy()[::fans], of_replay["t_ns"] / 1e9)
    for name, other in (("predicted_rpm", "predicted_speed_rad_s"), ("deviation_rpm", "deviation_rad_s")):
        assert np.allclose(
            table[name], of_replay[other].reshape(-1).astype(float) * RPM, rtol=2e-7, atol=2e-3, equal_nan=True
        )
    assert np.array_equal(table["score"].astype(np.float32), of_replay["score"].reshape(-1), equal_nan=True)
    scored = of_replay["valid"].reshape(-1)
    assert np.array_equal(table["score"].notna(), scored) and scored[table["valid"]].all()
    assert set(table.loc[scored & ~table["valid"], "reason"]) <= {"warming_up"}, "by the torque balance alone"
    width = np.sqrt(of_replay["band_variance"].reshape(-1).astype(float)) * RPM
    known = table["predicted_rpm"].notna()
    assert np.allclose((table["upper_rpm"] - table["lower_rpm"])[known], 2 * width[known], rtol=1e-6)
    for row, other in zip(alarms.to_dict("records"), alarms_of_replay, strict=True):
        assert (row["fan"], row["severity"]) == (other["fan"], other["severity"])
        assert (row["raised"], row["onset"]) == (other["raised_ns"] / 1e9, other["onset_ns"] / 1e9)
        assert row["causes"] == [{name: cause[name] for name in ("cause", "probability")} for cause in other["causes"]]


def test_a_table_gets_the_decisions_of_its_import_and_replay(twin, wide, scored, tmp_path):
    wide.to_csv(tmp_path / "table.csv", index=False)
    columns = [word for fan in range(8) for word in ("--command", f"command_{fan}", "--speed", f"speed_{fan}_rpm:rpm")]
    imported = tmp_path / "imported.mcap"
    done = as_typed("import", tmp_path / "table.csv", "--time", "time:s", *columns, "-o", imported)
    assert not done.returncode, done.stderr
    alarms = twin.alarms(wide)
    assert_equal_decisions(scored, alarms, *replayed(imported, DEMO, tmp_path))
    assert list(alarms["fan"]) == [2] and alarms["cause"][0] == "drag_up" and alarms["probability"][0] > 0.9
    assert 11.8 < alarms["onset"][0] < alarms["raised"][0] < 13.0


def test_a_recording_gets_the_decisions_of_its_replay(tmp_path):
    (name,) = (name for name in read_metadata(GOLDEN).attachments if name.endswith(".onnx"))
    (tmp_path / "golden.onnx").write_bytes(read_metadata(GOLDEN).attachments[name])
    twin = fantwin.load(tmp_path / "golden.onnx")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", fantwin.FantwinWarning)
        scores, alarms = twin.score(GOLDEN), twin.alarms(str(GOLDEN))
    of_replay, alarms_of_replay = replayed(GOLDEN, tmp_path / "golden.onnx", tmp_path)
    assert np.array_equal(scores["score"].astype(np.float32), of_replay["score"].reshape(-1), equal_nan=True)
    assert np.array_equal(scores["time"].astype(np.int64), np.repeat(of_replay["t_ns"], 2))
    assert [*alarms["raised"].astype(np.int64)] == [each["raised_ns"] for each in alarms_of_replay]
    assert len(alarms) and set(scores["tray"]) == {"tray1"}


def test_alarm_columns_follow_the_alarms_and_their_causes(twin, wide, scored):
    fan = scored[scored["fan"] == 2]
    (raised,), (cleared,) = twin.alarms(wide)["raised"], twin.alarms(wide)["cleared"]
    is_active = (fan["time"] >= raised) & ~(fan["time"] >= cleared)
    assert (fan["alarm"] == is_active).all() and is_active.any()
    assert (
        set(scored.loc[~scored["alarm"], "cause"]) == {""} and scored.loc[~scored["alarm"], "probability"].isna().all()
    )
    named = fan[fan["alarm"] & (fan["time"] > raised + 5)]
    assert set(named["cause"]) == {"drag_up"} and set(named["severity"]) == {"alarm"}
    assert (fan.loc[fan["alarm"], "state"] != "normal").all() and (scored["limit"] == 1.0).all()


def test_each_library_gets_its_own_table_with_the_same_values(twin, wide, scored):
    short = wide[wide["time"] < 14.0]
    arrays = {name: short[name].to_numpy() for name in short}
    answers = {
        "arrays": pd.DataFrame(twin.score(arrays)),
        "arrow": twin.score(pa.table(arrays)).to_pandas(),
        "long": twin.score(long_table(short)),
        "rows in the order of time": twin.score(long_table(short).sort_values(["time", "fan"])),
    }
    for name, answer in answers.items():
        pd.testing.assert_frame_equal(answer, answers["long"], check_dtype=False, obj=name)
    both = scored[scored["time"] < 10.0].reset_index(drop=True)
    pd.testing.assert_frame_equal(answers["long"].iloc[: len(both)], both)
    assert isinstance(twin.alarms(pa.table(arrays)), pa.Table) and isinstance(twin.score(arrays), dict)
    assert twin.alarms(pa.table(arrays))["causes"].to_pylist() == list(twin.alarms(short)["causes"])


@pytest.mark.parametrize("zone", [None, "Europe/Rome"])
def test_dates_and_names_of_fans_come_back_as_they_were_given(twin, wide, zone):
    short = wide[wide["time"] < 14.0]
    long = long_table(short)
    dates = pd.to_datetime(1_700_000_000_000_000_000 + (long["time"] * 1e9).astype(np.int64)).dt.tz_localize(zone)
    long = long.assign(time=dates, fan="fan of rack " + long["fan"].astype(str))
    answer, alarms = twin.score(long), twin.alarms(long)
    assert answer["time"].dtype == alarms["raised"].dtype == "datetime64[ns]" if zone is None else answer["time"].dt.tz
    assert answer["time"].min() - dates.min() < pd.Timedelta("50ms") and set(answer["fan"]) == set(long["fan"])
    assert list(alarms["fan"]) == ["fan of rack 2"] and alarms["cleared"].isna().all()
    indexed = twin.score(long.set_index("time"))
    pd.testing.assert_frame_equal(indexed, answer)


def test_other_units_and_names_say_the_same(twin, wide):
    short = wide[wide["time"] < 3.0]
    renamed = {"ms": short["time"] * 1e3} | {f"pwm{fan}": short[f"command_{fan}"] for fan in range(8)}
    renamed |= {f"tacho{fan}": short[f"speed_{fan}_rpm"] / 60.0 for fan in range(8)}
    columns = fantwin.Columns(time="ms:ms", command="pwm*", speed="tacho*:hz")
    answer, usual = twin.score(pd.DataFrame(renamed), columns), twin.score(short)
    assert np.allclose(answer["predicted_hz"] * 60.0, usual["predicted_rpm"], equal_nan=True)
    assert np.allclose(answer["score"], usual["score"], rtol=1e-5, equal_nan=True)
    by_name = fantwin.Columns(
        "ms:ms",
        command={f"F{fan}": f"pwm{fan}" for fan in range(8)},
        speed={f"F{fan}": f"tacho{fan}:hz" for fan in range(8)},
    )
    assert set(twin.predict(pd.DataFrame(renamed), by_name)["fan"]) == {f"F{fan}" for fan in range(8)}


def test_a_prediction_without_measured_speeds_is_the_free_run_of_the_twin(twin, wide):
    commands = {"time": [0.0, 1.0, 2.0], "command": [0.4, 0.4, 0.8]}
    one = twin.predict(commands, initial_speed_rpm=3000.0)
    assert one["time"][-1] == 2.0 and len(one["time"]) == 201 * 8 and "speed_rpm" not in one
    assert one["predicted_rpm"][:8] == pytest.approx(3000.0)
    steady = {name: np.linspace(0.0, 10.0, 11) if name == "time" else np.full(11, 0.4) for name in commands}
    settled = twin.predict(steady, initial_speed_rpm=3000.0)["predicted_rpm"][-8:]
    again = twin.predict(steady, initial_speed_rpm=settled)
    assert np.allclose(again["predicted_rpm"][:8], settled) and np.allclose(
        again["predicted_rpm"][-8:], settled, rtol=1e-3
    )
    assert np.allclose(again["upper_rpm"][-8:] - settled, 2 * np.array(twin.card.sigma_rad_s) * RPM, rtol=0.02)


def test_a_twin_loads_and_saves_without_the_pipeline_or_a_runtime(twin, tmp_path):
    assert fantwin.load(twin.save(tmp_path / "copy.onnx")).content == DEMO.read_bytes()
    assert repr(twin) == "Twin('demo tray', hybrid, 8 fans, 100 Hz, calibrated)"
    assert str(twin.card).startswith("demo tray: hybrid twin of 8 fans, 100 Hz\n") and "rmse_rpm" in str(twin.card)
    assert fantwin.__version__ == version("fantwin")
    code = (
        "import sys, fantwin; fantwin.load(); "
        "print({'zenoh', 'scipy', 'onnxruntime', 'pandas', 'torch'} & {*sys.modules})"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "set()\n"

"""A table that cannot be right is refused in one line; what is repaired in another is said."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

import fantwin
from tests.support.fan_tables import long_table

BOARD = Path(__file__).parents[1] / "support" / "data" / "fan_board.onnx"


@pytest.fixture(scope="module")
def twin() -> fantwin.Twin:
    return fantwin.load()


@pytest.fixture(scope="module")
def wide(twin: fantwin.Twin) -> pd.DataFrame:
    """Healthy fans without noise for eight seconds."""
    t_s = np.arange(0.0, 8.0, 0.01)
    command = np.where(t_s < 1.0, 0.5, 0.8)
    run = twin.predict({"time": t_s, "command": command}, initial_speed_rpm=4000.0)
    speed = run["predicted_rpm"].reshape(-1, 8)
    columns = {f"command_{fan}": command for fan in range(8)} | {f"speed_{fan}_rpm": speed[:, fan] for fan in range(8)}
    return pd.DataFrame({"time": t_s} | columns)


def renamed(table: pd.DataFrame, old: str, new: str) -> pd.DataFrame:
    return table.rename(columns=lambda name: name.replace(old, new))


def scaled(table: pd.DataFrame, part: str, factor: float) -> pd.DataFrame:
    return table.assign(**{name: table[name] * factor for name in table if part in name})


def moved(table: pd.DataFrame, row: int, by_s: float) -> pd.DataFrame:
    return table.assign(time=table["time"].where(table.index != row, table["time"] + by_s))


REFUSED: dict[str, tuple[Callable[[pd.DataFrame], object], str]] = {
    "no table": (lambda _: [1, 2], "a table is a pandas DataFrame, a pyarrow Table or a dict of arrays"),
    "no rows": (lambda table: table[:0], "the table has no rows"),
    "unequal columns": (
        lambda table: {"time": [0, 1], "command": [1]},
        "columns of different shapes, time (2,), command",
    ),
    "no time": (lambda table: table.drop(columns="time"), "no column of the time"),
    "no command": (lambda table: table[[name for name in table if "command" not in name]], "no column `command`"),
    "no speed": (lambda table: table[[name for name in table if "speed" not in name]], "no column of the speed"),
    "one command too few": (lambda table: table.drop(columns="command_3"), "fan 3 has a speed and no command"),
    "no unit": (lambda table: pd.DataFrame({"time": table["time"], "command": 0.5, "speed": 4e3}), "in which unit"),
    "a fan too few": (lambda table: table.drop(columns="speed_7_rpm"), "has 7 fan(s), and the twin is of 8"),
    "rpm as rad/s": (lambda table: renamed(table, "rpm", "rad_s"), "the fans of the twin reach 964"),
    "hz as rpm": (lambda table: scaled(table, "speed", 1 / 60), "has speeds in hz, not in rpm"),
    "rad/s as rpm": (lambda table: scaled(table, "speed", np.pi / 30), "has speeds in rad/s, not in rpm"),
    "percent": (lambda table: scaled(table, "command", 100.0), "commands up to 80, and the twin was trained"),
    "share of percent": (lambda table: scaled(table, "command", 0.01), "commands up to 0.008, and the twin"),
    "ms as s": (lambda table: scaled(table, "time", 1e3), "a sample every 10 s, and the twin was trained on one every"),
    "s as ms": (lambda table: table.rename(columns={"time": "t_ms"}), "a sample every 1e-05 s"),
    "ns as s": (lambda table: table.assign(time=1.7e18 + table["time"]), "is beyond the year 2116"),
    "text": (lambda table: table.assign(time=table["time"].astype(str) + " s"), "column 'time' must hold numbers"),
    "backwards": (lambda table: table[::-1], "time goes back by"),
    "no fan": (lambda table: long_table(table).assign(fan=np.nan), "the number or the name of a fan in each row"),
    "interleaved": (
        lambda table: (long := long_table(table)).assign(time=long["time"] + 1e-4 * long["fan"]),
        "the fans of 'fan' were measured at different times",
    ),
    "one fan in disorder": (
        lambda table: pd.concat([(long := long_table(table))[:50], long[10:]]),
        "the time of fan 0 goes back or repeats at its sample 50",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_table_that_cannot_be_right_is_refused_in_one_line(twin, wide, case):
    change, words = REFUSED[case]
    with pytest.raises(fantwin.FantwinError, match=re.escape(words)) as refusal:
        twin.score(change(wide))
    assert "\n" not in str(refusal.value) and "--" not in str(refusal.value) and "/tmp" not in str(refusal.value)


REPAIRED: dict[str, tuple[Callable[[pd.DataFrame], Any], str]] = {
    "out of order": (lambda table: moved(table, 7, 0.015), "1 rows out of order, sorted by time"),
    "twice": (lambda table: pd.concat([table[:9], table[8:]]), "1 rows with the time of another, merged"),
    "no time": (lambda table: moved(table, 5, np.nan), "1 rows dropped: their time cannot be read"),
    "no speed": (
        lambda table: table.assign(speed_3_rpm=table["speed_3_rpm"].where(table.index != 150)),
        "1 cells without",
    ),
    "infinite": (lambda table: table.assign(command_2=table["command_2"].where(table.index != 9, np.inf)), "is held"),
    "short": (lambda table: table[:20], "no sample could be scored (of fans: 160 warming up)"),
}


@pytest.mark.parametrize("case", REPAIRED)
def test_what_is_repaired_or_left_out_is_said_at_the_line_of_the_caller(twin, wide, case):
    change, words = REPAIRED[case]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        answer = twin.score(change(wide))
    (line,) = said
    assert line.category is fantwin.FantwinWarning and words in str(line.message) and line.filename == __file__
    assert list(answer["valid"] == (answer["reason"] == "")) == [True] * len(answer)
    known = answer[["speed_rpm", "predicted_rpm", "residual_rpm", "score"]].notna().all(axis=1)
    assert known[answer["valid"]].all()


def test_missing_values_of_each_library_are_missing_speeds(twin, wide):
    without = wide["speed_3_rpm"].where(wide.index % 7 > 0)
    tables = (
        wide.assign(speed_3_rpm=without.astype("Float64")),
        wide.assign(speed_3_rpm=without.astype(object).where(without.notna(), None)),
        pa.table({name: wide[name] for name in wide} | {"speed_3_rpm": pa.array(without, from_pandas=True)}),
        {name: wide[name] for name in wide} | {"speed_3_rpm": np.ma.masked_invalid(without)},
    )
    with pytest.warns(fantwin.FantwinWarning, match="115 cells without a speed, not filled"):
        answers = [pd.DataFrame(twin.score(each)["score"]) for each in tables[:2]]
        answers += [pd.DataFrame({"score": np.asarray(twin.score(each)["score"])}) for each in tables[2:]]
    for answer in answers[1:]:
        pd.testing.assert_frame_equal(answer, answers[0])


def test_files_and_arguments_that_cannot_be_used_are_refused(twin, wide, tmp_path):
    (tmp_path / "text.onnx").write_text("no twin")
    attempts = {
        "there is no such file": lambda: fantwin.load(tmp_path / "none.onnx"),
        "not an ONNX file; make a twin: fantwin.train": lambda: fantwin.load(tmp_path / "text.onnx"),
        "not a recording (MCAP)": lambda: twin.score(tmp_path / "text.onnx"),
        "cannot be written": lambda: twin.save("/dev/null/fan.onnx"),
        "false_alarms_per_day = 0.0 cannot be used: input should be greater than 0": lambda: twin.score(
            wide, false_alarms_per_day=0.0
        ),
        "false_alarms_per_day = '1' cannot be used: input should be a valid number": lambda: twin.alarms(
            wide, false_alarms_per_day="1"
        ),
        "false_alarms_per_day = -1 cannot be used": lambda: fantwin.calibrate(twin, wide, false_alarms_per_day=-1),
        "networks = 0 cannot be used: input should be greater": lambda: fantwin.train(wide, networks=0),
        "the list of tables is empty": lambda: fantwin.train([]),
        "columns must be fantwin.Columns": lambda: twin.predict(wide, {"command": "pwm"}),
        "must be a speed, or 8 speeds, not 'fast'": lambda: twin.predict(
            {"t": [0, 1], "command": [1, 1]}, initial_speed_rpm="fast"
        ),
        "initial_speed_rpm = 1000000.0: the twin knows 0 to": lambda: twin.predict(
            {"t": [0, 1], "command": [1, 1]}, initial_speed_rpm=1e6
        ),
        "leave out initial_speed_rpm": lambda: twin.predict(wide, initial_speed_rpm=1.0),
        "initial_speed_rpm must be a speed, or 8": lambda: twin.predict(
            {"t": [0, 1], "command": [1, 1]}, initial_speed_rpm=[1]
        ),
        "did you mean 'command_1'": lambda: twin.score(wide, fantwin.Columns(command="comand_1")),
        "unknown unit 'knots'": lambda: twin.score(wide, fantwin.Columns(speed="speed_0_rpm:knots")),
    }
    for words, attempt in attempts.items():
        with pytest.raises(fantwin.FantwinError, match=re.escape(words)):
            attempt()


def test_a_twin_that_is_not_calibrated_says_so():
    twin = fantwin.load(BOARD)
    t_s = np.arange(0.0, 2.0, 0.02)
    run = twin.predict({"time": t_s, "command": np.full(100, 0.6)}, initial_speed_rpm=4000.0)
    speed = run["predicted_rpm"].reshape(-1, 4)
    table = {"time": t_s, "command": np.full(100, 0.6)} | {f"speed_{fan}_rpm": speed[:, fan] for fan in range(4)}
    with pytest.warns(fantwin.FantwinWarning, match="is not calibrated: its alarms are by the priors of a population"):
        twin.score(table)

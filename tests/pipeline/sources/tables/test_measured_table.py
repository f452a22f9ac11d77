"""Measured tables: the rows of real files are read, repaired and counted."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.imported_file import read_file
from fantwin.pipeline.sources.tables import table_file
from fantwin.pipeline.sources.tables.measured_table import Table
from fantwin.pipeline.sources.wanted import Wanted

RPM = 2 * np.pi / 60
UNITS = {"rad/s": 1.0, "rpm": RPM, "hz": 2 * np.pi, "deg/s": np.pi / 180}


def table(
    tmp_path: Path, text: str | bytes, time: str | None = "t", command=("u",), speed=("y",), period=None
) -> Table:
    path = tmp_path / "measured.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_file(path, Wanted(command, speed, time, period))


PLAIN = "t,u,y\n0,1,10\n1,2,20\n"
ROWS = ([0, 1], [1, 2], [10, 20])
"""times (s), commands and speeds of most of the tables below"""
NAN = np.nan
TWO, SHARED = "t,u1,y1,u2,y2\n0,1,10,2,20\n1,3,30,4,40\n", "t,u,y1,y2\n0,1,10,20\n1,2,40,50\n"
UNMEASURED = "t,u,y\n0,1,10\n1,1,\n2,1,nan\n3,1,inf\n4,1,oops\n5,1\n"
TABLES = {
    "plain": (PLAIN, {}, *ROWS),
    "semicolons": ("t;u;y\n0;1;10\n1;2;20\n", {}, *ROWS),
    "decimal commas": ("t;u;y\n0,5;1,25;10\n1,5;2;20,75\n", {}, [0.5, 1.5], [1.25, 2], [10, 20.75]),
    "tabs in UTF-16": (PLAIN.replace(",", "\t").encode("utf-16"), {}, *ROWS),
    "byte order mark and blanks": ("\ufefft, u ,  y\n 0 , 1,10 \n1,2, 20\n", {}, *ROWS),
    "quoted cells": ('"t, s","u","y"\n"0","1","10"\n"1","2","20"\n', {"time": "t, s"}, *ROWS),
    "empty lines": (PLAIN.replace("\n", "\n\n"), {}, *ROWS),
    "rows without a time": ("t,u,y\n0,1,10\n,2,20\n?,3,30\n1,2,20\n1e305,1,10\n", {}, *ROWS),
    "mean speed, last command": (
        "t,u,y\n0,1,10\n1,2,20\n1,3,30\n1,4,\n2,5,50\n",
        {},
        [0, 1, 2],
        [1, 4, 5],
        [10, 25, 50],
    ),
    "slightly out of order": ("t,u,y\n0,1,10\n0.2,3,30\n0.1,2,20\n", {}, [0, 0.1, 0.2], [1, 2, 3], [10, 20, 30]),
    "commands are held": ("t,u,y\n0,,10\n1,5,20\n2,,30\n3,7,40\n", {}, [1, 2, 3], [5, 5, 7], [20, 30, 40]),
    "speeds stay missing": (UNMEASURED, {}, [*range(6)], [1] * 6, [10, *[NAN] * 5]),
    "two fans": (TWO, {"command": ("u1", "u2"), "speed": ("y1", "y2")}, [0, 1], [[1, 2], [3, 4]], [[10, 20], [30, 40]]),
    "patterns": (TWO, {"command": ("u*",), "speed": ("y{fan}",)}, [0, 1], [[1, 2], [3, 4]], [[10, 20], [30, 40]]),
    "one command": (SHARED, {"speed": ("y1", "y2")}, [0, 1], [[1, 1], [2, 2]], [[10, 20], [40, 50]]),
    "periods": ("u,y\n1,10\n2,20\n", {"time": None, "period": "0.5 s"}, [0, 0.5], *ROWS[1:]),
    "a colon in a name": (PLAIN.replace("t,", "t:ms,"), {"time": "t:ms:ms"}, [0, 1e-3], *ROWS[1:]),
    "us": (PLAIN, {"time": "t:us"}, [0, 1e-6], *ROWS[1:]),
    **{unit: (PLAIN, {"speed": [f"y:{unit}"]}, *ROWS[:2], [10 * x, 20 * x]) for unit, x in UNITS.items()},
}


@pytest.mark.parametrize(("text", "arguments", "t_s", "command", "speed_rad_s"), TABLES.values(), ids=TABLES)
def test_a_table_is_read_and_repaired(tmp_path, text, arguments, t_s, command, speed_rad_s):
    read = table(tmp_path, text, **arguments)
    np.testing.assert_array_equal(read.t_ns, np.round(np.multiply(t_s, 1e9)))
    np.testing.assert_array_equal(read.command, np.reshape(command, (len(t_s), -1)))
    np.testing.assert_allclose(read.speed_rad_s, np.reshape(speed_rad_s, (len(t_s), -1)), rtol=1e-14)


def test_a_file_that_is_missing_or_has_no_end_of_line_or_whose_times_go_back_is_a_one_line_error(tmp_path):
    with pytest.raises(UserError, match=r"nowhere\.csv: cannot be read: No such file"):
        read_file(tmp_path / "nowhere.csv", Wanted(["u"], ["y"], "t"))
    with pytest.raises(UserError, match=r"\.csv: not a text file with columns: a line is longer than 1,048,576"):
        table(tmp_path, "t,u,y\n" + 600_000 * "1,")
    with pytest.raises(UserError, match=r"goes back by 5\.000 s at row 9, from 7\.000 s to 2\.000 s: the clock was"):
        table(tmp_path, "t,u,y\n" + "".join(f"{t},1,10\n" for t in (*range(8), *range(2, 12))))


def test_repairs_and_gaps_are_counted_and_said(tmp_path):
    repairs = table(tmp_path, "t,u,y\n0,,1\n1,1,10\n1,2,20\n1,3,\n3,,30\n2.5,2,30\n?,1,1\n").repairs
    assert (repairs.rows, repairs.repeated, repairs.out_of_order, repairs.without_time) == (7, 2, 1, 1)
    assert (repairs.speeds_missing, repairs.before_command, repairs.commands_held) == (1, 1, 1)
    rows = "".join(f"{t:.2f},1,10\n" for t in (*np.arange(0, 1, 0.01), *np.arange(3, 4, 0.01)))
    read = table(tmp_path, "t,u,y\n" + rows)
    assert (read.gaps, len(read.t_ns)) == (1, 200)
    coarse = table(tmp_path, "t,u,y\n" + "".join(f"{k // 10},1,{k}\n" for k in range(40)))
    assert any("too coarse" in note for note in coarse.notes)


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("2019-11-05 17:14:08:947", "2019-11-05 17:14:08:952"),
        ("1572974048947000000", "1572974048952000000"),
        ("2019-11-05T17:14:08.947Z", "2019-11-05T17:14:08.952Z"),
        ("2019-11-05T18:14:08.947+01:00", "2019-11-05T18:14:08.952+01:00"),
        ('"2019-11-05 17:14:08,947"', '"2019-11-05 17:14:08,952"'),
    ],
)
def test_dates_are_recognised_and_read_as_utc_and_nanoseconds_since_1970_are_not_rounded(tmp_path, first, second):
    time = "t:ns" if first.isdecimal() else "t"
    read = table(tmp_path, f"t,u,y\n{first},1,10\n{second},2,20\n", time=time)
    assert read.t_ns.tolist() == [1_572_974_048_947_000_000, 1_572_974_048_952_000_000]


def test_dates_and_periods_need_no_unit_and_a_name_with_blanks_is_quoted(tmp_path):
    dates = "t,u,y\n2019-11-05 17:14:08,1,10\n2019-11-05 17:14:09,2,20\n"
    zone = "dates of 't' have no time zone: UTC assumed; --zone Europe/Berlin names one"
    assert table(tmp_path, dates, speed=["y:rpm"]).notes == (zone,)
    assert table(tmp_path, dates.replace("08,", "08Z,").replace("09,", "09Z,"), speed=["y:rpm"]).notes == ()
    read = table(tmp_path, "the u,the y\n1,10\n2,20\n", None, ["the u"], ["the y"], "10ms")
    assert (
        read.assumed == "no unit given, speeds in rad/s assumed; if that is wrong, use for example --speed 'the y:rpm'"
    )


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "must name the columns"),
        ("t,u,y\n", "has no times|has no numbers|fewer than two"),
        ("t,u,y\n0,1,10\n", "fewer than two"),
        ("t,u,y\nthen,1,10\nnow,1,10\n", "has no times in iso, but for example 'then'"),
        ("t,u,y\n0,1,fast\n1,1,slow\n", "'y' has no numbers, but 2 cells with text .*first 'fast'"),
        (b"not MATLAB's MAT-file\0\0\0\1", "not a text file with columns"),
    ],
)
def test_a_file_that_is_not_a_measured_table_is_a_one_line_error(tmp_path, content, expected):
    with pytest.raises(UserError, match=expected) as raised:
        table(tmp_path, content)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(("unit", "finer"), [(":s", "ms"), (":ms", "us")])
def test_times_read_in_too_large_a_unit_are_an_error_that_names_the_unit_to_try(tmp_path, unit, finer):
    t = f"1700000000123{'' if finer == 'ms' else '000'}.5"
    with pytest.raises(UserError, match=rf"beyond the year 2116: is it in ms, us or ns\? use --time t:{finer}"):
        table(tmp_path, f"t,u,y\n{t},1,10\n{t},2,20\n", time=f"t{unit}")


@pytest.mark.parametrize(
    "text",
    [
        "t,u,y\n,1,5\n0,,10\nx,1,5\n0.01,2,20\n\n0.03,,30\n0.03,3,\n0.02,4,40\n",
        "t,u,y\n,1,5\n2024-05-01 10:00:00,1,10\n2024-05-01 10:00:01,2,20\n",
    ],
)
def test_row_17_a_table_read_in_parts_is_the_same(tmp_path, monkeypatch, text):
    whole = table(tmp_path, text)
    monkeypatch.setattr(table_file, "_ROWS_IN_PART", 1)
    pieces = table(tmp_path, text)
    for name in ("t_ns", "command", "speed_rad_s"):
        np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name))
    assert (pieces.repairs, pieces.assumed) == (whole.repairs, whole.assumed)


def test_row_17_a_table_needs_little_more_memory_than_its_file(tmp_path):
    path = tmp_path / "long.csv"
    path.write_text(
        "t,u,y,text\n" + "".join(f"{k * 0.01:.2f},{k % 40},{k % 777:.3f},not needed\n" for k in range(30_000))
    )
    tracemalloc.start()
    try:
        read_file(path, Wanted(["u"], ["y:rpm"], "t:s"))
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 5 * path.stat().st_size


@pytest.mark.parametrize("period", ["2d", "90000s", "99999999999999999999s", "86400s"])
def test_row_15_a_period_without_measure_is_refused(tmp_path, monkeypatch, period):
    monkeypatch.setattr(table_file, "FURTHEST_T_NS", 100_000 * 10**9)
    with pytest.raises(UserError, match=f"--period {period}: "):
        table(tmp_path, "u,y\n" + 5 * "1,2\n", time=None, period=period)

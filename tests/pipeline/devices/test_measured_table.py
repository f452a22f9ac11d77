"""Measured tables: the rows of real files are read, repaired and counted."""

import csv
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from pipeline.devices import measured_table
from pipeline.devices.measured_table import Table, read_table
from pipeline.errors import UserError

RPM = 2 * np.pi / 60


def table(
    tmp_path: Path, text: str | bytes, time: str | None = "t", command=("u",), speed=("y",), period=None
) -> Table:
    path = tmp_path / "measured.csv"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_table(path, time, command, speed, period=period)


def test_a_plain_table_is_read_unchanged(tmp_path):
    read = table(tmp_path, "t,u,y\n0,1,10\n0.01,2,20\n0.03,3,30\n")
    assert read.t_ns.tolist() == [0, 10_000_000, 30_000_000]
    assert read.command.tolist() == [[1.0], [2.0], [3.0]]
    assert read.speed_rad_s.tolist() == [[10.0], [20.0], [30.0]]
    assert read.notes == ()
    assert (read.fans, read.duration_s, read.median_period_s, read.gaps) == (1, 0.03, 0.015, 0)


@pytest.mark.parametrize(
    ("unit", "factor"), [("", 1.0), ("rad/s", 1.0), ("rpm", RPM), ("hz", 2 * np.pi), ("deg/s", np.pi / 180)]
)
def test_speeds_become_radians_a_second(tmp_path, unit, factor):
    read = table(tmp_path, "t,u,y\n0,1,10\n1,2,20\n", speed=[f"y:{unit}" if unit else "y"])
    np.testing.assert_allclose(read.speed_rad_s[:, 0], [10 * factor, 20 * factor])
    assert read.speed_unit == (unit or "rad/s")


@pytest.mark.parametrize(("unit", "ns"), [("s", 10**9), ("ms", 10**6), ("us", 10**3), ("ns", 1)])
def test_times_become_nanoseconds(tmp_path, unit, ns):
    read = table(tmp_path, "t,u,y\n5,1,10\n7,2,20\n", time=f"t:{unit}")
    assert read.t_ns.tolist() == [5 * ns, 7 * ns]


def test_nanoseconds_since_1970_are_not_rounded(tmp_path):
    read = table(tmp_path, "t,u,y\n1700000000123456789,1,10\n1700000000123456790,2,20\n", time="t:ns")
    assert read.t_ns.tolist() == [1700000000123456789, 1700000000123456790]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("2019-11-05 17:14:08:947", "2019-11-05 17:14:08:952"),
        ("2019-11-05 17:14:08.947", "2019-11-05 17:14:08.952"),
        ("2019-11-05T17:14:08.947Z", "2019-11-05T17:14:08.952Z"),
        ("2019-11-05T18:14:08.947+01:00", "2019-11-05T18:14:08.952+01:00"),
        ('"2019-11-05 17:14:08,947"', '"2019-11-05 17:14:08,952"'),
    ],
)
@pytest.mark.parametrize("time", ["t", "t:iso"])
def test_dates_are_recognised_and_read_as_utc(tmp_path, first, second, time):
    read = table(tmp_path, f"t,u,y\n{first},1,10\n{second},2,20\n", time=time)
    assert read.t_ns.tolist() == [1_572_974_048_947_000_000, 1_572_974_048_952_000_000]


def test_a_byte_order_mark_and_stray_blanks_do_not_hide_columns(tmp_path):
    read = table(tmp_path, "\ufefft, u ,  y\n 0 , 1,10 \n1,2, 20\n")
    assert read.speed_rad_s.tolist() == [[10.0], [20.0]]


def test_a_table_in_utf_16_is_read(tmp_path):
    read = table(tmp_path, "t\tu\ty\n0\t1\t10\n1\t2\t20\n".encode("utf-16"))
    assert read.speed_rad_s.tolist() == [[10.0], [20.0]]


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_commas_semicolons_and_tabs_separate_columns(tmp_path, delimiter):
    read = table(tmp_path, "t,u,y\n0,1,10\n1,2,20\n".replace(",", delimiter))
    assert read.command.tolist() == [[1.0], [2.0]]


def test_decimal_commas_are_read_where_semicolons_separate_columns(tmp_path):
    read = table(tmp_path, "t;u;y\n0,5;1,25;10\n1,5;2;20,75\n")
    assert read.t_ns.tolist() == [500_000_000, 1_500_000_000]
    assert read.command.tolist() == [[1.25], [2.0]]
    assert read.speed_rad_s.tolist() == [[10.0], [20.75]]


def test_rows_with_the_same_time_become_their_mean_speed_and_last_command(tmp_path):
    read = table(tmp_path, "t,u,y\n0,1,10\n1,2,20\n1,3,30\n1,4,\n2,5,50\n")
    assert read.t_ns.tolist() == [0, 1_000_000_000, 2_000_000_000]
    assert read.speed_rad_s.tolist() == [[10.0], [25.0], [50.0]]
    assert read.command.tolist() == [[1.0], [4.0], [5.0]]
    assert read.repairs.repeated == 2
    assert "2 rows with the time of another" in read.notes[0]


def test_a_time_column_that_is_too_coarse_is_reported(tmp_path):
    rows = "".join(f"{k // 10},1,{k}\n" for k in range(40))
    read = table(tmp_path, "t,u,y\n" + rows)
    assert any("too coarse" in note for note in read.notes)


def test_rows_slightly_out_of_order_are_sorted_and_counted(tmp_path):
    read = table(tmp_path, "t,u,y\n0,1,10\n0.2,3,30\n0.1,2,20\n0.3,4,40\n")
    assert read.t_ns.tolist() == [0, 100_000_000, 200_000_000, 300_000_000]
    assert read.command[:, 0].tolist() == [1, 2, 3, 4]
    assert read.repairs.out_of_order == 1


def test_a_clock_that_was_set_back_is_refused_with_its_row(tmp_path):
    with pytest.raises(UserError, match=r"goes back by 5\.000 s at row 3"):
        table(tmp_path, "t,u,y\n0,1,10\n6,2,20\n1,3,30\n7,4,40\n")


def test_gaps_are_counted_and_not_filled(tmp_path):
    rows = "".join(f"{t:.2f},1,10\n" for t in (*np.arange(0, 1, 0.01), *np.arange(3, 4, 0.01)))
    read = table(tmp_path, "t,u,y\n" + rows)
    assert (read.gaps, len(read.t_ns)) == (1, 200)


def test_speeds_that_were_not_measured_stay_missing(tmp_path):
    read = table(tmp_path, "t,u,y\n0,1,10\n1,1,\n2,1,nan\n3,1,inf\n4,1,oops\n5,1\n6,1,70\n")
    np.testing.assert_array_equal(read.speed_rad_s[:, 0], [10, *[np.nan] * 5, 70])
    assert read.repairs.speeds_missing == 5


def test_a_missing_command_is_held_and_rows_before_the_first_are_dropped(tmp_path):
    read = table(tmp_path, "t,u,y\n0,,10\n1,5,20\n2,,30\n3,7,40\n")
    assert read.t_ns.tolist() == [1_000_000_000, 2_000_000_000, 3_000_000_000]
    assert read.command[:, 0].tolist() == [5, 5, 7]
    assert (read.repairs.before_command, read.repairs.commands_held) == (1, 1)


def test_rows_whose_time_cannot_be_read_are_dropped_and_counted(tmp_path):
    read = table(tmp_path, "t,u,y\n0,1,10\n,2,20\n?,3,30\n1,4,40\n")
    assert read.command[:, 0].tolist() == [1, 4]
    assert read.repairs.without_time == 2


def test_empty_lines_are_not_rows(tmp_path):
    assert table(tmp_path, "t,u,y\n0,1,10\n\n1,2,20\n\n").repairs.rows == 2


def test_several_fans_have_a_command_each(tmp_path):
    read = table(tmp_path, "t,u1,y1,u2,y2\n0,1,10,2,20\n1,3,30,4,40\n", command=("u1", "u2"), speed=("y1", "y2"))
    assert read.command.tolist() == [[1, 2], [3, 4]]
    assert read.speed_rad_s.tolist() == [[10, 20], [30, 40]]


def test_several_fans_may_share_one_command(tmp_path):
    read = table(tmp_path, "t,u,y1,y2,y3\n0,1,10,20,30\n1,2,40,50,60\n", speed=("y1", "y2", "y3"))
    assert read.command.tolist() == [[1, 1, 1], [2, 2, 2]]


@pytest.mark.parametrize(("period", "period_ns"), [("10ms", 10**7), ("0.5 s", 5 * 10**8), ("2us", 2000)])
def test_a_table_without_times_counts_periods_from_zero(tmp_path, period, period_ns):
    read = table(tmp_path, "u,y\n1,10\n2,20\n3,30\n", time=None, period=period)
    assert read.t_ns.tolist() == [0, period_ns, 2 * period_ns]


def test_dates_and_periods_need_no_unit_and_a_name_with_blanks_is_quoted(tmp_path):
    dates = "t,u,y\n2019-11-05 17:14:08,1,10\n2019-11-05 17:14:09,2,20\n"
    assert table(tmp_path, dates, speed=["y:rpm"]).assumed == ""
    read = table(tmp_path, "the u,the y\n1,10\n2,20\n", None, ["the u"], ["the y"], "10ms")
    assert (
        read.assumed == "no unit given, speeds in rad/s assumed; if that is wrong, use for example --speed 'the y:rpm'"
    )


def test_a_column_whose_name_has_a_colon_is_found(tmp_path):
    read = table(tmp_path, "t:ms,u,motor:speed\n0,1,10\n1,2,20\n", time="t:ms:ms", speed=("motor:speed:rpm",))
    assert read.t_ns.tolist() == [0, 1_000_000]
    np.testing.assert_allclose(read.speed_rad_s[:, 0], [10 * RPM, 20 * RPM])


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ({"time": "T1me"}, "no column 'T1me'"),
        ({"speed": ("speeed",)}, r"no column 'speeed'; it has t, u, y"),
        ({"time": "tt"}, "did you mean 't'"),
        ({"speed": ("y:rmp",)}, "unknown unit 'rmp'; known: rad/s, rpm, hz, deg/s"),
        ({"time": "t:min"}, "unknown unit 'min'; known: s, ms, us, ns, iso"),
        ({"command": ("u:V",)}, "it has no unit here"),
        ({"time": None}, "needs --time COLUMN"),
        ({"time": None, "period": "10"}, "with its unit"),
        ({"time": None, "period": "0ms"}, "with its unit"),
        ({"period": "10ms"}, "leave out --time or --period"),
        ({"command": ("u", "u"), "speed": ("y", "y", "y")}, "2 command and 3 speed columns"),
        ({"speed": ("y:rpm", "y:hz")}, "speeds in rpm, hz: give all in one unit"),
    ],
)
def test_a_wrong_description_of_the_table_is_a_one_line_error(tmp_path, arguments, expected):
    with pytest.raises(UserError, match=expected) as raised:
        table(tmp_path, "t,u,y\n0,1,10\n1,2,20\n", **arguments)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "must name the columns"),
        ("t,u,y\n", "has no times|has no numbers|fewer than two"),
        ("t,u,y\n0,1,10\n", "fewer than two"),
        ("t,u,y\nthen,1,10\nnow,1,10\n", "has no times in iso, but for example 'then'"),
        ("t,u,y\n0,1,fast\n1,1,slow\n", "'y' has no numbers, but for example 'fast'"),
        ("t,u,u,y\n0,1,1,10\n1,1,1,10\n", "2 columns are called 'u'"),
        (b"MATLAB 5.0 MAT-file\0\0\0\1", "not a text file with columns"),
    ],
)
def test_a_file_that_is_not_a_measured_table_is_a_one_line_error(tmp_path, content, expected):
    with pytest.raises(UserError, match=expected) as raised:
        table(tmp_path, content)
    assert "\n" not in str(raised.value)


def test_a_missing_file_is_a_one_line_error(tmp_path):
    with pytest.raises(UserError, match=r"nowhere\.csv: cannot read the table: No such file"):
        read_table(tmp_path / "nowhere.csv", "t", ["u"], ["y"])


def test_quoted_cells_are_read(tmp_path):
    path = tmp_path / "quoted.csv"
    with path.open("w", newline="") as file:
        writer = csv.writer(file, quoting=csv.QUOTE_ALL)
        writer.writerows([["time, s", "u", "y"], [0, 1, 10], [1, 2, 20]])
    assert read_table(path, "time, s", ["u"], ["y"]).speed_rad_s.tolist() == [[10.0], [20.0]]


@pytest.mark.parametrize(("unit", "finer"), [("", "ms"), (":s", "ms"), (":ms", "us")])
@pytest.mark.parametrize("fraction", ["", ".5"])
def test_times_read_in_too_large_a_unit_are_an_error_that_names_the_unit_to_try(tmp_path, unit, finer, fraction):
    t = f"1700000000123{'' if finer == 'ms' else '000'}{fraction}"
    with pytest.raises(UserError, match=rf"beyond the year 2116: is it in ms, us or ns\? use --time t:{finer}"):
        table(tmp_path, f"t,u,y\n{t},1,10\n{t},2,20\n", time=f"t{unit}")


def test_a_time_too_large_for_a_float_is_not_a_time(tmp_path):
    assert table(tmp_path, "t,u,y\n0,1,10\n1e305,1,10\n1,2,20\n").repairs.without_time == 1


@pytest.mark.parametrize(
    "text",
    [
        "t,u,y\n,1,5\n0,,10\nx,1,5\n0.01,2,20\n\n0.03,,30\n0.03,3,\n0.02,4,40\n",
        "t,u,y\n,1,5\n2024-05-01 10:00:00,1,10\n2024-05-01 10:00:01,2,20\n",
    ],
)
def test_row_17_a_table_read_in_pieces_is_the_same(tmp_path, monkeypatch, text):
    whole = table(tmp_path, text)
    monkeypatch.setattr(measured_table, "_ROWS_IN_PIECE", 1)
    pieces = table(tmp_path, text)
    for name in ("t_ns", "command", "speed_rad_s"):
        np.testing.assert_array_equal(getattr(pieces, name), getattr(whole, name))
    assert (pieces.repairs, pieces.assumed) == (whole.repairs, whole.assumed)


def test_row_17_a_table_needs_little_more_memory_than_its_file(tmp_path):
    path = tmp_path / "long.csv"
    path.write_text(
        "t,u,y,text\n" + "".join(f"{k * 0.01:.2f},{k % 40},{k % 777:.3f},not needed\n" for k in range(60_000))
    )
    tracemalloc.start()
    try:
        read_table(path, "t:s", ["u"], ["y:rpm"])
        _, peak_bytes = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak_bytes < 5 * path.stat().st_size


def test_row_17_a_line_without_end_is_refused(tmp_path):
    path = tmp_path / "endless.csv"
    path.write_text("t,u,y\n" + 1_100_000 * "1")
    with pytest.raises(UserError, match=r"endless\.csv: not a text file with columns: a line is longer than 1,048,576"):
        read_table(path, "t", ["u"], ["y"])


@pytest.mark.parametrize("period", ["2d", "90000s", "99999999999999999999s", "86400s"])
def test_row_15_a_period_without_measure_is_refused(tmp_path, monkeypatch, period):
    monkeypatch.setattr(measured_table, "FURTHEST_T_NS", 100_000 * 10**9)
    with pytest.raises(UserError, match=f"--period {period}: "):
        table(tmp_path, "u,y\n" + 5 * "1,2\n", time=None, period=period)

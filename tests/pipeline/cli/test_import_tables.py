"""`fantwin import` of tables as instruments write them: the numbers and times of each are those in it.

Each has the form of public files and reports: docs/reference/tried.md.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.cli.simulation.scenario import FileScenario, Scenario
from fantwin.pipeline.recordings.training_runs import read_runs
from fantwin.pipeline.sources.tables.units import unit_in_name
from tests.support.fan_rows import COLUMNS, COMMAND, EPOCH_S, RPM, SECONDS, SPEED, START, N, Table, require_imported
from tests.support.fantwin_command import as_typed, error_of, fantwin
from tests.support.written_recordings import raw_columns

PLAIN, DATED = "t,fan1,pwm1", "Time,fan1,pwm1"
NO_UNIT = ("--command", "pwm1", "--speed", "fan1")
ISO = "{d:%Y-%m-%d %H:%M:%S}"
AUTUMN = datetime(2026, 10, 25, 0, 40, tzinfo=UTC)
"""20 minutes before summer time ends in Berlin"""
REPEATED = [f"{AUTUMN + timedelta(hours=2 - (k > 19), minutes=k):%Y-%m-%d %H:%M:%S}" for k in SECONDS.tolist()]
WRAPPED_US = (SECONDS * 2000 + 2**32 - 60_000) % 2**32
LABVIEW = (
    "LabVIEW Measurement\t\nSeparator\tTab\n***End_of_Header***\t\n\t\nChannels\t2\nX0\t0.0\t0.0\nDelta_X\t1.0\t1.0\n"
    "***End_of_Header***\t\t\t\nX_Value\tfan1\tpwm1\tComment"
)


def with_times(times: list[str]) -> str:
    """A table of the fan at these times."""
    rows = [f"{t},{s},{c}" for t, s, c in zip(times, SPEED.tolist(), COMMAND.tolist(), strict=True)]
    return "\n".join([DATED, *rows])


TABLES = {
    # numbers
    "commas between thousands, quoted": Table(DATED, ISO + ',"{commas}",{c}'),
    "points between thousands beside decimal commas": Table("t;fan1;pwm1", "{t},0;{dots};{c},0"),
    "points between thousands and decimal commas in one column": Table("t;fan1;pwm1", "{t};{dots},0;{c}"),
    "blanks between thousands": Table("t;fan1;pwm1", "{t};{blanks};{c}"),
    "narrow no-break spaces between thousands": Table("t\tfan1\tpwm1", "{t}\t{narrow}\t{c}"),
    "apostrophes between thousands": Table("t;fan1;pwm1", "{t};{quotes};{c}"),
    "times with commas between thousands": Table(PLAIN, '"{ms}",{s},{c}', ("--time", "t:ms", *COLUMNS)),
    "units behind the numbers": Table(PLAIN, "{t}000 ms,{s} RPM,{c}%", NO_UNIT),
    "rpm in the name": Table("t,Fan1RPM avg,pwm1", "{t},{s},{c}", ("--command", "pwm1", "--speed", "Fan1RPM avg")),
    "decimal commas, quoted, between commas": Table(PLAIN, '"{t},0","{s},000",{c}'),
    "three digits behind the decimal mark that the user gives": Table(
        "t;fan1;pwm1", "{t};{s},000;{c}", (*COLUMNS, "--decimal", ",")
    ),
    # heads
    "a line sep=": Table('sep=|\n"Time"|"fan1"|"pwm1"', ISO + "|{s}|{c}"),
    "comments": Table("# logger v3, board 7\n# started 2026\n" + PLAIN, "{t},{s},{c}"),
    "names in a comment": Table("# t fan1 pwm1", "{t} {s} {c}"),
    "keys and values before the names": Table(
        '"Product","Blackbox flight data recorder"\n"firmware","4.5"\n"time","motor[0]","rpm"',
        "{t}000000,{c},{s}",
        ("--time", "time:us", "--command", "motor[0]", "--speed", "rpm:rpm"),
        ("UTF-8, columns separated by ',', names in line 3",),
    ),
    "a line of units": Table("Time,pwm1,fan1\ns,%,rpm", "{t},{c},{s}", NO_UNIT),
    "a line of units, some of which nobody knows": Table(
        "Time,pwm1,fan1,torque,set\ns,%,krpm,ozf.in,Nm", "{t},{c},{s}e-3,1,2", NO_UNIT
    ),
    "groups of columns": Table(
        "t,fan1,,fan2,\n,rpm,pwm,rpm,pwm",
        "{t},{s},{c},{half},{c}",
        ("--time", "t:s", "--command", "fan1 pwm", "--speed", "fan1 rpm:rpm"),
    ),
    "blanks in columns": Table("  t pwm1    fan1", "{t}   {c}   {s}"),
    "a date with a blank among blanks": Table("Time fan1 pwm1", ISO + " {s} {c}"),
    "a Markdown table": Table("| | t | fan1 | pwm1 |\n|--|--:|--:|--:|", "| | {t} | {s} | {c} |"),
    "UTF-16 without a mark": Table(PLAIN, "{t},{s},{c}", encoding="utf-16-le"),
    "no line of names": Table(
        "", "{t},{s},{c}", ("--time", "column 1:s", "--command", "column 3", "--speed", "column 2:rpm")
    ),
    "the same name twice": Table(
        "t,fan,fan,pwm1",
        "{t},{s},{half},{c}",
        ("--command", "pwm1", "--speed", "fan:rpm"),
        ("several columns are called 'fan': the first is read; the next is 'fan [2]'",),
    ),
    "LabVIEW: heads before the names": Table(LABVIEW, "{t}.0\t{s}\t{c}"),
    "LabVIEW: decimal commas, and units in a head": Table(
        LABVIEW.replace("X0", "Y_Unit_Label\trpm\t%\nX0").replace("fan1\tpwm1", "speed\tset"),
        "{t},000000\t{s},000000\t{c},000000",
        ("--command", "set", "--speed", "speed"),
    ),
    "a log that begins within a line": Table(
        "1,840",
        "{t},{s},{c}",
        ("--time", "column 1:s", "--command", "column 3", "--speed", "column 2:rpm"),
        ("1 rows left out: fewer cells than the 3 columns, first '1,840'",),
    ),
    "a row that is cut off": Table(
        "t,pwm1,fan1",
        "{t},{c},{s}",
        notes=("1 rows with fewer cells than the 3 names: the others are taken as missing",),
        other="{t},{c}",
    ),
    # times
    "12 hours": Table(DATED, "{d:%m/%d/%Y %I:%M:%S %p},{s},{c}", notes=("month, day, year",), every_s=7560.0),
    "names of months and zones": Table(DATED, "{d:%d-%b-%Y %H:%M:%S} CEST,{s},{c}", t_s=EPOCH_S - 7200),
    "parts of one digit": Table(DATED, "{d.day}.{d.month}.{d.year} {d.hour}:{d.minute}:{d.second}.0,{s},{c}"),
    "the time before the date": Table(
        "Time\tfan1\tpwm1", "{d:%H:%M:%S} {d.day}-{d.month}-{d.year}\t{s}\t{c}", (*COLUMNS, "--dates", "dmy")
    ),
    "a date that the order of rows tells": Table(
        DATED,
        "{d:%m/%d/%Y %H:%M},{s},{c}",
        notes=("month, day, year",),
        start=START.replace(second=0),
        every_s=3600.0,
    ),
    "times of day past midnight": Table(
        DATED,
        "{d:%H:%M:%S},{s},{c}",
        notes=("times of day without a date",),
        start=START + timedelta(hours=2),
        t_s=86_390.0 + SECONDS,
    ),
    "minutes and seconds, as spreadsheets cut times": Table(DATED, "{d:%M:%S}.0,{s},{c}", t_s=3590.0 + SECONDS),
    "ms since 1970 without a unit": Table(PLAIN, "{epoch}000,{s},{c}", notes=("in ms since 1970",)),
    "a zone, and the hour that repeats": Table(
        with_times(REPEATED),
        options=(*COLUMNS, "--zone", "Europe/Berlin"),
        t_s=AUTUMN.timestamp() + 60.0 * SECONDS,
        notes=("40 taken as the second",),
    ),
    "a counter of 32 bits of microseconds that wraps": Table(
        with_times(list(map(str, WRAPPED_US))),
        options=("--time", "Time:us", *COLUMNS),
        t_s=4294.967296 - 0.06 + 0.002 * SECONDS,
        notes=("wrapped once (32 bits of microseconds)",),
    ),
    "the newest row first": Table(
        "\n".join([DATED, *with_times([f"{k}" for k in SECONDS]).splitlines()[:0:-1]]),
        t_s=SECONDS,
        notes=("the newest row is the first",),
    ),
    "minutes": Table("Time [min],fan1,pwm1", "{t},{s},{c}", every_s=60.0),
    "days of a spreadsheet": Table("Date,fan1,pwm1", "461{t:02}.5,{s},{c}", t_s=(46100.5 - 25569 + SECONDS) * 86400.0),
    "zones after the time": Table(DATED, ISO + ".000 +0000 UTC,{s},{c}"),
    "a zone of several names, that the user says": Table(
        DATED,
        "{d:%m/%d/%Y %I:%M:%S %p} CST,{s},{c}",
        (*COLUMNS, "--zone", "America/Chicago", "--dates", "mdy"),
        t_s=EPOCH_S + 5 * 3600,
    ),
    "a column of flags beside the fans": Table(DATED + ",Throttled [Yes/No]", ISO + ",{s},{c},No"),
    "slots that nothing is connected to": Table(
        "t,fan1,pwm1,fan2,pwm2,fan3,pwm3",
        "{t},{s},{c},0,{c},,{c}",
        ("--command", "pwm*", "--speed", "fan*:rpm"),
        ("left out, because the speed is always 0 or missing: fan2, fan3",),
    ),
}
WITHOUT_30 = np.delete(SECONDS, 30)
DAMAGED_ROWS = {
    "10515.76,{s},{c}": "1 row dropped: the time contradicts the rows around (row 31)",
    "3,{s},{c}": "1 row dropped: the time contradicts",
    "1000000000000000000,{s},{c}": "1 rows dropped: their time cannot",
    "{t},{s},{c},7": "1 rows left out: more cells than the 3 names, first '7'",
}
DAMAGED_CELLS = {
    "{t},fast,{c}": "'fan1': 1 cell with text that is no number, first 'fast' in row 31",
    "{t},1.74 krpm,{c}": "1 cell with text that is no number, first '1.74 krpm'",
    "{t},-1,{c}": "fan1: 1 values left out, an error code, -1",
    "{t},65535,{c}": "fan1: 1 values left out, an error code, 65535",
    "{t},203390,{c}": "fan1: 1 values left out, up to 203,390 rpm",
}


@pytest.mark.parametrize("name", TABLES)
def test_a_table_becomes_a_recording_of_its_numbers_and_times(name: str, tmp_path: Path) -> None:
    require_imported(TABLES[name], tmp_path)


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("Fan1 [RPM]", "rpm"),
        ("fan_rpm_0", "rpm"),
        ("CPUFanRPM", "rpm"),
        ("eRPM[0]", "erpm"),
        ("rpm sensor (Hz)", "hz"),
        ("speed_rad_s", "rad/s"),
        ("node_hwmon_temp_celsius{sensor=temp1}", "celsius"),
        ("air [K]", "K"),
        ("interpmode", ""),
        ("krpm", ""),
    ],
)
def test_a_name_says_its_unit_or_none(name: str, unit: str) -> None:
    assert unit_in_name(name) == unit


@pytest.mark.parametrize("other", [*DAMAGED_ROWS, *DAMAGED_CELLS])
def test_a_damaged_row_or_cell_costs_itself_and_is_counted(other: str, tmp_path: Path) -> None:
    note = (DAMAGED_ROWS | DAMAGED_CELLS)[other]
    kept = WITHOUT_30 if other in DAMAGED_ROWS else SECONDS
    require_imported(Table(PLAIN, "{t},{s},{c}", other=other, notes=(note,), kept=kept), tmp_path)


def test_a_damaged_frame_a_tenth_of_a_second_ahead_is_dropped_of_a_log_of_2_ms(tmp_path: Path) -> None:
    path, times_us = tmp_path / "table.csv", np.where(SECONDS == 30, 160_000, SECONDS * 2000)
    path.write_text(with_times([f"{each}" for each in times_us]).replace("Time", "t (us)"))
    result = fantwin("import", path, *COLUMNS, "-o", tmp_path / "r.mcap")
    assert "1 row dropped: the time contradicts" in result.stdout
    np.testing.assert_array_equal(raw_columns(tmp_path / "r.mcap")[0], WITHOUT_30 * 2_000_000)


MARK = "give the decimal mark of the file, --decimal . or --decimal ,"
REFUSED = {
    "points that may separate thousands, between commas": (
        "\n".join([PLAIN, *(f"{k},{'890' if k % 9 == 0 else f'1.{320 + k % 5}'},40" for k in SECONDS)]),
        f"column 'fan1': '1.321' is 1321 or 1.321: {MARK}",
    ),
    "quoted commas with three digits behind each": (
        "\n".join([PLAIN, *(f'{k},{s},"4{k % 10},125"' for k, s in enumerate(SPEED))]),
        f"column 'pwm1': '40,125' is 40125 or 40.125: {MARK.replace('. or --decimal ,', ', or --decimal .')}",
    ),
    "JSON that is neither a list of objects nor an object a line": (
        '{"fan1": {"rpm": 900, "pwm": 30},\n "when": "2026-06-09"}',
        "and this is neither: make one, for example with `jq -c '.KEY[]' table.csv > rows.jsonl`",
    ),
    "JSON that is cut off": (
        '[{"t": 0, "fan1": 900},\n{"t": 1,',
        "damaged JSON, or cut off: `jq . table.csv` names the place",
    ),
    "both marks as decimal marks, and a cell that could have either": (
        "\n".join(["t;fan1;pwm1", *(f"{k};{'1,016' if k == 50 else '12,5' if k % 2 else '12.5'};40" for k in SECONDS)]),
        "'1,016' is 1016 or 1.016, and '12.5' and '12,5' differ: give the decimal mark",
    ),
    "decimal commas between commas": (
        "\n".join([PLAIN, *(f"{k},{s},5,40" for k, s in enumerate(SPEED))]),
        "rows have more cells than the 3 names of line 1: if numbers have decimal commas",
    ),
    "other columns after a restart": (
        "\n".join([PLAIN, *(f"{k},1000,40" for k in range(9)), "t,pwm1,fan1", *(f"{k},40,1000" for k in SECONDS)]),
        "the columns change in a further line of names, which has 'none': cut the file there",
    ),
    "a clock that was set back": (
        with_times([str(k if k < 40 else k - 20) for k in SECONDS]),
        "time goes back by 19.000 s at row 41, from 39.000 s to 20.000 s: the clock was set, or a second run begins",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_told_is_refused_with_the_cell_and_the_option(name: str, tmp_path: Path) -> None:
    content, expected = REFUSED[name]
    path = tmp_path / "table.csv"
    path.write_text(content, encoding="utf-8")
    assert expected in error_of("import", path, *COLUMNS, "-o", tmp_path / "r.mcap")
    assert not (tmp_path / "r.mcap").exists()


def test_marks_that_only_later_rows_show_are_those_of_the_whole_column(tmp_path: Path) -> None:
    path, recording = tmp_path / "table.csv", tmp_path / "r.mcap"
    rows = [f"{k};1.01{6 + k % 3};40" for k in range(1000)]
    path.write_text("\n".join(["t;fan1;pwm1", *rows, "1000;1.016,5;40"]) + "\n", encoding="utf-8")
    assert fantwin("import", path, *COLUMNS, "-o", recording).exit_code == 0
    speed = raw_columns(recording)[2][:, 0] / RPM
    np.testing.assert_allclose(speed, np.append(1016 + np.arange(1000) % 3, 1016.5))


CHANNELS = {
    "temp_mC": ("temperature_c", 45_000, 45.0, "'temp_mC' converted from mC to °C"),
    "vbat [mV]": ("supply_voltage_v", 12_100, 12.1, "supply_voltage_v from 'vbat [mV]': 12.1 to 12.1 V"),
    "vbat": ("supply_voltage_v", 16_320, np.nan, "V: what is its unit?"),
    "Ibus": ("current_a", 45, 45.0, "current_a from 'Ibus': 45 to 45 A"),
    "power [W]": ("current_a", 45, np.nan, "'power [W]' is in W, which is no unit of current_a: left out"),
}


@pytest.mark.parametrize("name", CHANNELS)
def test_channels_are_converted_to_their_units_or_left_out(name: str, tmp_path: Path) -> None:
    channel, cell, value, note = CHANNELS[name]
    path, recording = tmp_path / "table.csv", tmp_path / "r.mcap"
    path.write_bytes(Table(f"{PLAIN},{name}", f"{{t}},{{s}},{{c}},{cell}").content)
    assert note in fantwin("import", path, *COLUMNS, "--channel", f"{channel}={name}", "-o", recording).stdout
    (run,) = read_runs(recording).runs
    np.testing.assert_allclose(run.auxiliary[channel], np.full((N, 1), value), rtol=1e-6)


SPEEDS = {
    "speed [Hz]:rpm": "speed [Hz]: in hz by the file, and read in rpm, as you say",
    "fan_rpm": "--poles is for speeds in erpm, and has no effect on rpm",
    "fan1 [%]": "speeds in %, as the file says: give one unit of a speed, as in --speed 'fan1 [%]:rpm'",
    "thrust_gf": "speeds in gf, as the file says: give one unit of a speed",
    "pwm1": "'pwm1' is named as command and as speed",
}


@pytest.mark.parametrize("speed", SPEEDS)
def test_units_that_contradict_a_speed_are_said_or_refused(speed: str, tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    path.write_bytes(Table(f"t,pwm1,{speed.removesuffix(':rpm')}", "{t},{c},{s}").content)
    shown = as_typed("import", path, "--command", "pwm1", "--speed", speed, "--poles", "14", "-o", tmp_path / "r.mcap")
    assert SPEEDS[speed] in shown.stdout + shown.stderr
    assert (tmp_path / "r.mcap").exists() == (shown.returncode == 0)


def test_a_simulated_line_plays_such_a_table(tmp_path: Path) -> None:
    path = tmp_path / "bench.csv"
    path.write_bytes(Table("Time;fan1;pwm1", "{d:%m/%d/%Y %H:%M:%S};{dots};{c}").content)
    file = FileScenario(path=path, command=("pwm1",), speed=("fan1:rpm",), dates="mdy", decimal=",")
    device = Scenario(file=file).table()
    assert device
    samples = [device.take() for _ in range(N)]
    assert device.due_s() is None
    np.testing.assert_allclose([sample.speed_rad_s[0] / RPM for sample in samples], SPEED)
    np.testing.assert_allclose([sample.t_s for sample in samples], SECONDS, atol=1e-9)

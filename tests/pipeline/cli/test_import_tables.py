"""`fantwin import` of tables as programs and instruments write them: the numbers and times of each are those in it.

Each table below has 60 rows of the same fan, in the form of public files and reports: docs/reference/tried.md.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from fantwin.pipeline.cli.simulation.scenario import FileScenario, Scenario
from fantwin.pipeline.errors import FantwinError
from fantwin.pipeline.recordings.training_runs import read_runs
from fantwin.pipeline.sources.imported_file import preview_of, read_file
from fantwin.pipeline.sources.samples_of_file import Wanted
from fantwin.pipeline.sources.tables import profiles
from fantwin.schemas.messages import Array
from tests.support.fantwin_command import error_of, fantwin
from tests.support.written_recordings import raw_columns

RPM = 2 * np.pi / 60
N = 60
COMMAND = np.repeat([40, 80, 30], 20)
SPEED = np.repeat([1020, 1744, 840], 20) + np.arange(N) % 5
SECONDS = np.arange(N)
START = datetime(2026, 6, 9, 21, 59, 50, tzinfo=UTC)
AUTUMN = datetime(2026, 10, 25, 0, 40, tzinfo=UTC)
"""20 minutes before summer time ends in Berlin"""
DATES = [START + timedelta(seconds=int(second)) for second in SECONDS]
EPOCH_S = START.timestamp() + SECONDS
ISO = [each.strftime("%Y-%m-%d %H:%M:%S") for each in DATES]
GERMAN = [f"{each.day}.{each.month}.{each.year}" for each in DATES]
OF_DAY = [f"{each:%H:%M:%S}.000" for each in DATES]
COLUMNS = ("--command", "pwm1", "--speed", "fan1:rpm")


def lines(*columns: Iterable[object], by: str = ",", head: str = "", before: str = "", after: str = "") -> str:
    """A table: rows of these columns, with a head and what stands before and after them."""
    rows = [by.join(map(str, row)) for row in zip(*columns, strict=True)]
    return "\n".join(filter(None, [before, head, *rows, after])) + "\n"


def thousands(mark: str) -> list[str]:
    return [f"{speed:,}".replace(",", mark) for speed in SPEED]


def quoted(cells: Iterable[object]) -> list[str]:
    return [f'"{cell}"' for cell in cells]


class Table(NamedTuple):
    """A table and what must come of it. t_s: times; 0 at the start without dates. notes: that are said."""

    content: str | bytes
    options: tuple[str, ...] = COLUMNS
    t_s: Array = SECONDS
    notes: tuple[str, ...] = ()


UTC_ASSUMED = "have no time zone: UTC assumed"
LHM_HEAD = (
    ',/lpc/chip/fan/0,/lpc/chip/fan/1,/lpc/chip/control/0,/lpc/chip/control/1\nTime,"Fan #1","Fan #2","Fan #1","Fan #2"'
)
US = [f"{each:%m/%d/%Y %H:%M:%S}" for each in DATES]
HWINFO = 'Date,Time,"CPU Package [°C]","Fan1 [RPM]","Fan1 PWM [%]",'
HALF = [each.strftime("%m/%d/%Y %I:%M:%S %p") for each in (DATES[0] + timedelta(hours=2.1 * k) for k in range(N))]
MINUTES = [f"{each:%M:%S}.0" for each in DATES]
SERIES = [("fan1", SPEED), ("pwm1", COMMAND)]
INFLUX_HEAD = (
    "#group,false,false,true,true,false,false,true,true,true\n"
    "#datatype,string,long,dateTime:RFC3339,dateTime:RFC3339,dateTime:RFC3339,double,string,string,string\n"
    "#default,_result,,,,,,,,\n,result,table,_start,_stop,_time,_value,_field,_measurement,fan"
)


def influx(head: str = INFLUX_HEAD, *, again: bool = True) -> str:
    """An annotated table: a result for each series, each with its own annotations or all under one."""
    results = [
        "\n".join(
            f",,{k},2026-06-09T00:00:00Z,2026-06-10T00:00:00Z,{each:%Y-%m-%dT%H:%M:%SZ},{value},{field},fans,CPU"
            for each, value in zip(DATES, values, strict=True)
        )
        for k, (field, values) in enumerate([("rpm", SPEED), ("pwm", COMMAND)])
    ]
    return "\r\n".join([head, results[0], *(["", head] if again else []), results[1], ""]).replace("\r\n\r\n", "\n\n")


def long(by: str = ";", *, sort_by_time: bool = False) -> str:
    """A row a value."""
    rows = [
        (name, f"{each:%Y-%m-%dT%H:%M:%S}+00:00", value)
        for name, of in SERIES
        for each, value in zip(DATES, of, strict=True)
    ]
    rows = sorted(rows, key=lambda row: row[1]) if sort_by_time else rows
    return "\n".join(by.join(map(str, row)) for row in [("Series", "Time", "Value"), *rows])


def prometheus() -> str:
    """The answer to a query of `{__name__=~"node_hwmon_fan_rpm|node_hwmon_pwm"}`."""

    def series(name: str, sensor: str, values: Sequence[int]) -> dict[str, object]:
        metric = {"__name__": name, "chip": "platform_nct6775_656", "instance": "a:9100", "sensor": sensor}
        return {"metric": metric, "values": [[t, str(value)] for t, value in zip(EPOCH_S, values, strict=True)]}

    result = [series("node_hwmon_fan_rpm", "fan1", SPEED.tolist()), series("node_hwmon_pwm", "pwm1", COMMAND.tolist())]
    return json.dumps({"status": "success", "data": {"resultType": "matrix", "result": result}})


TELEGRAF = "\n".join(
    f'sensors,chip=nct6775-isa-0290,feature={feature},host=a\\ b {field}={value},note="a b, c" {int(t * 1e9)}'
    for t, speed, command in zip(EPOCH_S, SPEED, COMMAND, strict=True)
    for feature, field, value in (("fan1", "fan_input", f"{speed}i"), ("pwm1", "pwm", f"{command}i"))
)
BLACKBOX = "loopIteration, time (us), motor[0], motor[1], eRPM[0], eRPM[1], vbatLatest (V)"
WRAPPED_US = (np.arange(N) * 2000 + 2**32 - 60_000) % 2**32

TABLES = {
    # numbers
    "commas between thousands, quoted": Table(
        lines(ISO, quoted(thousands(",")), COMMAND, head="Time,fan1,pwm1"), t_s=EPOCH_S
    ),
    "points between thousands beside decimal commas": Table(
        lines([f"{t},0" for t in SECONDS], thousands("."), [f"{c},0" for c in COMMAND], by=";", head="t;fan1;pwm1")
    ),
    "points between thousands and decimal commas in one column": Table(
        lines(SECONDS, [f"{each},0" for each in thousands(".")], COMMAND, by=";", head="t;fan1;pwm1")
    ),
    "blanks between thousands": Table(lines(SECONDS, thousands(" "), COMMAND, by=";", head="t;fan1;pwm1")),
    "narrow no-break spaces between thousands": Table(
        lines(SECONDS, thousands("\u202f"), COMMAND, by="\t", head="t\tfan1\tpwm1")
    ),
    "apostrophes between thousands": Table(lines(SECONDS, thousands("’"), COMMAND, by=";", head="t;fan1;pwm1")),
    "times with commas between thousands": Table(
        lines(quoted([f"{t * 1000:,}" for t in SECONDS]), SPEED, COMMAND, head="t,fan1,pwm1"),
        ("--time", "t:ms", *COLUMNS),
    ),
    "units behind the numbers": Table(
        lines(SECONDS, [f"{s} RPM" for s in SPEED], [f"{c}%" for c in COMMAND], head="t,fan1,pwm1"),
        ("--command", "pwm1", "--speed", "fan1"),
    ),
    "decimal commas, quoted, between commas": Table(
        lines(quoted([f"{t},0" for t in SECONDS]), quoted([f"{s},000" for s in SPEED]), COMMAND, head="t,fan1,pwm1")
    ),
    "three digits behind the decimal mark that the user gives": Table(
        lines(
            SECONDS,
            [f"{s / 8:.3f}".replace(".", ",") for s in SPEED - SPEED % 8 + 1],
            COMMAND,
            by=";",
            head="t;fan1;pwm1",
        ),
        (*COLUMNS, "--decimal", ","),
    ),
    # heads
    "LibreHardwareMonitor: two lines of names": Table(
        lines(US, SPEED, SPEED // 2, COMMAND, COMMAND, head=LHM_HEAD),
        ("--command", "/lpc/chip/control/0", "--speed", "/lpc/chip/fan/0"),
        EPOCH_S,
        ("dates as month, day, year", UTC_ASSUMED),
    ),
    "HWiNFO: Latin-1, date and time, names again at the end": Table(
        lines(
            GERMAN,
            OF_DAY,
            [55.0] * N,
            SPEED,
            COMMAND,
            [""] * N,
            head=HWINFO,
            after=f"{HWINFO}\n,,CPU: name,Board: chip,Board: chip,",
        ).encode("cp1252"),
        (),
        EPOCH_S,
        ("columns of HWiNFO: Fan1:", "dates as day, month, year", "1 rows dropped: their time cannot be read"),
    ),
    "a line sep=": Table(lines(ISO, SPEED, COMMAND, by="|", before="sep=|", head='"Time"|"fan1"|"pwm1"'), t_s=EPOCH_S),
    "comments": Table(
        lines(SECONDS, SPEED, COMMAND, before="# logger v3, board 7\n# started 2026", head="t,fan1,pwm1")
    ),
    "names in a comment": Table(lines(SECONDS, SPEED, COMMAND, by=" ", head="# t fan1 pwm1")),
    "keys and values before the names": Table(
        lines(
            SECONDS * 10_000,
            COMMAND,
            SPEED,
            before='"Product","Blackbox flight data recorder"\n"firmware","4.5"',
            head='"time","motor[0]","rpm"',
        ),
        ("--time", "time:us", "--command", "motor[0]", "--speed", "rpm:rpm"),
        SECONDS / 100,
        ("UTF-8, columns separated by ',', names in line 3",),
    ),
    "a line of units": Table(
        lines(SECONDS / 2, COMMAND, SPEED, before="Time,Duty,Speed", head="s,%,rpm"),
        ("--command", "Duty", "--speed", "Speed"),
        SECONDS / 2,
    ),
    "groups of columns": Table(
        lines(SECONDS, SPEED, COMMAND, SPEED // 2, COMMAND, head="t,fan1,,fan2,\n,rpm,pwm,rpm,pwm"),
        ("--time", "t:s", "--command", "fan1 pwm", "--speed", "fan1 rpm:rpm"),
    ),
    "blanks in columns": Table(lines(SECONDS, COMMAND, SPEED, by="   ", head="  t pwm1    fan1")),
    "a date with a blank among blanks": Table(lines(ISO, SPEED, COMMAND, by=" ", head="Time fan1 pwm1"), t_s=EPOCH_S),
    "a Markdown table": Table(
        lines(
            ["|"] * N,
            SECONDS,
            SPEED,
            COMMAND,
            [""] * N,
            by=" | ",
            before="| | t | fan1 | pwm1 |",
            head="|--|--:|--:|--:|",
        )
    ),
    "UTF-16 without a mark": Table(lines(SECONDS, SPEED, COMMAND, head="t,fan1,pwm1").encode("utf-16-le")),
    "no line of names": Table(
        lines(SECONDS, SPEED, COMMAND), ("--time", "column 1:s", "--command", "column 3", "--speed", "column 2:rpm")
    ),
    "the same name twice": Table(
        lines(SECONDS, SPEED, SPEED // 2, COMMAND, head="t,fan,fan,pwm1"),
        ("--command", "pwm1", "--speed", "fan:rpm"),
        notes=("several columns are called 'fan': the first is read; the next is 'fan [2]'",),
    ),
    # times
    "12 hours": Table(
        lines(HALF, SPEED, COMMAND, head="Time,fan1,pwm1"),
        t_s=EPOCH_S[0] + 7560.0 * SECONDS,
        notes=("month, day, year",),
    ),
    "names of months and zones": Table(
        lines(
            [f"{each + timedelta(hours=2):%d-%b-%Y %H:%M:%S} CEST" for each in DATES],
            SPEED,
            COMMAND,
            head="Time,fan1,pwm1",
        ),
        t_s=EPOCH_S,
    ),
    "a date that the order of rows tells": Table(
        lines(
            [f"{START + timedelta(hours=k):%m/%d/%Y %H:%M}" for k in range(N)], SPEED, COMMAND, head="Time,fan1,pwm1"
        ),
        t_s=EPOCH_S[0] // 60 * 60 + 3600.0 * SECONDS,
        notes=("month, day, year",),
    ),
    "times of day past midnight": Table(
        lines(
            [f"{START + timedelta(hours=2, seconds=int(t)):%H:%M:%S}" for t in SECONDS],
            SPEED,
            COMMAND,
            head="Time,fan1,pwm1",
        ),
        t_s=86_390.0 + SECONDS,
        notes=("times of day without a date",),
    ),
    "minutes and seconds, as spreadsheets cut times": Table(
        lines(MINUTES, SPEED, COMMAND, head="Time,fan1,pwm1"), t_s=3590.0 + SECONDS
    ),
    "ms since 1970 without a unit": Table(
        lines([int(t * 1000) for t in EPOCH_S], SPEED, COMMAND, head="t,fan1,pwm1"),
        t_s=EPOCH_S,
        notes=("in ms since 1970",),
    ),
    "a zone, and the hour that repeats": Table(
        lines(
            [f"{AUTUMN + timedelta(hours=2 - (k > 19), minutes=k):%Y-%m-%d %H:%M:%S}" for k in range(N)],
            SPEED,
            COMMAND,
            head="Time,fan1,pwm1",
        ),
        (*COLUMNS, "--zone", "Europe/Berlin"),
        AUTUMN.timestamp() + 60.0 * SECONDS,
        ("40 taken as the second",),
    ),
    "a counter of 32 bits of microseconds that wraps": Table(
        lines(
            SECONDS,
            WRAPPED_US,
            COMMAND,
            COMMAND,
            SPEED * 7,
            SPEED,
            [12.1] * N,
            by=", ",
            head=BLACKBOX.replace("eRPM", "erpm"),
        ),
        ("--time", "time (us)", "--command", "motor[0]", "--speed", "erpm[0]:erpm", "--poles", "14"),
        4294.967296 - 0.06 + 0.002 * SECONDS,
        ("wrapped once (32 bits of microseconds)",),
    ),
    "zones after the time": Table(
        lines([f"{each:%Y-%m-%d %H:%M:%S}.000 +0000 UTC" for each in DATES], SPEED, COMMAND, head="Time,fan1,pwm1"),
        t_s=EPOCH_S,
    ),
    "a zone of several names, that the user says": Table(
        lines([f"{each:%m/%d/%Y %I:%M:%S %p} CST" for each in DATES], SPEED, COMMAND, head="Time,fan1,pwm1"),
        (*COLUMNS, "--zone", "America/Chicago", "--dates", "mdy"),
        EPOCH_S + 5 * 3600,
    ),
    "a column of flags beside the fans": Table(
        lines(ISO, SPEED, COMMAND, ["Yes", "No", "Yes"] * 20, head="Time,fan1,pwm1,Throttled [Yes/No]"), t_s=EPOCH_S
    ),
    # long tables, and databases
    "Grafana: a row a value, by series": Table(long(), t_s=EPOCH_S, notes=("long table, 2 series by 'Series'",)),
    "a row a value, by time": Table(long(",", sort_by_time=True), t_s=EPOCH_S),
    "InfluxDB: annotated, each result with its head": Table(
        influx(), ("--command", "pwm", "--speed", "rpm:rpm"), EPOCH_S
    ),
    "InfluxDB: annotated once": Table(influx(again=False), ("--command", "pwm", "--speed", "rpm:rpm"), EPOCH_S),
    "InfluxDB: without annotations": Table(
        influx(INFLUX_HEAD.splitlines()[-1], again=False), ("--command", "pwm", "--speed", "rpm:rpm"), EPOCH_S
    ),
    "fans by number, a row each": Table(
        "t,fan,command,rpm\n"
        + "".join(
            f"{t},{fan},{c},{s // (1 + fan)}\n"
            for t, c, s in zip(SECONDS, COMMAND, SPEED, strict=True)
            for fan in (0, 1)
        ),
        ("--command", "command{0}", "--speed", "rpm{0}:rpm"),
    ),
    "Prometheus": Table(prometheus(), (), EPOCH_S, ("columns of node_exporter",)),
    "Telegraf: line protocol": Table(
        TELEGRAF, (), EPOCH_S, ("columns of Telegraf", "InfluxDB line protocol, 2 series")
    ),
    # programs
    "blackbox_decode": Table(
        lines(
            SECONDS, SECONDS * 2000, COMMAND, [""] * N, SPEED * 7 / 100, ["0"] * N, [12.1] * N, by=", ", head=BLACKBOX
        ),
        ("--poles", "14"),
        0.002 * SECONDS,
        ("columns of Betaflight blackbox: eRPM[0]:",),
    ),
    "blackbox_decode of builds that say (/100)": Table(
        lines(
            SECONDS,
            SECONDS * 2000,
            COMMAND,
            SPEED * 7 / 100,
            by=", ",
            head="loopIteration, time (us), motor[0], eRPM(/100)[0]",
        ),
        ("--command", "motor[*]", "--speed", "eRPM(/100)[*]:erpm", "--poles", "14"),
        0.002 * SECONDS,
        ("in hundreds: multiplied by 100",),
    ),
    "blackbox before 4.5: RPM_FILTER in debug": Table(
        lines(
            SECONDS * 2000,
            COMMAND,
            SPEED / 60,
            before='"debug_mode","46"\n"gyro_rate","8000"',
            head="time,motor[0],debug[0]",
        ),
        (),
        0.002 * SECONDS,
        ("columns of Betaflight blackbox with debug_mode RPM_FILTER",),
    ),
    "RCbenchmark": Table(
        lines(
            SECONDS / 40,
            COMMAND,
            [15.9] * N,
            SPEED,
            [""] * N,
            head="Time (s),ESC signal (µs),Voltage (V),Motor Electrical Speed (RPM),Motor Optical Speed (RPM)",
        ),
        (),
        SECONDS / 40,
    ),
    "MSI Afterburner: lines of limits between the names and the rows": Table(
        lines(
            ["80"] * N,
            [f"{each:%d-%m-%Y %H:%M:%S}" for each in DATES],
            [f"{c}.000" for c in COMMAND],
            [f"{s}.000" for s in SPEED],
            by=", ",
            before="00, 09-06-2026 21:59:50, Hardware monitoring log v1.6\n01, 09-06-2026 21:59:50, GPU",
            head="02, 09-06-2026 21:59:50, Fan speed  ,Fan tachometer\n03, 09-06-2026 21:59:50, Fan speed, , %, 100",
        ).encode("cp1252"),
        ("--command", "Fan speed", "--speed", "Fan tachometer:rpm", "--dates", "dmy"),
        EPOCH_S,
    ),
    # slots without a fan
    "slots that nothing is connected to": Table(
        lines(SECONDS, SPEED, COMMAND, [0] * N, COMMAND, [""] * N, COMMAND, head="t,fan1,pwm1,fan2,pwm2,fan3,pwm3"),
        ("--command", "pwm*", "--speed", "fan*:rpm"),
        notes=("left out, because the speed is always 0 or missing: fan2, fan3",),
    ),
}


@pytest.mark.parametrize("name", TABLES)
def test_a_table_becomes_a_recording_of_its_numbers_and_times(name: str, tmp_path: Path) -> None:
    table = TABLES[name]
    path, recording = tmp_path / "table.csv", tmp_path / "r.mcap"
    path.write_bytes(table.content if isinstance(table.content, bytes) else table.content.encode())
    result = fantwin("import", path, *table.options, "-o", recording)
    assert result.exit_code == 0, result.output
    t_ns, command, speed_rad_s = raw_columns(recording)
    expected = SPEED
    if "--decimal" in table.options:
        expected = (SPEED - SPEED % 8 + 1) / 8
    np.testing.assert_allclose(t_ns / 1e9, table.t_s, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(command[:, 0], COMMAND)
    np.testing.assert_allclose(speed_rad_s[:, 0] / RPM, expected, rtol=1e-9)
    for note in table.notes:
        assert note in result.stdout
    assert "speeds in rad/s assumed" not in result.stdout


DAMAGED = SECONDS.astype(float)
DAMAGED[30] += 2.0**20 / 100


class Cut(NamedTuple):
    """A table of which some rows cannot be read, which cost themselves. kept: rows that are."""

    content: str
    kept: Array
    note: str
    options: tuple[str, ...] = COLUMNS


WITHOUT_30 = np.delete(SECONDS, 30)
CUTS = {
    "a damaged time far ahead": Cut(
        lines(DAMAGED, SPEED, COMMAND, head="t,fan1,pwm1"),
        WITHOUT_30,
        "1 row dropped: the time contradicts the rows around (row 31)",
    ),
    "a damaged time far behind": Cut(
        lines(np.where(SECONDS == 30, 3, SECONDS), SPEED, COMMAND, head="t,fan1,pwm1"),
        WITHOUT_30,
        "1 row dropped: the time contradicts",
    ),
    "a damaged time beyond all dates": Cut(
        lines(np.where(SECONDS == 30, 10**18, SECONDS), SPEED, COMMAND, head="t,fan1,pwm1"),
        WITHOUT_30,
        "1 rows dropped: their time cannot",
    ),
    "a damaged frame a tenth of a second ahead, of a log of 2 ms": Cut(
        lines(np.where(SECONDS == 30, 160_000, SECONDS * 2000), SPEED, COMMAND, head="t (us),fan1,pwm1"),
        WITHOUT_30,
        "1 row dropped: the time contradicts",
    ),
    "a row with a cell too many": Cut(
        lines(SECONDS, SPEED, [f"{c},7" if k == 30 else c for k, c in enumerate(COMMAND)], head="t,fan1,pwm1"),
        WITHOUT_30,
        "1 rows left out: more cells than the 3 names, first '7'",
    ),
    "a cell with text": Cut(
        lines(SECONDS, [f"{s}" if k != 30 else "fast" for k, s in enumerate(SPEED)], COMMAND, head="t,fan1,pwm1"),
        SECONDS,
        "'fan1': 1 cell with text that is no number, first 'fast' in row 31",
    ),
    "a cell of thousands in another unit": Cut(
        lines(
            SECONDS, [f"{s} rpm" if k != 30 else "1.74 krpm" for k, s in enumerate(SPEED)], COMMAND, head="t,fan1,pwm1"
        ),
        SECONDS,
        "1 cell with text that is no number, first '1.74 krpm'",
    ),
}


@pytest.mark.parametrize("name", CUTS)
def test_a_damaged_row_costs_itself_and_is_counted(name: str, tmp_path: Path) -> None:
    cut = CUTS[name]
    path, recording = tmp_path / "table.csv", tmp_path / "r.mcap"
    path.write_text(cut.content, encoding="utf-8")
    result = fantwin("import", path, *cut.options, "-o", recording)
    assert result.exit_code == 0, result.output
    assert cut.note in result.stdout
    t_ns, _, speed_rad_s = raw_columns(recording)
    scale = 0.002 if "us" in cut.content[:10] else 1.0
    np.testing.assert_allclose(t_ns / 1e9, cut.kept * scale, atol=1e-9)
    known = np.isfinite(speed_rad_s[:, 0])
    assert known.sum() == N - 1
    np.testing.assert_allclose(speed_rad_s[known, 0] / RPM, SPEED[cut.kept][known], rtol=1e-9)


REFUSED = {
    "three digits behind any mark, between semicolons": (
        lines(SECONDS, [f"{s / 10:.3f}" for s in SPEED], COMMAND, by=";", head="t;fan1;pwm1"),
        "column 'fan1': '102.000' is 102000 or 102: give the decimal mark of the file, --decimal . or --decimal ,",
    ),
    "points that may separate thousands, between commas": (
        lines(SECONDS, ["890" if k % 9 == 0 else f"1.{320 + k % 5}" for k in SECONDS], COMMAND, head="t,fan1,pwm1"),
        "column 'fan1': '1.321' is 1321 or 1.321: give the decimal mark of the file, --decimal . or --decimal ,",
    ),
    "both marks as decimal marks, and a cell that could have either": (
        lines(
            SECONDS,
            ["1,016" if k == 50 else "12,5" if k % 2 else "12.5" for k in SECONDS],
            COMMAND,
            by=";",
            head="t;fan1;pwm1",
        ),
        "'1,016' is 1016 or 1.016, and '12.5' and '12,5' differ: give the decimal mark",
    ),
    "decimal commas between commas": (
        lines(SECONDS, [f"{s},5" for s in SPEED], COMMAND, head="t,fan1,pwm1"),
        "rows have more cells than the 3 names of line 1: if numbers have decimal commas",
    ),
    "other columns after a restart": (
        lines(SECONDS, SPEED, COMMAND, head="t,fan1,pwm1") + lines(SECONDS, COMMAND, SPEED, head="t,pwm1,fan1"),
        "the columns change in a further line of names, which has 'none': cut the file there",
    ),
    "a date with two readings": (
        lines([f"06/09/2026 21:59:{k:02}" for k in SECONDS], SPEED, COMMAND, head="Time,fan1,pwm1"),
        "06/09/2026 can be read in 2 ways, and no row tells: give --dates dmy (day, month, year) or --dates mdy",
    ),
    "a clock that was set back": (
        lines(np.concatenate([SECONDS[:40], SECONDS[:20] + 20]), SPEED, COMMAND, head="t,fan1,pwm1"),
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


def test_several_files_and_patterns_become_one_recording_in_the_order_of_time(tmp_path: Path) -> None:
    whole = lines(ISO, SPEED, COMMAND, head="Time,fan1,pwm1").splitlines()
    for name, rows in (("log-2.csv", whole[31:]), ("log-1.csv", whole[1:36])):
        (tmp_path / name).write_text("\n".join([whole[0], *rows]) + "\n", encoding="utf-8")
    recording = tmp_path / "r.mcap"
    result = fantwin("import", tmp_path / "log-*.csv", *COLUMNS, "-o", recording)
    assert "2 files in the order of time" in result.stdout
    assert "5 rows of files that overlap, 5 of them twice" in result.stdout
    t_ns, command, speed = raw_columns(recording)
    np.testing.assert_allclose(t_ns / 1e9, EPOCH_S, atol=1e-6)
    np.testing.assert_array_equal(command[:, 0], COMMAND)
    np.testing.assert_allclose(speed[:, 0] / RPM, SPEED)
    other = whole[31:36] = [line.replace(",1", ",2", 1) for line in whole[31:36]]
    (tmp_path / "log-2.csv").write_text("\n".join([whole[0], *other]) + "\n", encoding="utf-8")
    words = ("import", tmp_path / "log-1.csv", tmp_path / "log-2.csv", *COLUMNS, "-o", tmp_path / "s.mcap")
    assert "have other speeds at the same time" in error_of(*words)


def test_commands_and_speeds_in_two_tables_are_joined_by_their_times(tmp_path: Path) -> None:
    outputs, escs = tmp_path / "flight_actuator_outputs_0.csv", tmp_path / "flight_esc_status_0.csv"
    us = 10_000_000 + SECONDS * 100_000
    outputs.write_text(lines(us - 500, [4] * N, COMMAND, head="timestamp,noutputs,output[0]"), encoding="utf-8")
    escs.write_text(lines(us, [1] * N, SPEED, head="timestamp,esc_count,esc[0].esc_rpm"), encoding="utf-8")
    result = fantwin("import", outputs, escs, "-o", tmp_path / "r.mcap")
    assert "columns of 2 files by their times" in result.stdout
    assert "columns of PX4: esc[0].esc_rpm: command 'output[0]'" in result.stdout
    t_ns, command, speed = raw_columns(tmp_path / "r.mcap")
    np.testing.assert_allclose(t_ns / 1e9, us / 1e6)
    np.testing.assert_array_equal(command[:, 0], COMMAND)
    np.testing.assert_allclose(speed[:, 0] / RPM, SPEED)


def test_telemetry_by_instance_is_joined_with_the_outputs_of_another_table(tmp_path: Path) -> None:
    """mavlogdump writes one type of message a table."""
    escs, outputs = tmp_path / "esc.csv", tmp_path / "rcou.csv"
    rows = [
        f"{t + 0.001 * i:.8f},{k},{i},{s * (1 + i)},15.2"
        for k, (t, s) in enumerate(zip(EPOCH_S, SPEED, strict=True))
        for i in range(2)
    ]
    escs.write_text("\n".join(["timestamp,TimeUS,Instance,RPM,Volt", *rows]), encoding="utf-8")
    outputs.write_text(
        lines([f"{t - 0.0005:.8f}" for t in EPOCH_S], COMMAND, COMMAND, head="timestamp,C1,C2"), encoding="utf-8"
    )
    words = ("--command", "C1", "--command", "C2", "--speed", "RPM{0}:rpm", "--speed", "RPM{1}:rpm")
    result = fantwin("import", escs, outputs, *words, "-o", tmp_path / "r.mcap")
    assert "columns of 2 files by their times" in result.stdout
    _, command, speed = raw_columns(tmp_path / "r.mcap")
    for fan in (0, 1):
        known = np.isfinite(speed[:, fan])
        np.testing.assert_allclose(speed[known, fan] / RPM, SPEED * (1 + fan))
        np.testing.assert_array_equal(command[known, fan], COMMAND)


def test_a_preview_shows_what_was_understood_and_its_command_line_imports_the_table(tmp_path: Path) -> None:
    path, recording = tmp_path / "HWiNFO log.CSV", tmp_path / "r.mcap"
    table = TABLES["HWiNFO: Latin-1, date and time, names again at the end"]
    path.write_bytes(bytes(table.content))  # type: ignore[arg-type]
    before = set(tmp_path.iterdir())
    shown = fantwin("import", path, "--preview").stdout
    for expected in (
        "HWiNFO: Windows-1252, columns separated by ',', names in line 1",
        "times: Date+Time, dates as day, month, year, 1 s apart (median), from 2026-06-09 21:59:50 to 2026-06-09 22:00",
        "840 to 1748 rpm",
        "Fan1: command Fan1 PWM [%], speed Fan1 [RPM]",
    ):
        assert expected in shown
    assert set(tmp_path.iterdir()) == before
    (found,) = json.loads(fantwin("import", path, "--preview", "--json").stdout)["files"]
    words = [*found["options"], "-o", recording]
    assert found["command_line"].startswith(
        f"fantwin import '{path}' --command 'Fan1 PWM [%]' --speed 'Fan1 [RPM]:rpm'"
    )
    assert fantwin("import", path, *words).exit_code == 0
    np.testing.assert_allclose(raw_columns(recording)[2][:, 0] / RPM, SPEED)


def test_a_simulated_line_plays_such_a_table(tmp_path: Path) -> None:
    path = tmp_path / "bench.csv"
    path.write_text(lines(US, thousands("."), COMMAND, by=";", head="Time;fan1;pwm1"), encoding="utf-8")
    file = FileScenario(path=path, command=("pwm1",), speed=("fan1:rpm",), dates="mdy", decimal=",")
    device = Scenario(file=file).table()
    assert device
    samples = [device.take() for _ in range(N)]
    assert device.due_s() is None
    np.testing.assert_allclose([sample.speed_rad_s[0] / RPM for sample in samples], SPEED)
    np.testing.assert_allclose([sample.t_s for sample in samples], SECONDS, atol=1e-9)


def test_fans_are_called_as_the_program_calls_them(tmp_path: Path) -> None:
    path, recording = tmp_path / "table.csv", tmp_path / "r.mcap"
    path.write_text(lines(US, SPEED, SPEED // 2, COMMAND, COMMAND, head=LHM_HEAD), encoding="utf-8")
    assert fantwin("import", path, "-o", recording).exit_code == 0
    assert read_runs(recording).names.names == ("Fan #1", "Fan #2")


def test_a_program_that_writes_tables_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    toy = profiles.Profile(
        "Blower Bench",
        head=(r"Drehzahl \w+", "Uhr"),
        command=(r"Stellwert (?P<fan>\w+)",),
        speed=(r"Drehzahl (?P<fan>\w+)",),
        unit="hz",
        time=("Uhr",),
        time_unit="ms",
    )
    monkeypatch.setattr(profiles, "PROFILES", (toy, *profiles.PROFILES))
    path, recording = tmp_path / "bench.csv", tmp_path / "r.mcap"
    path.write_text(lines(SECONDS * 1000, SPEED / 60, COMMAND, head="Uhr,Drehzahl L,Stellwert L"), encoding="utf-8")
    assert (
        "columns of Blower Bench: Drehzahl L: command 'Stellwert L'" in fantwin("import", path, "-o", recording).stdout
    )
    t_ns, _, speed = raw_columns(recording)
    np.testing.assert_allclose(t_ns / 1e9, SECONDS)
    np.testing.assert_allclose(speed[:, 0] / RPM, SPEED)


def test_damaged_bytes_cost_cells_and_rows_or_are_one_line(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(1), tmp_path / "table.csv"
    contents = [of.content if isinstance(of.content, bytes) else of.content.encode() for of in TABLES.values()]
    inserted = [b'"', b"\0", b"\n", b",", b"1e400", b"9" * 20, b"\xff\xfe", b'"""\n']
    for _ in range(120):
        content = bytearray(contents[rng.integers(len(contents))])
        for at in rng.integers(len(content), size=3):
            content[at : at + rng.integers(9)] = inserted[rng.integers(len(inserted))]
        path.write_bytes(bytes(content))
        for read in (preview_of, read_file):
            try:
                read(path, Wanted(("pwm1",), ("fan1:rpm",)))
            except FantwinError as error:
                assert "\n" not in str(error)

"""`fantwin import` of what programs and databases write, of several files, and its preview.

Each has the form of public files and reports: docs/reference/tried.md.
"""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from fantwin.pipeline.errors import FantwinError
from fantwin.pipeline.recordings.training_runs import read_runs
from fantwin.pipeline.sources.imported_file import preview_of, read_file
from fantwin.pipeline.sources.tables import profiles
from fantwin.pipeline.sources.wanted import Wanted
from tests.support.fan_rows import COLUMNS, COMMAND, EPOCH_S, RPM, SECONDS, SPEED, N, Table, require_imported
from tests.support.fantwin_command import error_of, fantwin
from tests.support.written_recordings import raw_columns

DATED = "Time,fan1,pwm1"
ISO = "{d:%Y-%m-%d %H:%M:%S}"
US = "{d:%m/%d/%Y %H:%M:%S}"
LHM_HEAD = (
    ',/lpc/chip/fan/0,/lpc/chip/fan/1,/lpc/chip/control/0,/lpc/chip/control/1\nTime,"Fan #1","Fan #2","Fan #1","Fan #2"'
)
HWINFO = 'Date,Time,"CPU Package [°C]","Fan1 [RPM]","Fan1 PWM [%]","GPU [RPM]",'
INFLUX = ",result,table,_start,_stop,_time,_value,_field,_measurement,fan"
ANNOTATIONS = (
    "#group,false,false,true,true,false,false,true,true,true\n"
    "#datatype,string,long,dateTime:RFC3339,dateTime:RFC3339,dateTime:RFC3339,double,string,string,string\n"
    "#default,_result,,,,,,,,\n"
)
INFLUX_COLUMNS = ("--command", "pwm", "--speed", "rpm:rpm")
BLACKBOX = "loopIteration, time (us), motor[0], motor[1], eRPM[0], eRPM[1], vbatLatest (V)"
HUNDREDS = [f"{speed * 7 / 100:.2f}" for speed in SPEED]
"""electrical revolutions a minute of 14 poles, in hundreds"""


def body(row: str) -> str:
    """The rows of the fan in a format."""
    return Table("", row).content.decode().rstrip("\n")


def influx(before: str, *, again: bool) -> str:
    """An annotated table: a result for each series, each with its own annotations or all under one."""
    start = ",,{},2026-06-09T00:00:00Z,2026-06-10T00:00:00Z,{{d:%Y-%m-%dT%H:%M:%SZ}}"
    rpm, pwm = (body(f"{start.format(k)},{value},fans,CPU") for k, value in enumerate(("{s},rpm", "{c},pwm")))
    between = f"\n\n{before}{INFLUX}\n" if again else "\n"
    return f"{before}{INFLUX}\n{rpm}{between}{pwm}".replace("\n", "\r\n")


def prometheus() -> str:
    """The answer to a query of `{__name__=~"node_hwmon_fan_rpm|node_hwmon_pwm"}`."""
    result = [
        {
            "metric": {"__name__": name, "chip": "platform_nct6775_656", "instance": "a:9100", "sensor": sensor},
            "values": [[t, str(value)] for t, value in zip(EPOCH_S, values.tolist(), strict=True)],
        }
        for name, sensor, values in (("node_hwmon_fan_rpm", "fan1", SPEED), ("node_hwmon_pwm", "pwm1", COMMAND))
    ]
    return json.dumps({"status": "success", "data": {"resultType": "matrix", "result": result}})


HOME = ("--command", "number.pwm", "--speed", "sensor.rpm:rpm")


STATES = [
    ("fan.rack", "on", -0.5),
    *(("number.pwm", c, t - 0.125) for t, c in enumerate(COMMAND.tolist()) if not t % 20),
    *(("sensor.rpm", s, t) for t, s in enumerate(SPEED.tolist())),
]
"""rows of Home Assistant: of commands the changes alone"""


def iso(t: float) -> str:
    """The date of a time of the rows."""
    return datetime.fromtimestamp(EPOCH_S[0] + t, UTC).isoformat()


def answer_of_home_assistant() -> str:
    """A list of states for each entity, which only the first of them names."""
    of_each: dict[str, list[dict[str, object]]] = {}
    for entity, state, t in STATES:
        date = iso(t)
        known = of_each.setdefault(entity, [])
        full: dict[str, object] = (
            {} if known else {"entity_id": entity, "attributes": {"unit_of_measurement": "?"}, "last_updated": date}
        )
        known.append(full | {"state": str(state), "last_changed": date})
    return json.dumps(list(of_each.values()), indent=1)


def blackbox(head: str, row: str) -> str:
    """A table of `blackbox_decode`, 500 rows a second; e: hundreds of electrical revolutions."""
    values = zip(SECONDS.tolist(), COMMAND.tolist(), HUNDREDS, strict=True)
    return "\n".join(
        [head, *(row.format(us=2000 * t, c=c, e=e, hz=s / 60) for (t, c, e), s in zip(values, SPEED, strict=True))]
    )


TELEGRAF = (
    'sensors,chip=nct6775-isa-0290,feature=fan1,host=a\\ b fan_input={s}i,note="a b, c" {epoch}000000000\n'
    'sensors,chip=nct6775-isa-0290,feature=pwm1,host=a\\ b pwm={c}i,note="a b, c" {epoch}000000000'
)
ASSUMED = "have no time zone: UTC assumed"
PROGRAMS = {
    "LibreHardwareMonitor: two lines of names": Table(
        LHM_HEAD,
        US + ",{s},{half},{c},{c}",
        ("--command", "/lpc/chip/control/0", "--speed", "/lpc/chip/fan/0"),
        ("dates as month, day, year", ASSUMED),
    ),
    "HWiNFO: Latin-1, date and time, names again at the end": Table(
        HWINFO,
        "{d.day}.{d.month}.{d.year},{d:%H:%M}:{d.second}.000,55.0,{s},{c},700,",
        (),
        (
            "columns of HWiNFO: Fan1:",
            "speeds without a command of their own, or second ones, left out: GPU [RPM]",
            "dates as day, month, year",
            "1 rows dropped: their time cannot be read",
        ),
        after=f"{HWINFO}\n,,CPU: name,Board: chip,Board: chip,",
        encoding="cp1252",
    ),
    "HWiNFO: names in another language": Table(
        'Date,Time,"GPU 风扇1 [RPM]","GPU 风扇1 [%]","GPU Last [%]"',
        "{d.day}.{d.month}.{d.year},{d:%H:%M:%S}.000,{s},{c},55",
        (),
        ("columns of HWiNFO: GPU 风扇1: command 'GPU 风扇1 [%]', speed 'GPU 风扇1 [RPM]'",),
    ),
    "Grafana: a row a value, by series": Table(
        "Series;Time;Value\n"
        + body("fan1;{d:%Y-%m-%dT%H:%M:%S}+00:00;{s}")
        + "\n"
        + body("pwm1;{d:%Y-%m-%dT%H:%M:%S}Z;{c}"),
        notes=("long table, 2 series by 'Series'",),
        t_s=EPOCH_S,
    ),
    "a row a value, by time": Table(
        "Series,Time,Value",
        f"fan1,{ISO},{{s}}\npwm1,{ISO},{{c}}",
        notes=("1 rows left out: more cells than the 3 names, first '9'",),
        after="pwm1,2026-06-09 22:00:50,40,9",
    ),
    "Home Assistant: states of entities": Table(
        "entity_id,state,last_changed",
        "number.fan_pwm,{c},{d:%Y-%m-%dT%H:%M:%S}.000Z\nsensor.fan_rpm,{s},{d:%Y-%m-%dT%H:%M:%S}.000Z",
        ("--command", "number.fan_pwm", "--speed", "sensor.fan_rpm"),
    ),
    "Home Assistant: changes alone, in the order of time": Table(
        "\n".join(
            [
                "entity_id,state,last_changed",
                *(f"{entity},{x},{iso(t)}" for entity, x, t in sorted(STATES, key=lambda each: each[2])),
            ]
        ),
        "",
        HOME,
        ("long table, 2 series by 'entity_id'", "'state': 1 cell with text that is no number, first 'on' in row 1"),
        t_s=EPOCH_S,
    ),
    "Home Assistant: the answer of its interface": Table(answer_of_home_assistant(), "", HOME, t_s=EPOCH_S),
    "Zabbix: the answer to history.get": Table(
        json.dumps(
            {
                "jsonrpc": "2.0",
                "result": [
                    {"itemid": item, "clock": str(int(EPOCH_S[0]) + t), "value": str(each), "ns": "7"}
                    for t, both in enumerate(zip(SPEED, COMMAND, strict=True))
                    for item, each in zip(("231", "232"), both, strict=True)
                ],
            }
        ),
        "",
        ("--command", "value{232}", "--speed", "value{231}:rpm"),
        t_s=EPOCH_S,
    ),
    "an object a line, and a line that is cut off": Table(
        "",
        '{{"t": {t}, "fan": {{"rpm": {s}, "on": true}}, "duty": {c}}}',
        ("--command", "duty", "--speed", "fan.rpm"),
        after='{"t": 60, "f',
    ),
    "InfluxDB: annotated, each result with its head": Table(
        influx(ANNOTATIONS, again=True), "", INFLUX_COLUMNS, t_s=EPOCH_S
    ),
    "InfluxDB: annotated once": Table(influx(ANNOTATIONS, again=False), "", INFLUX_COLUMNS, t_s=EPOCH_S),
    "InfluxDB: without annotations": Table(influx("", again=False), "", INFLUX_COLUMNS, t_s=EPOCH_S),
    "fans by number, a row each": Table(
        "t,fan,command,rpm", "{t},0,{c},{s}\n{t},1,{c},{half}", ("--command", "command{0}", "--speed", "rpm{0}:rpm")
    ),
    "Prometheus": Table(prometheus(), "", (), ("columns of node_exporter",), EPOCH_S),
    "Telegraf: line protocol": Table("", TELEGRAF, (), ("columns of Telegraf", "InfluxDB line protocol, 2 series")),
    "blackbox_decode": Table(
        blackbox(BLACKBOX, "0, {us}, {c}, , {e}, 0, 12.1"),
        "",
        ("--poles", "14"),
        ("columns of Betaflight blackbox: eRPM[0]:",),
        every_s=0.002,
    ),
    "blackbox_decode of a voltage without its unit": Table(
        blackbox(BLACKBOX.replace(" (V)", ""), "0, {us}, {c}, , {e}, 0, 2194"),
        "",
        ("--poles", "14"),
        ("'vbatLatest' converted from V/100 to V", "supply_voltage_v from 'vbatLatest': 21.94 to 21.94 V"),
        every_s=0.002,
    ),
    "blackbox_decode of builds that say (/100)": Table(
        blackbox("loopIteration, time (us), motor[0], eRPM(/100)[0]", "0, {us}, {c}, {e}"),
        "",
        ("--command", "motor[*]", "--speed", "eRPM(/100)[*]:erpm", "--poles", "14"),
        ("in hundreds: multiplied by 100",),
        every_s=0.002,
    ),
    "blackbox before 4.5: RPM_FILTER in debug": Table(
        blackbox('"debug_mode","46"\n"gyro_rate","8000"\ntime,motor[0],debug[0]', "{us},{c},{hz}"),
        "",
        (),
        ("columns of Betaflight blackbox with debug_mode RPM_FILTER",),
        every_s=0.002,
    ),
    "RCbenchmark": Table(
        "Time (s),ESC signal (µs),Voltage (V),Motor Electrical Speed (RPM),Motor Optical Speed (RPM)",
        "{t},{c},15.9,{s},0",
        (),
        ("left out: Motor Optical Speed (RPM)",),
    ),
    "MSI Afterburner: lines of limits between the names and the rows": Table(
        "00, 09-06-2026 21:59:50, Hardware monitoring log v1.6\n01, 09-06-2026 21:59:50, GPU\n"
        "02, 09-06-2026 21:59:50, Fan speed  ,Fan tachometer\n03, 09-06-2026 21:59:50, Fan speed, , %, 100",
        "80, {d:%d-%m-%Y %H:%M:%S}, {c}.000, {s}.000",
        ("--command", "Fan speed", "--speed", "Fan tachometer:rpm", "--dates", "dmy"),
        encoding="cp1252",
    ),
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_what_a_program_writes_becomes_a_recording_of_its_numbers_and_times(name: str, tmp_path: Path) -> None:
    require_imported(PROGRAMS[name], tmp_path)


def test_several_files_and_patterns_become_one_recording_in_the_order_of_time(tmp_path: Path) -> None:
    whole = Table(DATED, ISO + ",{s},{c}").content.decode().splitlines()
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
    """Tables as ulog2csv writes them, a topic a file; in every tenth sample the ESC was silent."""
    outputs, escs = tmp_path / "flight_actuator_outputs_0.csv", tmp_path / "flight_esc_status_0.csv"
    us = (10_000_000 + SECONDS * 100_000).tolist()
    rows = zip(us, COMMAND.tolist(), SPEED.tolist(), strict=True)
    head, *lines = ("timestamp,noutputs,output[0]", *(f"{t - 500},4,{c}" for t, c, _ in rows))
    outputs.write_text("\n".join([head, *lines]))
    lines = [f"{t},1,{int(k % 10 != 0)},{s if k % 10 else 0}" for k, (t, s) in enumerate(zip(us, SPEED, strict=True))]
    escs.write_text("\n".join(["timestamp,esc_count,esc_online_flags,esc[0].esc_rpm", *lines]))
    result = fantwin("import", outputs, escs, "-o", tmp_path / "r.mcap")
    assert "columns of 2 files by their times" in result.stdout
    assert "columns of PX4: esc[0].esc_rpm: command 'output[0]'" in result.stdout
    assert "6 values left out, where the bit of the motor in esc_online_flags is not set" in result.stdout
    t_ns, command, speed = raw_columns(tmp_path / "r.mcap")
    np.testing.assert_allclose(t_ns / 1e3, us)
    np.testing.assert_array_equal(command[:, 0], COMMAND)
    np.testing.assert_allclose(speed[:, 0] / RPM, np.where(SECONDS % 10, SPEED, np.nan))


def test_telemetry_by_instance_is_joined_with_the_outputs_of_another_table(tmp_path: Path) -> None:
    """mavlogdump writes one type of message a table."""
    escs, outputs = tmp_path / "esc.csv", tmp_path / "rcou.csv"
    row = "{epoch}.002,{t},0,{s},15.2\n{epoch}.003,{t},1,{half},15.2"
    escs.write_bytes(Table("timestamp,TimeUS,Instance,RPM,Volt", row).content)
    outputs.write_bytes(Table("timestamp,C1,C2", "{epoch}.001,{c},{c}").content)
    words = ("--command", "C1", "--command", "C2", "--speed", "RPM{0}:rpm", "--speed", "RPM{1}:rpm")
    result = fantwin("import", escs, outputs, *words, "-o", tmp_path / "r.mcap")
    assert "columns of 2 files by their times" in result.stdout
    copy = tmp_path / "rcou-2.csv"
    copy.write_bytes(outputs.read_bytes())
    again = fantwin("import", escs, outputs, copy, *words, "-o", tmp_path / "s.mcap").stdout
    assert "several files have 'C1': that of the first is read" in again
    _, command, speed = raw_columns(tmp_path / "r.mcap")
    for fan, expected in enumerate((SPEED, SPEED // 2)):
        known = np.isfinite(speed[:, fan])
        np.testing.assert_allclose(speed[known, fan] / RPM, expected)
        np.testing.assert_array_equal(command[known, fan], COMMAND)


def test_a_preview_shows_what_was_understood_and_its_command_line_imports_the_table(tmp_path: Path) -> None:
    path, recording = tmp_path / "HWiNFO log.CSV", tmp_path / "r.mcap"
    path.write_bytes(PROGRAMS["HWiNFO: Latin-1, date and time, names again at the end"].content)
    before = set(tmp_path.iterdir())
    shown = fantwin("import", path, "--preview", "--zone", "UTC").stdout
    for expected in (
        "HWiNFO: Windows-1252, columns separated by ',', names in line 1",
        "times: Date+Time, dates as day, month, year, UTC, 1 s apart (median), from 2026-06-09 21:59:50 to 2026",
        "840 to 1748 rpm",
        "Fan1: command Fan1 PWM [%], speed Fan1 [RPM]",
    ):
        assert expected in shown
    assert set(tmp_path.iterdir()) == before
    (found,) = json.loads(fantwin("import", path, "--preview", "--json", "--zone", "UTC").stdout)["files"]
    words = "--command 'Fan1 PWM [%]' --speed 'Fan1 [RPM]:rpm' --zone UTC -o REC.mcap"
    assert found["command_line"] == f"fantwin import '{path}' {words}"
    assert fantwin("import", path, *found["options"], "-o", recording).exit_code == 0
    np.testing.assert_allclose(raw_columns(recording)[2][:, 0] / RPM, SPEED)


def test_a_preview_shows_all_but_what_cannot_be_told_which_it_names(tmp_path: Path) -> None:
    path = tmp_path / "open.csv"
    path.write_text("\n".join(["Time;a;b", *(f"06/09/2026 21:59:{k:02};1.01{k % 10};{k}" for k in SECONDS)]))
    shown = fantwin("import", path, "--preview").stdout
    assert "column 'Time': 06/09/2026 can be read in 2 ways" in shown
    assert "column 'a': '1.010' is 1010 or 1.01" in shown
    assert [line.split()[:3] for line in shown.splitlines() if "values" in line] == [
        ["a", "0", "values"],
        ["b", "60", "values"],
    ]


PREVIEWS = {
    "rows that an import drops": (
        Table(
            HWINFO, "{d.day}.{d.month}.{d.year},{d:%H:%M:%S},55.0,{s},{c},700,", other="9.6.2026,noon,55.0,1,30,700,"
        ),
        "1 rows dropped: their time cannot be read",
        "--speed 'Fan1 [RPM]:rpm'",
    ),
    "rows that an import of any columns drops": (
        Table("Time,y,u", ISO + ",{s},{c}", other="?,{s},{c}"),
        "1 rows dropped: their time cannot be read",
        "--command COLUMN --speed COLUMN:UNIT",
    ),
    "names without rows": (Table("pwm;n1;n2;V;m"), "", "to import it: nothing as it is"),
    "a log of sentences": (
        Table("", ISO + " Measuring RPM of cpu_cooler at PWM: {c}"),
        "",
        "to import it: nothing as it is",
    ),
    "times before dates with two readings": (
        Table(DATED, "21:59:50 06/09/2026,{s},{c}"),
        "06/09/2026 can be read in 2 ways, and no row tells: give --dates dmy",
        "to import it: nothing as it is",
    ),
    "speeds whose command nobody knows": (
        Table('Date,Time,"CPU [RPM]","CPU Total [%]"', "{d.day}.{d.month}.{d.year},{d:%H:%M:%S}.000,{s},{c}"),
        "no command of CPU [RPM]",
        "--command COLUMN --speed COLUMN -o",
    ),
    "electrical speeds, of which the poles are missing": (
        Table(blackbox(BLACKBOX, "0, {us}, {c}, , {e}, 0, 12.1")),
        "supply_voltage_v from 'vbatLatest (V)': 12.1 to 12.1 V",
        "--channel 'supply_voltage_v=vbatLatest (V)' --poles POLES",
    ),
    "speeds with their unit": (Table("t [s],duty [%],speed [Hz]", "{t},{c},{s}"), "", "COLUMN --speed COLUMN -o"),
}


@pytest.mark.parametrize("name", PREVIEWS)
def test_a_preview_says_what_an_import_would_do(name: str, tmp_path: Path) -> None:
    table, note, command_line = PREVIEWS[name]
    path = tmp_path / "table.csv"
    path.write_bytes(table.content)
    shown = fantwin("import", path, "--preview").stdout
    assert note in shown
    assert command_line in shown.splitlines()[-1]
    assert "--poles is for" not in shown


def test_fans_are_called_as_the_program_calls_them(tmp_path: Path) -> None:
    path, recording = tmp_path / "table.csv", tmp_path / "r.mcap"
    path.write_bytes(Table(LHM_HEAD, US + ",{s},{half},{c},{c}").content)
    assert fantwin("import", path, "-o", recording).exit_code == 0
    assert read_runs(recording).names.names == ("Fan #1", "Fan #2")


def test_a_program_that_writes_tables_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    toy = profiles.Profile(
        "Blower Bench",
        head=(r"Drehzahl \w+", "Uhr"),
        command=(r"Stellwert (?P<fan>\w+)",),
        speed=(r"Drehzahl (?P<fan>\w+)",),
        unit="rpm",
        time=("Uhr",),
        time_unit="ms",
    )
    monkeypatch.setattr(profiles, "PROFILES", (toy, *profiles.PROFILES))
    notes = ("columns of Blower Bench: Drehzahl L: command 'Stellwert L'", "speeds in rpm, as usual for Blower Bench")
    require_imported(Table("Uhr,Drehzahl L,Stellwert L", "{t}000,{s},{c}", (), notes), tmp_path)


def test_damaged_bytes_cost_cells_and_rows_or_are_one_line(tmp_path: Path) -> None:
    rng, path = np.random.default_rng(1), tmp_path / "table.csv"
    contents = [of.content for of in PROGRAMS.values()]
    inserted = [b'"', b"\0", b"\n", b",", b"1e400", b"9" * 20, b"\xff\xfe", b'"""\n']
    for _ in range(2 * N):
        content = bytearray(contents[rng.integers(len(contents))])
        for at in rng.integers(len(content), size=3):
            content[at : at + rng.integers(9)] = inserted[rng.integers(len(inserted))]
        path.write_bytes(bytes(content))
        for read in (preview_of, read_file):
            try:
                read(path, Wanted(("pwm1",), ("fan1:rpm",)))
            except FantwinError as error:
                assert "\n" not in str(error)

"""Fans behind Prometheus: answers as it documents them, pages of exporters, and a real Prometheus."""

from __future__ import annotations

import json
import math
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.shards import process_list
from fantwin.pipeline.sources.kinds import build_source
from fantwin.pipeline.sources.polling import DeviceError
from fantwin.pipeline.sources.prometheus import server
from fantwin.pipeline.sources.prometheus.config import PrometheusConfig
from fantwin.pipeline.sources.prometheus.source import PrometheusSource
from fantwin.pipeline.sources.source import Reading, ReadingBatch, Rejected, SourceContext
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK
from tests.support.delivered import Delivered
from tests.support.fantwin_command import error_of, fantwin
from tests.support.metrics_server import Metrics, metrics_server
from tests.support.ports import free_port
from tests.support.running_chain import eventually

T0 = 1_790_000_000.0
CHIP = "platform_nct6775_656"
EXPORTER = """\
# HELP node_hwmon_fan_rpm Hardware monitor for fan revolutions per minute (input)
# TYPE node_hwmon_fan_rpm gauge
node_hwmon_fan_rpm{chip="platform_nct6775_656",sensor="fan1"} 912
node_hwmon_fan_rpm{chip="platform_nct6775_656",sensor="fan2"} 0
node_hwmon_fan_rpm{chip="platform_nct6775_656",sensor="fan3} broken
node_hwmon_fan_rpm{chip="0000:00:03_1_0000:09:00_0",sensor="fan1"} 1.5e+03
# TYPE node_hwmon_pwm gauge
node_hwmon_pwm{chip="platform_nct6775_656",sensor="pwm1"} 102
node_hwmon_pwm{chip="platform_nct6775_656",sensor="pwm2"} 255
node_hwmon_pwm_enable{chip="platform_nct6775_656",sensor="pwm1"} 5
# TYPE node_hwmon_sensor_label gauge
node_hwmon_sensor_label{chip="platform_nct6775_656",label="CPU \\"A\\" fan",sensor="fan1"} 1
# TYPE ipmi_fan_speed_rpm gauge
ipmi_fan_speed_rpm{id="12",name="Fan1A"} 4560
ipmi_fan_speed_rpm{id="13",name="Fan1B"} NaN
ipmi_fan_speed_ratio{id="12",name="Fan1A"} 0.2195
"""


def fan(number: int) -> dict[str, str]:
    return {
        "speed": f'node_hwmon_fan_rpm{{sensor="fan{number}"}}',
        "command": f'node_hwmon_pwm{{sensor="pwm{number}"}}',
    }


@pytest.fixture(autouse=True)
def nothing_is_shared(monkeypatch: pytest.MonkeyPatch) -> None:
    """An answer is not kept for those who ask soon after."""
    numbers = count()
    monkeypatch.setattr(server, "period_number", lambda _period_s: next(numbers))


@contextmanager
def connected(metrics: Metrics, folder: Path = Path(), **settings: Any) -> Iterator[PrometheusSource]:
    with metrics_server(metrics) as url:
        settings = {"labels": {"chip": CHIP}, "fan": [fan(1), fan(2)], **settings}
        config = PrometheusConfig.model_validate({"url": url, **settings})
        source = PrometheusSource(config, SourceContext(len(config.fan), "rpm", folder))
        source.connect()
        yield source


def shows(metrics: Metrics, **samples: list[tuple[float, float]]) -> None:
    """The samples of sensors, in seconds from T0."""
    metrics.series = [
        (
            {
                "__name__": "node_hwmon_fan_rpm" if sensor.startswith("fan") else "node_hwmon_pwm",
                "chip": CHIP,
                "instance": "node7:9100",
                "sensor": sensor,
            },
            [(T0 + t_s, f"{value}") for t_s, value in values],
        )
        for sensor, values in samples.items()
    ]


def read(source: PrometheusSource) -> list[tuple[float, tuple[float, ...], tuple[float, ...]]]:
    """Times from T0, speeds and commands of what is new."""
    batches = [(round(each.received_t_ns / 1e9 - T0, 6), item) for each in source.read() for item in each.items]
    return [(t_s, item.speed, item.command) for t_s, item in batches if isinstance(item, Reading)]


def test_each_scrape_is_one_reading_with_its_own_time_and_none_is_lost_or_repeated() -> None:
    metrics = Metrics()
    with connected(metrics) as source:
        shows(metrics, fan1=[(0, 900), (15, 910)], fan2=[(0, 0), (15, 0)], pwm1=[(15, 102)], pwm2=[(15, 255)])
        assert read(source) == [(15, (910, 0), (102, 255))], "what came before a start may have been delivered"
        assert read(source) == [], "the same time is no new reading"
        pwms = {"pwm1": [(15, 102), (30.005, 110), (45, 120)], "pwm2": [(15, 255)]}
        shows(metrics, fan1=[(15, 910), (30.005, 920), (45, 930)], fan2=[(15, 0), (30.005, 1)], **pwms)
        (first, second) = read(source)
        assert first == (30.005, (920, 1), (110, 255))
        assert json.dumps(second) == "[45.0, [930.0, NaN], [120.0, 255.0]]", "a fan that vanished costs itself"
        shows(metrics, fan1=[(60, 940)], fan2=[(60, 2)], **pwms)
        assert json.dumps(read(source)) == "[[60.0, [940.0, 2.0], [120.0, NaN]]]", "a command of 45 s before is too old"
    assert metrics.queries[0] == (
        f'{{__name__=~"node_hwmon_fan_rpm|node_hwmon_pwm",chip="{CHIP}",sensor=~"fan1|pwm1|fan2|pwm2"}}[45s]'
    )


def test_a_speed_that_comes_after_later_ones_is_counted() -> None:
    metrics = Metrics()
    with connected(metrics) as source:
        shows(metrics, fan1=[(0, 900)], fan2=[(0, 900)], pwm1=[(0, 1)], pwm2=[(0, 1)])
        read(source)
        shows(metrics, fan1=[(10, 901)], fan2=[(0, 900)], pwm1=[(0, 1)], pwm2=[(0, 1)])
        assert [t_s for t_s, *_ in read(source)] == [10]
        shows(metrics, fan1=[(10, 901)], fan2=[(0, 900), (9, 902)], pwm1=[(0, 1)], pwm2=[(0, 1)])
        (late,) = [item for each in source.read() for item in each.items if isinstance(item, Rejected)]
        assert late.kind == "late_sample" and "make a tray of the fans of each target" in late.detail


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"status": 400}, "refused with HTTP status 400: a parse error; check source.url"),
        ({"status": 302}, "it sends to another address: write that in source.url"),
        ({"status": 403}, "user, password or token is refused, or lacks rights"),
        ({"text": 100_000 * "["}, "it answers, but not as a Prometheus does: correct source.url"),
        ({"text": "<html>Grafana</html>"}, "it answers, but not as a Prometheus does: correct source.url"),
        (
            {"text": '{"data": {"resultType": "vector"}}'},
            "it answers, but not as a Prometheus does: correct source.url",
        ),
        (
            {"series": []},
            f'no sample of {{__name__="node_hwmon_fan_rpm",chip="{CHIP}",sensor="fan1"}} in 45 s, nor of other speeds: '
            "look for it there, correct source.fan",
        ),
    ],
)
def test_what_cannot_be_read_is_one_line(change: dict[str, Any], why: str) -> None:
    metrics = Metrics()
    with connected(metrics) as source:
        shows(metrics, fan1=[(0, 900)])
        for name, value in change.items():
            setattr(metrics, name, value)
        with pytest.raises(DeviceError) as caught:
            source.read()
        assert str(caught.value) == why


def test_a_server_that_is_gone_is_lost() -> None:
    with connected(Metrics()) as source:
        pass
    with pytest.raises(DeviceError, match="^does not answer within 5 s, or cannot be reached: check source.url") as e:
        source.read()
    assert e.value.is_lost


def test_two_series_for_one_value_are_refused_and_not_chosen_from() -> None:
    metrics = Metrics()
    with connected(metrics) as source:
        shows(metrics, fan1=[(0, 900)])
        metrics.series += [({**metrics.series[0][0], "instance": "node8:9100"}, [(T0, "2000")])]
        with pytest.raises(DeviceError, match=r"several series are node_hwmon_fan_rpm.*: add a label in which they di"):
            source.read()


def test_a_label_that_changes_with_the_health_of_a_fan_makes_no_gap() -> None:
    metrics = Metrics()
    ok, critical = ({"__name__": "rpm", "name": "fan_1", "status_code": code} for code in ("ok", "cr"))
    with connected(metrics, labels={}, fan=[{"speed": 'rpm{name="fan_1"}'}]) as source:
        metrics.series = [(ok, [(T0, "900"), (T0 + 15, "890")])]
        assert [speed for _, speed, _ in read(source)] == [(890,)]
        metrics.series = [(critical, [(T0 + 30, "0")]), (ok, [(T0, "900"), (T0 + 15, "890")])]
        assert [(t_s, speed) for t_s, speed, _ in read(source)] == [(30, (0,))]


def test_an_exporter_is_read_itself_and_a_line_that_is_broken_costs_itself() -> None:
    metrics = Metrics()
    metrics.text = EXPORTER
    with connected(metrics, scrape="/metrics", fan=[fan(1), fan(2), fan(3)]) as source:
        began_t_ns = HOST_CLOCK.now_ns()
        (first,) = source.read()
        assert began_t_ns <= first.received_t_ns <= HOST_CLOCK.now_ns(), "without a time, that of the request"
        assert json.dumps([(each.speed, each.command) for each in first.items if isinstance(each, Reading)]) == (
            "[[[912.0, 0.0, NaN], [102.0, 255.0, NaN]]]"
        )
        metrics.text = EXPORTER.replace("912", "nan").replace("255", "+Inf")
        ((_, speed, command),) = read(source)
        assert math.isnan(speed[0]) and math.isnan(command[1])
        twice = 'node_hwmon_fan_rpm{chip="/lpc/nct6798d/0",hardware="/lpc/nct6798d/0"}'
        metrics.text = f"{twice} 900\n{twice} 1200\n"
    with connected(metrics, scrape="/metrics", labels={}, fan=[{"speed": twice}]) as source:
        with pytest.raises(DeviceError, match="several series are"):
            source.read()
        metrics.text = f"{twice} 900 {T0 * 1e3:.0f}\n"
        assert [t_s for t_s, *_ in read(source)] == [0.0], "a time of the exporter is that of the reading"
        assert read(source) == []


@pytest.mark.parametrize(
    ("settings", "header"),
    [
        ({"password_file": "secret"}, "Basic YW5uOmNvcnJlY3QtaG9yc2U="),
        ({"token_file": "secret"}, "Bearer correct-horse"),
    ],
)
def test_credentials_come_from_a_file_and_go_over_an_encrypted_line_only(
    settings: dict[str, str], header: str, tmp_path: Path
) -> None:
    (tmp_path / "secret").write_text("correct-horse\n")
    (tmp_path / "secret").chmod(0o600)
    metrics = Metrics()
    metrics.header = header
    user = "ann@" if "password_file" in settings else ""
    with metrics_server(metrics) as url:

        def made(url: str, **given: str) -> PrometheusSource:
            config = PrometheusConfig.model_validate({"url": url, "fan": [fan(1)], **given})
            return PrometheusSource(config, SourceContext(1, "rpm", tmp_path))

        source = made(url.replace("//", f"//{user}"), **settings)
        assert "ann" not in source.name
        shows(metrics, fan1=[(0, 900)])
        source.connect()
        assert [speed for _, speed, _ in read(source)] == [(900,)]
        nobody = made(url)
        nobody.connect()
        with pytest.raises(DeviceError, match="user, password or token is refused"):
            nobody.read()
    with pytest.raises(DeviceError, match="prom.hall would get the password in the clear: use https"):
        made(f"http://{user}prom.hall", **settings).connect()
    (tmp_path / "secret").chmod(0o644)
    assert "others may read it" in source.check()[0]


@pytest.mark.parametrize(
    "text", ["rate(fan[1m])", 'fan{a=~"b"}', 'fan{a="b"', "fan{a=b}", "{}", "", "fan rpm", 'fan{a="b"}[1m]']
)
def test_a_value_is_one_series_and_no_expression(text: str) -> None:
    with pytest.raises(ValueError, match="name one series, such as node_hwmon_fan_rpm|at least|should have"):
        PrometheusConfig.model_validate({"url": "http://a", "fan": [{"speed": text}]})


def trays(file: Path) -> list[Any]:
    return list(load_config(file, stages=()).trays)


def test_init_writes_a_tray_of_each_device_with_its_fans_and_their_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    metrics = Metrics()
    metrics.text = EXPORTER
    with metrics_server(metrics) as url:
        done = fantwin("init", "--prometheus", f"{url}/metrics")
        assert done.exit_code == 0, done.output
        board, card, server = trays(tmp_path / "fantwin.toml")
        assert [each.name for each in (board, card, server)] == ["127-0-0-1", "127-0-0-1-2", "127-0-0-1-3"]
        assert board.names.names == ('CPU "A" fan', "fan2")
        assert board.command_max == 255
        assert isinstance(server.source, PrometheusConfig)
        assert all(each.command is None for each in server.source.fan), "a share of the top speed may be measured"
        assert "no command is known of fan1: name its series by command" in done.stdout
        source = build_source(board.source, SourceContext(2, "rpm", tmp_path))
        assert isinstance(source, PrometheusSource)
        source.connect()
        assert [speed for _, speed, _ in read(source)] == [(912, 0)]
        metrics.text = "up 1\n"
        none = error_of("init", "--prometheus", f"{url}/metrics", "-c", "new.toml")
    assert none.startswith(f"{url}/metrics: no fans: none of node_hwmon_fan_rpm, ipmi_fan_speed_rpm, idrac_sensors")
    gone = error_of("init", "--prometheus", url, "-c", "new.toml")
    assert gone == f"{url}: does not answer within 5 s, or cannot be reached: check source.url; waiting for it"


USUAL = {
    "idrac_exporter": (
        'idrac_sensors_fan_speed{id="0",name="FAN1A",units="rpm"} 7912\n'
        'idrac_sensors_fan_speed{id="1",name="FAN1B",units="percent"} 42\n',
        ["FAN1A"],
    ),
    "redfish_exporter": (  # whose metric is called rpm, also of a fan in per cent
        'redfish_chassis_fan_rpm{chassis_id="1",fan="Fan 1",fan_id="0",fan_unit="rpm",resource="fan"} 4320\n'
        'redfish_chassis_fan_rpm{chassis_id="1",fan="Fan 2",fan_id="1",fan_unit="percent",resource="fan"} 21\n',
        ["Fan 1"],
    ),
    "Telegraf, IPMI": (
        'ipmi_sensor_value{entity_id="29.10",name="fan_10",server="bmc7",status_code="ok",unit="rpm"} 3000\n'
        'ipmi_sensor_value{entity_id="29.2",name="fan_2",server="bmc7",status_code="cr",unit="rpm"} 0\n'
        'ipmi_sensor_value{entity_id="7.1",name="inlet",server="bmc7",status_code="ok",unit="degrees_c"} 23\n',
        ["fan_2", "fan_10"],
    ),
    "Telegraf, Redfish": (
        'redfish_thermal_fans_reading_rpm{address="bmc7",health="OK",name="System Board Fan1A",state="Enabled"} 17720\n'
        'redfish_thermal_fans_reading_rpm{address="bmc7",health="Warning",name="System Fan2",state="Enabled"} 90\n',
        ["System Board Fan1A", "System Fan2"],
    ),
    "snmp_exporter, ENTITY-SENSOR-MIB": (
        'entPhySensorValue{entPhysicalIndex="1001",entPhysicalName="Tray 1",entPhySensorType="10"} 5100\n'
        'entPhySensorValue{entPhysicalIndex="7",entPhysicalName="CPU",entPhySensorType="8"} 41\n',
        ["Tray 1"],
    ),
    "snmp_exporter, Cisco": (
        'entSensorValue{entPhysicalIndex="3005",entPhysicalName="fan-1",entSensorScale="9",entSensorType="10"} 8000\n'
        'entSensorValue{entPhysicalIndex="3006",entPhysicalName="inlet",entSensorScale="9",entSensorType="8"} 29\n',
        ["fan-1"],
    ),
    "snmp_exporter, Dell": (
        'coolingDeviceReading{coolingDeviceIndex="1",coolingDeviceLocationName="System Board Fan1 RPM"} 2880\n',
        ["System Board Fan1 RPM"],
    ),
    "ipmi_exporter, HPE": ('ipmi_fan_speed_ratio{id="58",name="Fan 1 DutyCycle"} 0.2195\n', None),
    "snmp_exporter, Fortinet": (
        'fgHwSensorEntValue{fgHwSensorEntName="SYS Fan1 Speed",fgHwSensorEntValue="6054"} 1\n',
        None,
    ),
}
"""pages in the form of public reports, and the fans in rpm in them"""


@pytest.mark.parametrize("page", USUAL)
def test_of_the_usual_exporters_only_what_is_in_rpm_is_found_as_a_fan(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    metrics = Metrics()
    metrics.text, fans = USUAL[page]
    with metrics_server(metrics) as url:
        if fans is None:
            assert "no fans: none of" in error_of("init", "--prometheus", f"{url}/metrics")
            return
        assert fantwin("init", "--prometheus", f"{url}/metrics").exit_code == 0
        (tray,) = trays(tmp_path / "fantwin.toml")
        assert list(tray.names.names) == fans
        source = build_source(tray.source, SourceContext(len(fans), "rpm", tmp_path))
        assert isinstance(source, PrometheusSource)
        source.connect()
        ((_, speed, command),) = read(source)
    shown = [line.rpartition(" ")[2] for name in fans for line in metrics.text.splitlines() if f'"{name}"' in line]
    assert list(speed) == list(map(float, shown)) and all(map(math.isnan, command))


def hall(nodes: int) -> list[tuple[dict[str, str], list[tuple[float, str]]]]:
    """Samples of nodes with two chips each, the second without commands."""
    series: list[tuple[dict[str, str], list[tuple[float, str]]]] = []
    for node in range(1, nodes + 1):
        rest = {"instance": f"node{node:03}:9100", "job": "node"}
        for chip, name, sensor in ((CHIP, "fan_rpm", "fan1"), (CHIP, "pwm", "pwm1"), ("drm_card0", "fan_rpm", "fan1")):
            labels = {"__name__": f"node_hwmon_{name}", "chip": chip, "sensor": sensor, **rest}
            series.append((labels, [(T0, f"{1000 + node}"), (T0 + 15.0, f"{1000 + node}")]))
    return series


def test_a_hall_is_a_tray_with_hosts_for_each_kind_of_device_and_one_query_for_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(server, "period_number", lambda _period_s: 1)
    metrics = Metrics()
    metrics.series = hall(20)
    with metrics_server(metrics) as url:
        done = fantwin("init", "--prometheus", url)
        assert done.exit_code == 0, done.output
        text = Path("fantwin.toml").read_text()
        assert text.count("[[tray]]") == 2 and text.count('hosts = ["node[001-020]"]') == 2
        config = load_config(tmp_path / "fantwin.toml", stages=STAGES.keys() & {"acquisition"})
        assert [tray.name for tray in config.trays][18:22] == ["node019", "node020", "node001-2", "node002-2"]
        assert [len(row.shard.trays) for row in process_list(config) if row.stage == "acquisition"] == [40]
        sources = [build_source(tray.source, SourceContext(1, "rpm", tmp_path)) for tray in config.trays]
        metrics.queries.clear()
        for tray, source in zip(config.trays, sources, strict=True):
            assert isinstance(source, PrometheusSource)
            source.connect()
            ((_, speed, command),) = read(source)
            node = 1000 + int(tray.name[4:7])
            assert speed == (node,) and json.dumps(command) == ("[NaN]" if "-" in tray.name else f"[{node}.0]")
        assert len(metrics.queries) == 1
        metrics.queries.clear()
        metrics.status = 503
        monkeypatch.setattr(server, "period_number", lambda _period_s: 2)
        for source in sources:
            with pytest.raises(DeviceError, match="refused with HTTP status 503"):
                source.read()  # type: ignore[attr-defined]
        assert len(metrics.queries) == 1, "a server that is away is not asked by each tray"


@pytest.fixture
def real(tmp_path: Path) -> Iterator[Callable[[str], str]]:
    """Starts a real Prometheus that scrapes an exporter five times a second; gives its address."""
    if not (program := shutil.which("prometheus")):
        pytest.skip("no prometheus here")
    started: list[subprocess.Popen[bytes]] = []

    def start(target: str) -> str:
        job = {"job_name": "node", "static_configs": [{"targets": [target]}]}
        configuration = {"global": {"scrape_interval": "200ms", "scrape_timeout": "200ms"}, "scrape_configs": [job]}
        (tmp_path / "prometheus.yml").write_text(json.dumps(configuration))
        port = free_port()
        words = [f"--config.file={tmp_path}/prometheus.yml", f"--storage.tsdb.path={tmp_path}/data"]
        with (tmp_path / "log").open("w") as log:
            started.append(
                subprocess.Popen([program, *words, f"--web.listen-address=127.0.0.1:{port}"], stdout=log, stderr=log)
            )
        return f"http://127.0.0.1:{port}"

    yield start
    for each in started:
        each.terminate()
        each.wait(20.0)


def test_a_real_prometheus_is_found_by_init_and_gives_every_scrape_once(
    real: Callable[[str], str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    metrics = Metrics()
    metrics.text = EXPORTER.replace('node_hwmon_fan_rpm{chip="platform_nct6775_656",sensor="fan3} broken\n', "")
    with metrics_server(metrics) as exporter:
        url = real(exporter.removeprefix("http://"))

        def is_found() -> bool:
            done = fantwin("init", "--prometheus", url, "-c", "found.toml")
            return done.exit_code == 0 and "period_s" in Path("found.toml").read_text()

        eventually(lambda: is_found() or Path("found.toml").unlink(missing_ok=True), "two scrapes are there")
        board = next(tray for tray in trays(tmp_path / "found.toml") if tray.names.names[0].startswith("CPU"))
        assert board.source.labels["job"] == "node" and board.source.period_s <= 1.0
        source = build_source(board.source, SourceContext(2, "rpm", tmp_path))
        events = Delivered()
        source.start(events.append)
        eventually(lambda: len(events.readings) >= 5, "readings come")
        metrics.text = metrics.text.replace(" 912", " 1500").replace(" 102", " 200")
        eventually(lambda: events.readings[-1].speed == (1500, 0), "the new speed comes")
        source.stop()
    times_ns = [each.received_t_ns for each in events if isinstance(each, ReadingBatch)]
    assert len(set(times_ns)) == len(times_ns) and events.readings[0].command == (102, 255)
    assert events.readings[-1].command == (200, 255) and not events.refused

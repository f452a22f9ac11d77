"""Discovery of fans in what a Prometheus collects, or an exporter shows: each device as a [[tray]]."""

from __future__ import annotations

import re
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.found import Found, alike, checked, keys_in_rpm
from fantwin.pipeline.sources.host_address import by_numbers
from fantwin.pipeline.sources.polling import SLOWEST_S
from fantwin.pipeline.sources.prometheus.config import NAME, Labels, PrometheusConfig, labels_of
from fantwin.pipeline.sources.prometheus.server import Samples, quoted, server_of
from fantwin.schemas.fan_names import is_fan_name
from fantwin.schemas.units import NS_PER_S

BACK_S = 300
"""time before now in which a series has to have a sample"""
SCRAPED_EVERY_S = 1.0


class Metric(NamedTuple):
    """The speeds of an exporter.

    Attributes:
        speed: series of all speeds in rpm.
        fan: labels that may tell the fans of a device apart; the first that a series has does, and the others are left
            out.
        command: metric of their commands, with the same labels, where `fan` is `pwm` in the name; empty: there is none.
        command_max: the largest command.
    """

    speed: str
    fan: tuple[str, ...]
    command: str = ""
    command_max: float = 100.0


METRICS = (
    Metric("node_hwmon_fan_rpm", ("sensor",), "node_hwmon_pwm", 255.0),
    Metric("ipmi_fan_speed_rpm", ("name", "id")),  # ipmi_fan_speed_ratio may be measured, and so no command
    Metric('idrac_sensors_fan_speed{units="rpm"}', ("name", "id")),
    Metric('redfish_chassis_fan_rpm{fan_unit="rpm"}', ("fan", "fan_id")),
    Metric('ipmi_sensor_value{unit="rpm"}', ("name", "entity_id", "status_code", "status_desc")),
    Metric("redfish_thermal_fans_reading_rpm", ("name", "member_id", "health", "state", "severity")),
    Metric('entPhySensorValue{entPhySensorType="10"}', ("entPhysicalName", "entPhysicalDescr", "entPhysicalIndex")),
    Metric('entSensorValue{entSensorType="10"}', ("entPhysicalName", "entPhysicalDescr", "entPhysicalIndex")),
    Metric("coolingDeviceReading", ("coolingDeviceLocationName", "coolingDeviceIndex")),
)
"""node_exporter, ipmi_exporter, idrac_exporter, redfish_exporter, Telegraf (IPMI, Redfish), snmp_exporter
(ENTITY-SENSOR-MIB, Cisco, Dell)"""
_CALLED = "node_hwmon_sensor_label"
"""what the kernel calls the sensors, as label `label`"""
Device = frozenset[tuple[str, str]]
"""the labels that all series of a device have"""


def discover_metrics(url: str, password_file: Path | None, folder: Path) -> list[Found]:
    """The devices with fans. folder: relative paths start here; url: a path that ends in /metrics is an exporter's.

    Raises:
        UserError: the address is none, or cannot be asked, or has no fans.
    """
    address, is_exporter, _ = url.rpartition("/metrics") if url.endswith("/metrics") else (url, "", "")
    asked = {"url": address, **({"password_file": str(password_file)} if password_file else {})}
    if is_exporter:
        asked |= {"scrape": "/metrics", "period_s": SCRAPED_EVERY_S}
    speeds = [labels_of(each.speed)[NAME] for each in METRICS]
    names = [*dict.fromkeys([*speeds, *(each.command for each in METRICS if each.command), _CALLED])]
    config = checked(PrometheusConfig, {**asked, "fan": [{"speed": speeds[0]}]}, "--prometheus", url)
    try:
        server = server_of(config, folder)
        server.connect()
        query = f"{{{NAME}=~{quoted('|'.join(names))}}}[{BACK_S}s]"
        found = server.shown(names) if is_exporter else server.samples(query)
    except UserError as error:
        raise UserError(f"{url}: {error}") from error
    series = [(labels, samples) for labels, samples in found if samples]
    asked |= _period(samples for _, samples in series)
    trays = [tray for metric in METRICS for tray in _trays(metric, series, config.host, asked)]
    if not trays:
        raise UserError(f"{url}: no fans: none of {', '.join(speeds)} in rpm; write source.fan by hand")
    return list(alike(trays, lambda tray: _host(tray["source"]["labels"], config.host)))


def _trays(
    metric: Metric, series: Sequence[tuple[Labels, Samples]], server: str, asked: Mapping[str, Any]
) -> Iterator[Found]:
    """A tray of each device of one kind of exporter."""
    wanted = labels_of(metric.speed)
    devices: dict[Device, dict[str, tuple[str, Samples]]] = {}
    commands: set[tuple[Device, str]] = set()
    names: dict[tuple[Device, str], str] = {}
    for labels, samples in series:
        by = next((name for name in metric.fan if labels.get(name)), metric.fan[0])
        fan = labels.get(by, "")
        rest = {name: value for name, value in labels.items() if name not in (NAME, *metric.fan, "label")}
        device = frozenset(rest.items())
        if wanted.items() <= labels.items():
            devices.setdefault(device, {})[fan] = (by, samples)
        elif labels[NAME] == metric.command:
            commands.add((device, fan))
        elif labels[NAME] == _CALLED:
            names[device, fan] = labels.get("label", "")
    for device, unsorted in devices.items():
        fans = {fan: unsorted[fan] for fan in sorted(unsorted, key=by_numbers)}
        labels = dict(sorted(device))
        rows: list[dict[str, str]] = []
        missing: list[str] = []
        for fan, (by, _) in fans.items():
            rows.append({"speed": f"{wanted[NAME]}{{{by}={quoted(fan)}}}"})
            drive = re.sub(r"^fan(?=\d)", "pwm", fan)
            if (device, drive) in commands:
                rows[-1]["command"] = f"{metric.command}{{{by}={quoted(drive)}}}"
            else:
                missing.append(fan)
        called = {fan: names.get((device, fan), "") for fan in fans}
        shown = [name if is_fan_name(name) else fan for fan, name in called.items()]
        source = {"kind": "prometheus", **asked, "labels": labels, "fan": rows}
        keys = keys_in_rpm(_host(labels, server), shown, metric.command_max, source)
        notes = [
            f"fan {number} is {fan}: {each[-1][1]:.0f} rpm" for number, (fan, (_, each)) in enumerate(fans.items())
        ]
        if len(missing) < len(fans):
            notes.append("commands are the pwms of the same number: check that each moves its fan, as boards differ")
        where = "name its series by command of source.fan, or write command_from"
        lacking = f"no command is known of {', '.join(missing)}: {where}"
        yield Found(
            "prometheus", f"{wanted[NAME]} of {keys['name']}", keys, tuple(notes), (lacking,) if missing else ()
        )


def _host(labels: Labels, server: str) -> str:
    """The host of a device: the target without its port; of an exporter that is read itself, that."""
    return re.sub(r":\d+$", "", labels.get("instance", server))


def _period(scraped: Iterable[Samples]) -> dict[str, float]:
    """The scrape interval, where it shows."""
    spacings_ns = [later - t_ns for samples in scraped for (t_ns, _), (later, _) in pairwise(samples)]
    return (
        {"period_s": min(max(round(statistics.median(spacings_ns) / NS_PER_S, 1), 0.1), SLOWEST_S)}
        if spacings_ns
        else {}
    )

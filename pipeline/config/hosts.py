"""One [[tray]] for many devices alike: `hosts` names them, and {host} and {name} in its texts stand for each.

[[tray]]
hosts = ["bmc[001-400].hall", { host = "bmc501.hall", rack = "B7" }]
fans = 2
source = { kind = "redfish", url = "https://operator@{host}", password_file = "secrets" }
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from typing import Any

from fantwin.pipeline.sources.host_address import hosts_of

MOST_TRAYS = 4096
ABOUT = (
    "instead of name: devices alike, each a tray: names, ranges (`bmc[001-400].hall`), or tables { host = ..., KEY = "
    "... }; texts may contain {host}, {name} (the host without its domain) and {KEY}"
)
_PLACE = re.compile(r"\{([a-z_]+)\}")


def each_tray(trays: Any) -> Any:
    """The tables of trays, where one with `hosts` stands for all of them. What is no list of tables stays as it is.

    Raises:
        ValueError: hosts that are none, or a text with a place that a host has no value for.
    """
    if not isinstance(trays, list):
        return trays
    found: list[Any] = []
    for tray in trays:
        if isinstance(tray, dict) and "hosts" in tray:
            found += _trays_of(tray)
        else:
            found.append(tray)
    return found


def _trays_of(template: Mapping[str, Any]) -> list[dict[str, Any]]:
    rest = {key: value for key, value in template.items() if key != "hosts"}
    places = list(_each_host(template["hosts"]))
    if len(places) > MOST_TRAYS:
        raise ValueError(f"hosts: {len(places)} are more than {MOST_TRAYS}")
    trays = [{"name": each["name"], **_filled(rest, each)} for each in places]
    if len({str(tray.get("source")) for tray in trays}) < len(trays):
        raise ValueError('hosts: several would be one device: write {host} in source, such as url = "https://{host}"')
    return trays


def _each_host(hosts: Any) -> Iterator[dict[str, str]]:
    if not isinstance(hosts, list) or not hosts:
        raise ValueError('hosts: give a list, such as ["bmc[001-400].hall"]')
    for each in hosts:
        values = {"host": each} if isinstance(each, str) else each
        is_table = isinstance(values, dict) and all(isinstance(value, str) for value in values.values())
        if not is_table or "host" not in values:
            raise ValueError(f"hosts: {each!r}: give a name, a range, or a table of texts with host")
        for host in hosts_of(values["host"]):
            yield {"name": name_of(host), **values, "host": host}


def name_of(host: str) -> str:
    """The name of the tray of a host: the host without its domain; of an address, or with a port, all of it."""
    is_address = re.fullmatch(r"[0-9a-fA-F.:]+", host) or ":" in host
    return re.sub(r"[^A-Za-z0-9_-]", "-", host if is_address else host.partition(".")[0])


def _filled(value: Any, values: Mapping[str, str]) -> Any:
    """The same with the values of a host in the places of its texts."""
    if isinstance(value, dict):
        return {key: _filled(each, values) for key, each in value.items()}
    if isinstance(value, list):
        return [_filled(each, values) for each in value]
    if not isinstance(value, str):
        return value
    for place in _PLACE.findall(value):
        if place not in values:
            raise ValueError(f"hosts: {value!r}: host {values['host']} has no {place}")
    return _PLACE.sub(lambda match: values[match[1]], value)

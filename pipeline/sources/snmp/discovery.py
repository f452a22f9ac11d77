"""Discovery of the fans behind SNMP: sensors in rpm of the ENTITY-SENSOR-MIB (RFC 3433), with their scales."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.found import Found, checked, found_at, keys_in_rpm
from fantwin.pipeline.sources.snmp.config import SnmpConfig
from fantwin.pipeline.sources.snmp.source import SnmpSource
from fantwin.pipeline.sources.source import SourceContext

SENSORS = "1.3.6.1.2.1.99.1.1.1"
TYPE, SCALE, PRECISION, VALUE, UNIT = (f"{SENSORS}.{column}" for column in (1, 2, 3, 4, 6))
NAME = "1.3.6.1.2.1.47.1.1.1.1.7"
"""entPhysicalName"""
RPM, UNITS = "10", 9
"""type of a sensor in rpm; scale that stands for units, each step from it for a factor of 1,000"""


def discover_snmp(host: str, password_file: Path | None, folder: Path) -> list[Found]:
    """The [[tray]] of an agent, USER@HOST for version 3, or of those of a range; see `found_at`."""
    return found_at(
        "--snmp", host, lambda each: _discover(each, password_file, folder), lambda tray: tray["source"]["host"]
    )


def _discover(text: str, password_file: Path | None, folder: Path) -> Found:
    if password_file is None:
        raise UserError(f"--snmp {text}: give --password-file, a file with the community, or of USER@ the password")
    user, _, host = text.rpartition("@")
    secret = {"user": user, "password_file": str(password_file)} if user else {"community_file": str(password_file)}
    asked: dict[str, Any] = {"host": host, **secret}
    config = checked(SnmpConfig, {**asked, "fan": [{"speed": f"{VALUE}.1"}]}, "--snmp", text)
    source = SnmpSource(config, SourceContext(0, "rpm", folder))
    try:
        source.connect()
        types, scales, precisions, units, names = map(source.walk, (TYPE, SCALE, PRECISION, UNIT, NAME))
        values = source.walk(VALUE)
    except UserError as error:
        raise UserError(f"{text}: {error}") from error
    finally:
        source.disconnect()
    rpm = [index for index, each in types.items() if each == RPM]
    fans = [index for index in rpm if "%" not in units.get(index, "")]
    if not fans:
        why = f": {len(rpm)} say that they are in rpm, and show {units[rpm[0]]}" if rpm else ""
        raise UserError(f"{text}: no fans in rpm in its ENTITY-SENSOR-MIB{why}; name objects by source.fan")
    rows: list[dict[str, Any]] = []
    for index in fans:
        name = f"{VALUE}.{index}"
        try:
            scale = 1000.0 ** (int(scales.get(index, UNITS)) - UNITS) / 10.0 ** int(precisions.get(index, 0))
        except (ValueError, ArithmeticError) as error:
            why = f"scale {scales.get(index)!r}, precision {precisions.get(index)!r}"
            raise UserError(f"{text}: {names.get(index, index)} has {why}: name objects by source.fan") from error
        rows.append({"speed": name if scale == 1.0 else {"name": name, "scale": scale}})
    called = [names.get(index, "") for index in fans]
    keys = keys_in_rpm(host, called, 100.0, {"kind": "snmp", **asked, "fan": rows})
    notes = [
        f"fan {number} is {names.get(index, index)}: {values.get(index, 'nothing')} shown"
        for number, index in enumerate(fans)
    ]
    lacking = "no command is known: name an object of the maker's MIB by command of source.fan, or write command_from"
    return Found("snmp", f"snmp {host}", keys, tuple(notes), (lacking,))

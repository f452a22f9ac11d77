"""Discovery of the fans behind SNMP: sensors in rpm of the ENTITY-SENSOR-MIB (RFC 3433), with their scales."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.found import Found, found_at
from fantwin.pipeline.sources.named_values import HIGHEST_RPM
from fantwin.pipeline.sources.snmp.config import SnmpConfig
from fantwin.pipeline.sources.snmp.source import SnmpSource
from fantwin.pipeline.sources.source import SourceContext
from fantwin.schemas.fan_names import is_fan_name

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
    user, _, host = text.rpartition("@")
    secret = {"user": user, "password_file": str(password_file)} if user else {"community_file": str(password_file)}
    asked: dict[str, Any] = {"host": host, **(secret if password_file else {})}
    try:
        config = SnmpConfig.model_validate({**asked, "fan": [{"speed": f"{VALUE}.1"}]})
    except ValidationError as error:
        why = error.errors()[0]["msg"].removeprefix("Value error, ").replace("community_file", "--password-file")
        raise UserError(f"--snmp {text}: {why}") from error
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
    called = [names.get(index, "") for index in fans]
    are_names = len({each.casefold() for each in called}) == len(called) and all(map(is_fan_name, called))
    rows: list[dict[str, Any]] = []
    for index in fans:
        scale = 1000.0 ** (int(scales.get(index, UNITS)) - UNITS) / 10.0 ** int(precisions.get(index, 0))
        name = f"{VALUE}.{index}"
        rows.append({"speed": name if scale == 1.0 else {"name": name, "scale": scale}})
    keys = {
        "name": host,
        "fans": called if are_names else len(fans),
        "speed_unit": "rpm",
        "speed_max": HIGHEST_RPM,
        "command_max": 100,
        "source": {"kind": "snmp", **asked, "fan": rows},
    }
    notes = [
        f"fan {number} is {names.get(index, index)}: {values.get(index, 'nothing')} shown"
        for number, index in enumerate(fans)
    ]
    lacking = "no command is known: name an object of the maker's MIB by command of source.fan"
    return Found("snmp", f"snmp {host}", keys, tuple(notes), (lacking,))

"""Discovery of the fans behind IPMI."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.found import Found, checked, found_at, keys_in_rpm
from fantwin.pipeline.sources.ipmi.config import IpmiConfig
from fantwin.pipeline.sources.ipmi.source import RPM, IpmiSource
from fantwin.pipeline.sources.source import SourceContext


def discover_ipmi(url: str, password_file: Path | None, folder: Path) -> list[Found]:
    """The [[tray]] of a controller, or of those of a range; see `found_at`."""
    return found_at(
        "--ipmi",
        url,
        lambda each: _discover(each, password_file, folder),
        lambda tray: IpmiConfig.model_validate(tray["source"]).host,
    )


def _discover(url: str, password_file: Path | None, folder: Path) -> Found:
    asked: dict[str, Any] = {"url": url, **({"password_file": str(password_file)} if password_file else {})}
    config = checked(IpmiConfig, {**asked, "fan": [{"speed": RPM}]}, "--ipmi", url)
    source = IpmiSource(config, SourceContext(0, "rpm", folder))
    try:
        source.connect()
        sensors = source.sensors("Fan")
    except UserError as error:
        raise UserError(f"{url}: {error}") from error
    finally:
        source.disconnect()
    fans = [each for each in sensors if each.unit == RPM]
    if not fans:
        there = ", ".join(f"{each.name} ({each.unit or 'no number'})" for each in sensors) or "none"
        raise UserError(f"{url}: no fans in rpm; its sensors of fans: {there}")
    are_different = len({each.name for each in fans}) == len(fans)
    rows = [{"speed": each.name if are_different else each.number} for each in fans]
    keys = keys_in_rpm(config.host, [each.name for each in fans], 100.0, {"kind": "ipmi", **asked, "fan": rows})
    notes = [f"fan {number} is {each.name}: {each.value:g} rpm" for number, each in enumerate(fans)]
    others = ", ".join(each.name for each in sensors if each.unit == "percent")
    sensor = f"name a sensor in per cent by command of source.fan ({others or 'it has none'})"
    lacking = f"no command is known: {sensor}, or write command_from"
    return Found("ipmi", f"ipmi {config.host}", keys, tuple(notes), (lacking,))

"""Discovery of the fans behind IPMI."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.found import Found, found_at
from fantwin.pipeline.sources.ipmi.config import IpmiConfig
from fantwin.pipeline.sources.ipmi.source import RPM, IpmiSource
from fantwin.pipeline.sources.named_values import HIGHEST_RPM
from fantwin.pipeline.sources.source import SourceContext
from fantwin.schemas.fan_names import is_fan_name


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
    try:
        config = IpmiConfig.model_validate({**asked, "fan": [{"speed": RPM}]})
    except ValidationError as error:
        raise UserError(f"--ipmi {url}: {error.errors()[0]['msg'].removeprefix('Value error, ')}") from error
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
    are_names = len({each.name.casefold() for each in fans}) == len(fans) and all(
        is_fan_name(each.name) for each in fans
    )
    names = [each.name if are_names else each.number for each in fans]
    keys = {
        "name": config.host,
        "fans": names if are_names else len(fans),
        "speed_unit": "rpm",
        "speed_max": HIGHEST_RPM,
        "command_max": 100,
        "source": {"kind": "ipmi", **asked, "fan": [{"speed": name} for name in names]},
    }
    notes = [f"fan {number} is {each.name}: {each.value:g} rpm" for number, each in enumerate(fans)]
    others = ", ".join(each.name for each in sensors if each.unit == "percent")
    lacking = f"no command is known: name a sensor in per cent by command of source.fan ({others or 'it has none'})"
    return Found("ipmi", f"ipmi {config.host}", keys, tuple(notes), (lacking,))

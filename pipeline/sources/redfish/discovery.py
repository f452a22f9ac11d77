"""Discovery of the fans behind a baseboard controller."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.sources.found import HIGHEST_RPM, Found, checked, found_at
from fantwin.pipeline.sources.redfish.config import RedfishConfig
from fantwin.pipeline.sources.redfish.source import RedfishSource
from fantwin.pipeline.sources.source import SourceContext


def discover_controllers(url: str, password_file: Path | None, folder: Path) -> list[Found]:
    """The [[tray]] of a controller, or of those of a range; see `found_at`."""
    return found_at("--redfish", url, lambda each: discover_controller(each, password_file, folder), _host)


def _host(tray: Mapping[str, Any]) -> str:
    return RedfishConfig.model_validate(tray["source"]).parts.netloc.rpartition("@")[2]


def discover_controller(url: str, password_file: Path | None, folder: Path) -> Found:
    """The [[tray]] of a controller with its fans. Nothing is written to it. folder: relative paths start here.

    Raises:
        UserError: the address is none, the controller cannot be asked, or it has no fans.
    """
    config = checked(RedfishConfig, {"url": url, "password_file": password_file}, "--redfish", url)
    source = RedfishSource(config, SourceContext(0, "rpm", folder))
    try:
        source.connect()
        fans, problem = source.fans_there()
    except UserError as error:
        raise UserError(f"{url}: {error}") from error
    finally:
        source.disconnect()
    if not fans:
        raise UserError(f"{url}: it has no fans")
    notes = [f"fan {number} is {fan.name}: {_shown(fan.rpm)} rpm" for number, fan in enumerate(fans)]
    lacking = [fan.name for fan in fans if math.isnan(fan.command)]
    if lacking and not problem:
        problem = f"no command is known of {', '.join(lacking)}: say where by source.command"
    are_named = len({fan.called.casefold() for fan in fans} - {""}) == len(fans)
    named = {"fan": [{"name": fan.called, "place": fan.place} for fan in fans]}
    keys = {
        "name": config.host if re.fullmatch(r"[0-9a-f.:]+", config.host) else config.host.partition(".")[0],
        **(named if are_named else {"fans": len(fans)}),
        "speed_unit": "rpm",
        "speed_max": HIGHEST_RPM,
        "command_max": 100,
        "source": {
            "kind": "redfish",
            "url": url,
            **({"password_file": str(password_file)} if password_file else {}),
            "fans": [fan.name for fan in fans],
        },
    }
    missing = (problem,) if problem else ()
    return Found("redfish", f"controller {config.address}{config.chassis}", keys, tuple(notes), missing)


def _shown(rpm: float) -> str:
    return "no" if math.isnan(rpm) else f"{rpm:.0f}"

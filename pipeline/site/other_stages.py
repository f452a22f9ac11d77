"""What other stages have by the same configuration: recordings, the operators' page, and Rerun's viewer."""

from __future__ import annotations

import socket
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from fantwin.pipeline.config.loading import parse_config
from fantwin.pipeline.config.registry import RECORDER
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.config.shards import StageProcess, own_file, process_list, shards_of
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.runtime.stage import Context
from fantwin.pipeline.site.loopback import LOOPBACK

GATEWAY, VIEWER = "gateway", "viewer"
_ANY_HOST = ("0.0.0.0", "::")


def configured(context: Context, *stages: str) -> Config | None:
    """The configuration with the sections of other stages; None: one is not enabled, or its section is wrong."""
    if context.configuration_path is None:
        return None
    try:
        found = parse_config(context.configuration_text, context.configuration_path, context.overrides, stages)
    except UserError:
        return None
    return found if set(stages) <= set(found.stages) else None


def expected_stages(context: Context) -> Sequence[StageProcess]:
    """The processes of this one's trays that the configuration asks for; none if it is not known here."""
    config, trays = configured(context), {tray.name for tray in context.trays}
    found = process_list(config) if config else ()
    return [each for each in found if not trays.isdisjoint(each.shard.trays)]


def recordings_of(config: Config) -> Sequence[Path]:
    """The first part of the recording of each recorder of the site, as far as they are on this host."""
    file: Path = config.sections[RECORDER].file  # pyright: ignore[reportAttributeAccessIssue]
    return [config.run_folder / own_file(shard.name, file) for shard in shards_of(RECORDER, config)]


def page_address(context: Context) -> str:
    """The address of the operators' page, as far as the configuration says it; empty: there is none.

    A page on loopback is reached by the name of its proxy if it has one, otherwise on this host only.
    """
    config = configured(context, GATEWAY)
    if config is None:
        return ""
    section: Any = config.sections[GATEWAY]
    names = [name for name in section.hosts if name not in ("*", "localhost", "127.0.0.1", "[::1]")]
    if section.is_loopback and names:
        return f"https://{names[0]}/"
    numbers = {tray: shard.number for shard in shards_of(GATEWAY, config) for tray in shard.trays}
    port = section.port + min((numbers[tray.name] for tray in context.trays if tray.name in numbers), default=1) - 1
    host = socket.getfqdn() if section.host in _ANY_HOST else section.host
    host = f"[{host}]" if ":" in host else host
    return f"{'https' if section.certificate else 'http'}://{host}:{port}/"


def viewer_urls(config: Config) -> Mapping[str, str]:
    """By tray, the address of Rerun's viewer for browsers, which only this host reaches; empty: it is not served.

    A live viewer of Rerun 0.41 takes neither a time nor a fan in its address.
    """
    section = config.sections[VIEWER]
    grpc_port, web_port = (getattr(section, name) for name in ("grpc_port", "web_port"))
    if not (grpc_port and web_port):
        return {}
    return {
        tray: f"http://{LOOPBACK}:{web_port + shard.number - 1}/?url="
        + quote(f"rerun+http://{LOOPBACK}:{grpc_port + shard.number - 1}/proxy", safe="")
        for shard in shards_of(VIEWER, config)
        for tray in shard.trays
    }

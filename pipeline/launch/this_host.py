"""The configuration as `fantwin up` runs it on this host: without stages whose extra is missing, and with free ports.

Both choices are added to the overrides, so that every stage and the recording know them.
"""

from __future__ import annotations

import errno
import json
from collections.abc import Callable, Collection, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.registry import GATEWAY, STAGES, VIEWER
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.config.shards import Shard, process_list
from fantwin.pipeline.extras import missing_extra
from fantwin.pipeline.http_server import listening_socket
from fantwin.pipeline.site.loopback import LOOPBACK

_PORTS = 1000
"""number of ports that are tried, from the configured one on"""


@dataclass(frozen=True)
class ThisHost:
    """The configuration that runs here.

    Attributes:
        overrides: those given, and the choices of this module.
        left_out: a line for each stage that is left out.
    """

    config: Config
    overrides: tuple[str, ...]
    left_out: tuple[str, ...]


def load_for_this_host(path: Path, overrides: Sequence[str] = (), stages: Sequence[str] | None = None) -> ThisHost:
    """Load a configuration without the stages whose extra is missing, unless `launcher.stages` names them.

    stages: those whose sections are checked, see `load_config`.

    Raises:
        ConfigError: see `load_config`.
    """
    return _loaded(path, overrides, stages, missing_extra)


def load_for_any_host(path: Path, overrides: Sequence[str] = (), stages: Sequence[str] | None = None) -> Config:
    """Load a configuration without the stages that need an extra, unless `launcher.stages` names them.

    The host that runs the site may lack what is installed here.

    Raises:
        ConfigError: see `load_config`.
    """
    return _loaded(path, overrides, stages, lambda what, _extra: what).config


def _loaded(
    path: Path, overrides: Sequence[str], stages: Sequence[str] | None, why_not: Callable[[str, str], str]
) -> ThisHost:
    """why_not: says why a stage that needs an extra is left out; empty if it is not."""
    config = load_config(path, overrides, stages)
    optional = [name for name in config.stages if STAGES[name].extra and config.launcher.stages is None]
    found = {name: why_not(f"stage {name} is left out: it", STAGES[name].extra) for name in optional}
    left_out = {name: line for name, line in found.items() if line}
    if left_out:
        overrides = (*overrides, f"launcher.without={json.dumps([*config.launcher.without, *left_out])}")
        config = load_config(path, overrides, stages)
    return ThisHost(config, tuple(overrides), tuple(left_out.values()))


def with_free_ports(host: ThisHost, trays: Collection[str] | None) -> ThisHost:
    """The same, with free ports for the operators' page and for live viewers where the configuration sets none.

    trays: of this host, see `process_list`.
    """
    overrides = host.overrides
    for stage, key in ((GATEWAY, "port"), (VIEWER, "grpc_port")):
        section: Any = host.config.sections.get(stage)
        shards = [row.shard.number - 1 for row in process_list(host.config, trays) if row.stage == stage]
        if not shards or key in section.model_fields_set:
            continue
        configured = getattr(section, key)
        at, above = (section.host, {0}) if stage == GATEWAY else (LOOPBACK, {0, section.web_port - configured})
        needed = [number + more for number in shards for more in above]
        ports = range(configured, configured + _PORTS)
        port = next((port for port in ports if _are_free(at, [port + more for more in needed])), configured)
        if port != configured:
            overrides = (*overrides, f"{stage}.{key}={port}")
    if overrides == host.overrides:
        return host
    return ThisHost(load_config(host.config.path, overrides), overrides, host.left_out)


def page_addresses(config: Config, trays: Collection[str] | None = None) -> list[str]:
    """The addresses of the operators' page on this host, one for each shard of the gateway; none without it."""
    if GATEWAY not in config.sections:
        return []
    section: Any = config.sections[GATEWAY]
    scheme = "https" if section.certificate else "http"
    return [f"{scheme}://{section.host}:{section.port + shard.number - 1}/" for shard in _pages(config, trays)]


def _pages(config: Config, trays: Collection[str] | None) -> list[Shard]:
    return [row.shard for row in process_list(config, trays) if row.stage == GATEWAY]


def _are_free(host: str, ports: Sequence[int]) -> bool:
    with ExitStack() as opened:
        try:
            for port in ports:
                opened.enter_context(listening_socket(host, port))
        except OSError as error:
            return error.errno != errno.EADDRINUSE  # other reasons hold for every port, and the stage names them
    return True

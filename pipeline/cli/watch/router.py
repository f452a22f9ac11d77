"""`fantwin router`: connects stages on several hosts or in containers."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fantwin.pipeline.bus.opening import credentials_of
from fantwin.pipeline.bus.rights import SiteRoles
from fantwin.pipeline.bus.router import open_router
from fantwin.pipeline.cli.exposure import InsecureOption, checked_exposure
from fantwin.pipeline.cli.options import DEFAULT_CONFIG, JsonOption, SetOption
from fantwin.pipeline.cli.printing import show
from fantwin.pipeline.config.loading import load_config
from fantwin.pipeline.config.roles import ROUTER
from fantwin.pipeline.config.settings import BusConfig
from fantwin.pipeline.errors import UsageError
from fantwin.pipeline.runtime.signals import stop_on_signals

_LOOPBACK = "tcp/127.0.0.1:7447"
_WARN_AGAIN_S = 86_400.0


def router(
    config: Annotated[
        Path | None,
        typer.Option(
            "-c",
            "--config",
            help="Configuration of the site: certificates and roles. Default: "
            f"{DEFAULT_CONFIG}, if it is in this folder.",
        ),
    ] = None,
    listen: Annotated[
        str | None, typer.Option(help=f"Where to listen; default bus.endpoint, or without a configuration {_LOOPBACK}.")
    ] = None,
    connect: Annotated[
        list[str] | None, typer.Option(help="Where another router of the site listens. Repeatable.")
    ] = None,
    insecure: InsecureOption = False,
    overrides: SetOption = None,
    json_output: JsonOption = False,
) -> None:
    """Run a Zenoh router until Ctrl-C, for stages with bus.mode = "client".

    On one host no router is needed. With bus.security in the configuration, only clients with a certificate of the
    site's authority connect, and each may do only what its role allows (docs/how-to/security.md). Restart the router
    when trays, shards or controllers of the configuration change.

    A site may have two routers, which --connect joins; clients that name both use one that runs.

    Example: fantwin router -c fantwin.toml

    Example: fantwin router -c fantwin.toml --listen tls/0.0.0.0:7447 --connect tls/other.example:7447
    """
    if config is None and DEFAULT_CONFIG.exists():
        config = DEFAULT_CONFIG
    if overrides and config is None:
        raise UsageError(f"--set needs a configuration: give one with -c FILE, there is no {DEFAULT_CONFIG} here")
    settings = load_config(config, overrides or (), stages=()) if config else None
    if settings and listen is None and len(settings.bus.endpoints) > 1:
        raise UsageError("bus.endpoint names several routers: say with --listen which one this is")
    configured = settings.bus if settings else BusConfig(endpoint=_LOOPBACK)
    bus = configured.model_copy(update={"endpoint": listen}) if listen else configured
    credentials = credentials_of(bus, (ROUTER,))
    site = SiteRoles.of(settings) if settings and credentials else None
    stop = stop_on_signals()
    with (
        checked_exposure(bus, lambda line: typer.echo(line, err=True), insecure=insecure),
        open_router(bus.endpoint, credentials, site, bus.zenoh, connect or ()),
    ):
        rules = f": TLS, {len(site.roles)} roles of site {site.site!r}" if site else ""
        show({"listening": bus.endpoint}, f"router listening on {bus.endpoint}{rules}", json_output=json_output)
        while True:
            if credentials and (warning := credentials.warning()):
                typer.echo(warning, err=True)
            if stop.wait(_WARN_AGAIN_S):
                return

"""`fantwin router`: connects stages on several hosts or in containers."""

from __future__ import annotations

import json
import threading
from typing import Annotated

import typer

from pipeline.bus.router import open_router
from pipeline.cli.options import JsonOption
from pipeline.runtime.signals import stop_on_signals


def router(
    listen: Annotated[str, typer.Option(help="Where to listen.")] = "tcp/127.0.0.1:7447",
    connect: Annotated[
        list[str] | None, typer.Option(help="Where another router of the site listens. Repeatable.")
    ] = None,
    json_output: JsonOption = False,
) -> None:
    """Run a Zenoh router until Ctrl-C, for stages with bus.mode = "client".

    On one host no router is needed. By default it listens on loopback only: on other addresses, anyone who reaches
    the port can read and write everything.

    Two routers of a site connect to each other, and clients that name both use the one that is there.

    Example: fantwin router --listen tcp/0.0.0.0:7447 --connect tcp/other.example:7447
    """
    stop = threading.Event()
    stop_on_signals(stop)
    with open_router(listen, connect or ()):
        typer.echo(json.dumps({"listening": listen}) if json_output else f"router listening on {listen}")
        stop.wait()

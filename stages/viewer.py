"""Viewer: shows twin, measurement, states and alarms live in Rerun.

Reads `score`, `alarm` and `snapshot`; writes nothing. One core serves all trays. Speeds are shown in
the unit of the tray. Samples are collected and drawn twice a second, because a call into Rerun is expensive and a row
in it is cheap.

With more than 64 fans, only some are drawn: those in alarm, as far as there is room, and those in `show`. Of the scores
of other trays, two a second are decoded.

Samples and alarms are on the time line, at the time of the sample; wear has a timeline of its own.
It may drop messages: the runner keeps a bounded queue in front of it and counts what it drops.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path

from pydantic import Field

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.config.settings import ConfigUsageError, TrayConfig, nearest
from fantwin.pipeline.errors import refusals
from fantwin.pipeline.extras import missing_extra, require
from fantwin.pipeline.outputs.rerun.fleet_view import is_fleet
from fantwin.pipeline.runtime.stage import BuiltStage, Context, Stage, StageConfig, StageError
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.loopback import check_free

PAGE_ABOVE_DATA = 100
"""distance from the port of the data to that of the page, so that a hundred shards have room on one host"""
PORTS = {"grpc_port": "viewer.grpc_port", "web_port": "the page of viewer.grpc_port"}
FILE_BYTES = 1_000_000_000
"""size at which the view's file ends"""


class ViewerConfig(StageConfig):
    """Section `[viewer]`."""

    file: str = Field(
        default="",
        description='file in run_folder for the view, such as "view.rrd"; if it exists, it is kept, and view-2.rrd is '
        'written. "": no file; `fantwin view` makes one from a recording',
    )
    grpc_port: int = Field(
        default=9876,
        ge=0,
        le=65535 - PAGE_ABOVE_DATA,
        description="port on this host (127.0.0.1) for the data of live viewers; the page of those in a browser has "
        "the port 100 above it; not set, `fantwin up` chooses free ones from there on; shard K uses the K-th; 0: no "
        "live viewers",
    )
    show: tuple[str, ...] = Field(
        default=(),
        max_length=64,
        description='fans of a fleet that always have a plot, by number or name: ["tray1/3", "tray2/CPU"]',
    )

    @property
    def web_port(self) -> int:
        """The port of the browser viewer's page; 0: no page."""
        return self.grpc_port + PAGE_ABOVE_DATA if self.grpc_port else 0


def shown_fans(names: Iterable[str], trays: Sequence[TrayConfig]) -> list[Fan]:
    """The fans named in `viewer.show`.

    Raises:
        StageError: a name is not `tray/fan`, or there is no such fan.
    """
    by_name = {tray.name: tray for tray in trays}
    found: list[Fan] = []
    for name in names:
        tray, _, number = name.rpartition("/")
        if not (tray and number):
            raise StageError(f'viewer.show: {name!r} is no fan; write "tray/fan", for example "{trays[0].name}/0"')
        if tray not in by_name:
            raise StageError(f"viewer.show: {name!r}: no tray called {tray!r}{nearest(tray, by_name)}")
        try:
            found.append(Fan(tray, by_name[tray].fan_called(number)))
        except ConfigUsageError as error:
            raise StageError(f"viewer.show: {name!r}: {error}") from error
    return list(dict.fromkeys(found))


def build(context: Context) -> BuiltStage:
    """Open the file and serve the viewers.

    Raises:
        StageError: Rerun is not installed, a port is taken, the file cannot be written, or `show` names no fan.
    """
    require("stage viewer", "view", "rerun")
    from fantwin.pipeline.outputs.rerun.rerun_sink import ViewOptions  # noqa: PLC0415  an extra
    from fantwin.pipeline.outputs.rerun.viewer_core import view_of_site  # noqa: PLC0415  an extra

    config: ViewerConfig = context.config
    ports = _ports(context)
    options = ViewOptions(
        show=shown_fans(config.show, context.trays),
        file_bytes=FILE_BYTES,
        grpc_port=ports.get("grpc_port"),
        web_port=ports.get("web_port"),
    )
    file = context.own_file(Path(config.file)) if config.file else None
    return BuiltStage(view_of_site(context.site, context.trays, context.started_t_ns, file, options))


def _ports(context: Context) -> dict[str, int]:
    """The ports that are served, by key: as configured, and one more for each further shard, which may be on this
    host."""
    config: ViewerConfig = context.config
    configured = {"grpc_port": config.grpc_port, "web_port": config.web_port} if config.grpc_port else {}
    return {key: port + context.shard_number - 1 for key, port in configured.items() if port}


def check(context: Context) -> list[str]:
    """Report a missing extra, fans to show that do not exist, and ports that another program has taken."""
    config: ViewerConfig = context.config
    problems = list(filter(None, [missing_extra("stage viewer", "view", "rerun")]))
    if not (config.file or config.grpc_port):
        problems.append("viewer.grpc_port = 0 and no viewer.file: nothing would be shown; set one of them")
    ports = {} if context.is_running else _ports(context)
    attempts = [partial(check_free, port, PORTS[key], "viewer.grpc_port = 0") for key, port in ports.items()]
    return [*problems, *refusals(partial(shown_fans, config.show, context.trays), *attempts)]


def topics_read(_config: ViewerConfig, trays: Sequence[TrayConfig]) -> tuple[str, ...]:
    """Topics of trays. Of a fleet, the wear is not drawn: the snapshots of its scorers are many megabytes a minute."""
    return tuple(topic for topic in STAGES["viewer"].reads if topic != "snapshot" or not is_fleet(trays))


STAGE = Stage(
    row=STAGES["viewer"],
    about="shows measured speed, twin, band, alarms and states live in Rerun, and in a file if `file` names one",
    config=ViewerConfig,
    build=build,
    core_per_tray=False,
    undecoded=("score",),
    check=check,
    chooses=topics_read,
)

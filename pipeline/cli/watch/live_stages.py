"""Waiting until the stages of a site have been heard."""

from __future__ import annotations

import threading
import time

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.models import Config
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.schemas.topics import alive_key

_DISCOVERY_S = 5.0  # every stage sends several health messages in this time
_POLL_S = 0.02


def wait_for_stages(
    bus: Bus,
    watcher: SiteWatcher,
    config: Config,
    stop: threading.Event,
    what: str = "alarms",
    tray: str | None = None,
) -> None:
    """Wait until every stage that is alive has sent its health: requests and answers then reach all of them.

    tray: that must have a scorer; None: one of any tray is enough.

    Raises:
        UserError: no such scorer is alive.
    """
    until_s = time.monotonic() + _DISCOVERY_S
    scorer = alive_key(config.site, "scorer", "")
    while True:
        heard = {alive_key(config.site, view.health.stage, view.health.instance) for view in watcher.stages()}
        alive = bus.alive(alive_key(config.site, "*", "*"))
        if tray is None:
            scorers = {key for key in alive if key.startswith(scorer)}
        else:
            owner = watcher.owner("scorer", tray)
            scorers = alive & {scorer + owner.instance} if owner else set[str]()
        if scorers & heard and alive <= heard:
            return
        if time.monotonic() > until_s or stop.wait(_POLL_S):
            break
    if not scorers:
        has_others = any(key.startswith(scorer) for key in alive)
        of_tray = f" for tray {tray}" if tray and has_others else ""
        where = f"no scorer of site {config.site!r} answers at {config.bus.endpoint}{of_tray}"
        raise UserError(f"{what} unknown: {where}; is `fantwin up -c {config.path}` running?")

"""The scorers of a running site: waiting until they are heard, and one request with its answers."""

from __future__ import annotations

import queue
import secrets
import threading
import time
from dataclasses import replace

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.site.one_line import readable_alarm
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.schemas.codec import CodecError, decode, encode, type_name
from fantwin.schemas.fan_names import NO_NAMES, FanNames
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Request
from fantwin.schemas.topics import BY_NAME, alive_key, tray_key

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


_ANSWER_POLL_S = 0.05


def ask(
    bus: Bus,
    site: str,
    tray: str,
    request: Request,
    fans: set[int],
    timeout_s: float,
    stop: threading.Event,
    watcher: SiteWatcher,
    names: FanNames = NO_NAMES,
) -> list[Alarm]:
    """Publish a request and return the answers for `fans`, in the order of their numbers. names: of the tray's fans.

    The stages must have been discovered before, or the request may reach none of them. `watcher` knows whose answers
    count: those of the session that owns the scorer.

    Raises:
        UserError: an answer is missing after `timeout_s`, or there is no right to ask.
    """
    producer = f"alarms-{tray}-{secrets.token_hex(2)}-{bus.id}"
    publisher = bus.publisher(tray_key(site, tray, "request"), BY_NAME["request"], type_name(Request), producer)
    name = f"{producer}/{publisher.published}"
    received: queue.Queue[bytes] = queue.Queue()
    key = tray_key(site, tray, "alarm")
    bus.subscribe(key, lambda _key, payload: received.put(payload))
    bus.require_rights(stop)
    publisher.put(encode(replace(request, header=Header(producer, publisher.published, tray))))
    answers: dict[int, Alarm] = {}
    until_s = time.monotonic() + timeout_s
    while set(answers) < fans:
        if time.monotonic() > until_s or stop.is_set():
            missing = names.labels(sorted(fans - set(answers)))
            raise UserError(
                f"tray {tray}: no answer for {missing} within {timeout_s:g} s: perhaps no scorer runs, "
                "for example because the tray has no twin yet: see `fantwin status`"
            )
        try:
            alarm = decode(Alarm, received.get(timeout=_ANSWER_POLL_S))
        except (queue.Empty, CodecError):
            continue
        if alarm.request == name and watcher.counts(key, alarm.header.producer):
            answers[alarm.fan] = readable_alarm(alarm)
    return [answers[fan] for fan in sorted(fans)]

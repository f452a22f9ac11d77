"""One request to the scorer of a tray, and its answers."""

from __future__ import annotations

import queue
import secrets
import threading
import time
from dataclasses import replace

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.errors import UserError
from fantwin.pipeline.site.one_line import readable_alarm
from fantwin.pipeline.site.site_watcher import SiteWatcher
from fantwin.schemas.codec import CodecError, decode, encode, type_name
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Request
from fantwin.schemas.topics import BY_NAME, tray_key

_POLL_S = 0.05


def ask(
    bus: Bus,
    site: str,
    tray: str,
    request: Request,
    fans: set[int],
    timeout_s: float,
    stop: threading.Event,
    watcher: SiteWatcher,
) -> list[Alarm]:
    """Publish a request and return the answers for `fans`, in the order of their numbers.

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
            missing = ", ".join(map(str, sorted(fans - set(answers))))
            raise UserError(
                f"tray {tray}: no answer for fan {missing} within {timeout_s:g} s: perhaps no scorer runs, "
                "for example because the tray has no twin yet: see `fantwin status`"
            )
        try:
            alarm = decode(Alarm, received.get(timeout=_POLL_S))
        except (queue.Empty, CodecError):
            continue
        if isinstance(alarm, Alarm) and alarm.request == name and watcher.counts(key, alarm.header.producer):
            answers[alarm.fan] = readable_alarm(alarm)
    return [answers[fan] for fan in sorted(fans)]

"""An Alertmanager as a target: it is given the alarms that are presented now, again and again, and those that are over.

Nothing waits for it: what it missed while it was away is sent when it answers. An alert that is not sent again expires
there by itself.
"""

from __future__ import annotations

import base64
import json
import time
import urllib.error
import urllib.request
from collections.abc import Sequence
from datetime import UTC, datetime
from http.client import HTTPException
from typing import Any
from urllib.parse import unquote, urlsplit, urlunsplit

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.outputs.notify.outbox import Outbox
from fantwin.pipeline.outputs.notify.sending import Failure, TargetThread
from fantwin.pipeline.outputs.notify.wording import Place, describe
from fantwin.schemas.units import NS_PER_S
from fantwin.scoring.alarms.current_alarms import CurrentAlarm

RESEND_S = 60.0
EXPIRES_S = 5 * RESEND_S
TIMEOUT_S = 10.0
FiringKey = tuple[str, int, str, int]
"""tray, fan, severity in words, onset: of an alert that an Alertmanager has"""
MOST_AT_ONCE = 500
"""alerts in a request"""
ALERT_NAME, TEST_ALERT_NAME = "FantwinFanAlarm", "FantwinTest"


class Alertmanager:
    """Its address; a user and a password may be part of it."""

    def __init__(self, url: str) -> None:
        """Check the URL.

        Raises:
            UserError: it is none of http or https.
        """
        try:
            parts = urlsplit(url)
            is_usable = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
        except ValueError:
            parts, is_usable = urlsplit(""), False
        if not is_usable:
            raise UserError("an Alertmanager needs a URL of http or https, such as http://127.0.0.1:9093")
        host = parts.netloc.rpartition("@")[2]
        self._url = urlunsplit((parts.scheme, host, f"{parts.path.rstrip('/')}/api/v2/alerts", "", ""))
        self._headers = {"Content-Type": "application/json"}
        if parts.username:
            login = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
            self._headers["Authorization"] = f"Basic {base64.b64encode(login.encode()).decode()}"

    def post(self, alerts: Sequence[dict[str, Any]]) -> Failure | None:
        """Give it alerts; None: it has taken them."""
        for first in range(0, len(alerts), MOST_AT_ONCE):
            body = json.dumps(alerts[first : first + MOST_AT_ONCE]).encode()
            request = urllib.request.Request(self._url, body, self._headers, method="POST")
            try:
                with urllib.request.urlopen(request, timeout=TIMEOUT_S) as answer:
                    answer.read()
            except urllib.error.HTTPError as error:
                with error:
                    return Failure(f"it answers {error.code} {error.reason}")
            except (OSError, HTTPException) as error:
                return Failure(str(getattr(error, "reason", error)) or type(error).__name__)
        return None


def alert(place: Place, current: CurrentAlarm, now_ns: int) -> dict[str, Any]:
    """An alarm that is active, as Alertmanager takes it. Without another one it expires after EXPIRES_S."""
    lines = describe(place, current)
    return {
        **_labels(place, _key(current), now_ns),
        "endsAt": _rfc3339(now_ns + round(EXPIRES_S * NS_PER_S)),
        "annotations": {"summary": lines[0], "description": "\n".join(lines[1:])},
        "generatorURL": place.page_of(current.newest),
    }


def resolved(place: Place, key: FiringKey, now_ns: int) -> dict[str, Any]:
    """The same once it is over."""
    return {**_labels(place, key, now_ns), "endsAt": _rfc3339(now_ns)}


def test_alert(place: Place, target: str, now_ns: int) -> dict[str, Any]:
    """An alert that says that it is a test, and expires after a minute."""
    return {
        "labels": {"alertname": TEST_ALERT_NAME, "site": place.site, "severity": "none"},
        "startsAt": _rfc3339(now_ns),
        "endsAt": _rfc3339(now_ns + 60 * NS_PER_S),
        "annotations": {"summary": f"A test of target {target} of the notifier at {place.site}"},
        "generatorURL": place.page,
    }


class AlertSender(TargetThread):
    """Keeps an Alertmanager in line with the alarms."""

    def __init__(self, target: str, manager: Alertmanager, outbox: Outbox, place: Place) -> None:
        super().__init__(target, outbox, RESEND_S)
        self._manager = manager
        self._place = place
        self._wanted: Sequence[CurrentAlarm] | None = None
        """None: it is not known yet"""
        self._firing: list[FiringKey] = []
        """what this process has sent; what another one has sent before expires there"""

    def want(self, alarms: Sequence[CurrentAlarm]) -> None:
        """Set the alarms that Alertmanager is to have now, and no others."""
        if alarms != self._wanted:
            self._wanted = alarms
            self.wake()

    def _deliver_all(self) -> Failure | None:
        now_ns = time.time_ns()
        wanted = self._wanted
        if wanted is None:
            return None
        keys = [_key(each) for each in wanted]
        still = {key[:3] for key in keys}
        over = [key for key in self._firing if key[:3] not in still]
        alerts = [alert(self._place, each, now_ns) for each in wanted]
        alerts += [resolved(self._place, key, now_ns) for key in over]
        self.attempts += 1
        if alerts and (failure := self._manager.post(alerts)) is not None:
            return failure
        self.sent += len(alerts)
        self._firing = keys
        return None


def _key(current: CurrentAlarm) -> FiringKey:
    alarm = current.newest
    return alarm.header.tray, alarm.fan, alarm.severity.name.lower(), alarm.onset_t_ns


def _labels(place: Place, key: FiringKey, now_ns: int) -> dict[str, Any]:
    tray, fan, severity, onset_t_ns = key
    labels = {"alertname": ALERT_NAME, "site": place.site, "tray": tray, "fan": str(fan), "severity": severity}
    # the clock of a device may be ahead of that of the host, and a start after the end is refused
    return {"labels": labels, "startsAt": _rfc3339(min(max(onset_t_ns, 0), now_ns))}


def _rfc3339(t_ns: int) -> str:
    return datetime.fromtimestamp(t_ns / NS_PER_S, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")

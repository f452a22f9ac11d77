"""The targets of a configuration with their secrets: what sends to each."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from fantwin.pipeline.errors import UserError
from fantwin.pipeline.extras import require
from fantwin.pipeline.outputs.notify.alertmanager import Alertmanager, AlertSender, test_alert
from fantwin.pipeline.outputs.notify.config import NotifierConfig, TargetConfig
from fantwin.pipeline.outputs.notify.mail_and_chat import Service
from fantwin.pipeline.outputs.notify.outbox import Outbox
from fantwin.pipeline.outputs.notify.sending import Failure, Sender, TargetThread
from fantwin.pipeline.outputs.notify.wording import Place, test_text
from fantwin.pipeline.sources.secret_file import read_secret

Resolve = Callable[[Path], Path]
"""A path of the configuration file as one of the file system."""


def connection_of(target: TargetConfig, resolve: Resolve) -> Service | Alertmanager:
    """What delivers to it. Nothing is sent yet.

    Raises:
        UserError: its URL cannot be had or used, or the extra is not installed.
    """
    try:
        if target.kind == "alertmanager":
            return Alertmanager(read_secret(resolve(target.url_file)))
        require(target.kind, "outputs", "apprise")
        return Service(read_secret(resolve(target.url_file)))
    except UserError as error:
        raise UserError(f"target {target.name}: {error}") from error


def sender_of(target: TargetConfig, resolve: Resolve, outbox: Outbox, place: Place) -> TargetThread:
    """The thread that sends to it, not yet started.

    Raises:
        UserError: see `connection_of`.
    """
    connection = connection_of(target, resolve)
    if isinstance(connection, Alertmanager):
        return AlertSender(target.name, connection, outbox, place)
    return Sender(target.name, connection.deliver, outbox, connection.pause_s)


def send_test(target: TargetConfig, resolve: Resolve, place: Place) -> Failure | None:
    """Send a message that says that it is a test; None: it has arrived.

    Raises:
        UserError: see `connection_of`.
    """
    connection, now_ns = connection_of(target, resolve), time.time_ns()
    if isinstance(connection, Alertmanager):
        return connection.post([test_alert(place, target.name, now_ns)])
    return connection.deliver(test_text(place, target.name, now_ns))


def problems_of(config: NotifierConfig, trays: tuple[str, ...] | None, resolve: Resolve) -> list[str]:
    """What would keep targets from getting anything, a line each. trays: those of the site; None: not known."""
    if not config.target:
        return ["no targets: add a table [[notifier.target]] with a name and url_file, or take [notifier] out"]
    problems: list[str] = []
    for target in config.target:
        if trays is not None and (unknown := [tray for tray in target.trays if tray not in trays]):
            problems.append(f"target {target.name}: there is no tray {', '.join(unknown)}")
        try:
            connection_of(target, resolve)
        except UserError as error:
            problems.append(str(error))
    return problems

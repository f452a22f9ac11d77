"""OPC UA: a server with each fan as an object and each alarm as a condition of Part 9 (docs/how-to/opcua.md).

Reads `score`, `alarm` and `twin`, and writes `request`. One core serves all trays.

The server runs in a thread of its own: it reads what the core has collected, and leaves requests for the core to send.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fantwin.pipeline.config.registry import STAGES
from fantwin.pipeline.errors import refusals
from fantwin.pipeline.extras import missing_extra, require
from fantwin.pipeline.outputs.opcua.config import OpcuaConfig
from fantwin.pipeline.runtime.stage import BuiltStage, Context, Stage
from fantwin.pipeline.site.alarm_history import FILE, AlarmHistory
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.request_desk import RequestDesk
from fantwin.pipeline.site.site_core import SiteCore
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.schemas.enums import Transition
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.messages import Alarm, Message

if TYPE_CHECKING:
    from fantwin.pipeline.outputs.opcua.server import OpcuaServer

CERTIFICATE, KEY = Path("opcua-certificate.der"), Path("opcua-key.pem")


class OpcuaCore(SiteCore):
    """Collects what the server shows, and sends what operators ask."""

    def __init__(self, model: SiteModel, desk: RequestDesk, server: OpcuaServer) -> None:
        super().__init__(model, desk)
        self._server = server

    def add_score(self, envelope: Envelope) -> None:
        """Keep it."""
        self._model.add_score(envelope)

    def add_alarm(self, alarm: Alarm) -> None:
        """Keep it; a transition becomes an event."""
        is_new = self._model.add_alarm(alarm)
        current = self._model.current_alarm(Fan(alarm.header.tray, alarm.fan))
        if is_new and current is not None and alarm.transition != Transition.REFUSED:
            self._server.publish(current)

    def close(self) -> Sequence[Message]:
        """Stop the server, and close the history."""
        self._server.stop()
        return super().close()

    def counters(self) -> Mapping[str, int]:
        """Requests and events sent, clients, and what could not be shown."""
        return {**super().counters(), **self._server.counters()}

    def problem(self) -> str:
        """Problem of the server, the users and the history."""
        return "; ".join(filter(None, (self._server.problem, super().problem())))


def _serve(context: Context, model: SiteModel, desk: RequestDesk) -> OpcuaServer:
    from fantwin.pipeline.certificates import check_pair, make_self_signed, require_valid  # noqa: PLC0415  slow to import
    from fantwin.pipeline.outputs.opcua.server import Listening, OpcuaServer, application_uri  # noqa: PLC0415
    from fantwin.pipeline.outputs.opcua.sessions import LogIn, TrustedClients  # noqa: PLC0415
    from fantwin.pipeline.site.users import Users  # noqa: PLC0415

    config: OpcuaConfig = context.config
    if config.certificate and config.key:
        certificate, key = context.resolve(config.certificate), context.resolve(config.key)
    else:
        hosts = (socket.gethostname(), "localhost", *([config.host] if config.is_loopback else []))
        certificate, key = context.own_file(CERTIFICATE), context.own_file(KEY)
        make_self_signed(certificate, key, "fantwin OPC UA server", application_uri(context.site), hosts)
    shown = check_pair(certificate, key, needs_rsa=True)
    require_valid(shown)
    uri = next(iter(shown.uris), application_uri(context.site))
    port = config.port + context.shard_number - 1
    users = Users(context.resolve(config.users)) if config.users else None
    return OpcuaServer(
        Listening(config.host, port, certificate, key, uri, config.is_loopback),
        model,
        desk,
        LogIn(users, is_open=config.is_loopback),
        TrustedClients(context.resolve(config.trusted) if config.trusted else None),
    )


def build(context: Context) -> BuiltStage:
    """Open the history and listen.

    Raises:
        StageError: the extra is not installed, the port is taken, or a file cannot be read or written.
    """
    require("stage opcua", "outputs", "asyncua")
    model = SiteModel(context.site, context.trays, AlarmHistory(context.own_file(FILE)))
    desk = RequestDesk(context.producer)
    return BuiltStage(OpcuaCore(model, desk, _serve(context, model, desk)))


def check(context: Context) -> list[str]:
    """Report a missing extra, a port that another program has taken, and files that cannot be read."""
    if problem := missing_extra("stage opcua", "outputs", "asyncua"):
        return [problem]
    from fantwin.pipeline.certificates import check_pair, require_valid  # noqa: PLC0415  slow to import
    from fantwin.pipeline.http_server import listen  # noqa: PLC0415
    from fantwin.pipeline.site.users import read_accounts  # noqa: PLC0415

    config: OpcuaConfig = context.config
    attempts: list[Callable[[], object]] = []
    if config.certificate and config.key:
        files = context.resolve(config.certificate), context.resolve(config.key)
        attempts.append(lambda: require_valid(check_pair(*files, needs_rsa=True)))
    if config.users:
        users = context.resolve(config.users)
        attempts.append(lambda: read_accounts(users))
    if not context.is_running:
        attempts.append(lambda: listen(config.host, config.port + context.shard_number - 1, "opcua").close())
    problems = refusals(*attempts)
    if config.trusted and not context.resolve(config.trusted).is_dir():
        problems.append(f"opcua.trusted = {str(config.trusted)!r}: there is no such folder")
    return problems


STAGE = Stage(
    row=STAGES["opcua"],
    about="serves fans and alarms by OPC UA",
    config=OpcuaConfig,
    build=build,
    core_per_tray=False,
    undecoded=("score",),
    check=check,
)

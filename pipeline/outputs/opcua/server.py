"""The OPC UA server, in a thread and an event loop of its own."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

import asyncio
import contextlib
import logging
import socket
import threading
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from asyncua import Server, ua

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.outputs.opcua.address_space import SiteAddressSpace, build_address_space
from fantwin.pipeline.outputs.opcua.encoding import NAMESPACE
from fantwin.pipeline.outputs.opcua.events import EventDelivery
from fantwin.pipeline.outputs.opcua.history import EventHistory
from fantwin.pipeline.outputs.opcua.methods import Methods
from fantwin.pipeline.outputs.opcua.sessions import LogIn, Permissions, SiteServer, TrustedClients
from fantwin.pipeline.outputs.opcua.site_values import SiteValues
from fantwin.pipeline.runtime.stage import StageError
from fantwin.pipeline.site.request_desk import RequestDesk
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.scoring.alarms.current_alarms import CurrentAlarm

UPDATE_PERIOD_S = 1.0
START_LIMIT_S, STOP_LIMIT_S = 120.0, 5.0
MOST_PENDING = 20_000
"""transitions that wait to become events; of more, the oldest are left out, and clients are asked to refresh"""
_AT_ONCE = 200
"""values that are published before others may do something"""


@dataclass(frozen=True)
class Listening:
    """Where the server listens, and how it shows who it is.

    uri: of the application, as its certificate names it. is_open: whoever does not log in may read, unencrypted.
    """

    host: str
    port: int
    certificate: Path
    key: Path
    uri: str
    is_open: bool


class OpcuaServer:
    """Answers from the start until it is stopped."""

    def __init__(
        self,
        listening: Listening,
        model: SiteModel,
        desk: RequestDesk,
        log_in: LogIn,
        trusted: TrustedClients,
    ) -> None:
        """Raises:
        StageError: it cannot listen there, or does not start.
        """
        for name in ("asyncua", "asyncio"):  # of each client that leaves without a word they say a lot
            logging.getLogger(name).setLevel(logging.CRITICAL)
        self._listening, self._model, self._desk = listening, model, desk
        self._log_in, self._trusted = log_in, trusted
        self._site: str = model.site
        self._trays: Sequence[TrayConfig] = model.trays
        self._pending: deque[CurrentAlarm] = deque()
        self._lock = threading.Lock()
        self._lost_unsaid = False
        self._error = ""
        self._is_ready = threading.Event()
        self._events_sent = self._events_lost = self._clients = 0
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread = threading.Thread(target=self._run, name="OPC UA server", daemon=True)
        self._thread.start()
        if not self._is_ready.wait(START_LIMIT_S):
            raise StageError(f"the OPC UA server does not start within {START_LIMIT_S:.0f} s")
        if self._error:
            raise StageError(self._error)

    @property
    def problem(self) -> str:
        """Empty while it answers."""
        ended = "" if self._thread.is_alive() else "the OPC UA server has ended: restart the stage"
        return "; ".join(filter(None, (self._error, ended, self._log_in.problem)))

    def counters(self) -> Mapping[str, int]:
        """Clients, and events that were sent and left out."""
        return {"clients": self._clients, "events_sent": self._events_sent, "events_left_out": self._events_lost}

    def publish(self, current: CurrentAlarm) -> None:
        """Send an event to all subscribers; never waits."""
        with self._lock:
            if len(self._pending) >= MOST_PENDING:
                self._pending.popleft()
                self._events_lost += 1
                self._lost_unsaid = True
            self._pending.append(current)
        self._wake()

    def stop(self) -> None:
        """End it; clients are cut off."""
        loop = self._loop
        if loop is not None and self._thread.is_alive():
            loop.call_soon_threadsafe(self._stopping.set)
        self._thread.join(STOP_LIMIT_S)

    def _wake(self) -> None:
        loop = self._loop
        if loop is not None and self._thread.is_alive():
            loop.call_soon_threadsafe(self._woken.set)

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        except Exception as error:  # noqa: BLE001  of a library, in a thread: the stage reports it
            self._error = self._error or f"the OPC UA server has failed: {type(error).__name__}: {error}"
        self._is_ready.set()

    async def _serve(self) -> None:
        self._stopping, self._woken = asyncio.Event(), asyncio.Event()
        server, nodes, values, delivery = await self._made()
        try:
            await server.start()
        except OSError as error:
            where = f"opcua.host = {self._listening.host!r}, opcua.port = {self._listening.port}"
            self._error = f"{where}: cannot listen there ({error.strerror or error}): choose another one"
            return
        self._loop = asyncio.get_running_loop()
        self._is_ready.set()
        tasks = [
            asyncio.create_task(self._stopping.wait()),
            asyncio.create_task(self._publish_values(server, nodes, values)),
            asyncio.create_task(self._publish_events(delivery)),
        ]
        self._wake()
        done, others = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in others:
            task.cancel()
        await self._end(server)
        for task in done:
            task.result()

    async def _made(self) -> tuple[Server, SiteAddressSpace, SiteValues, EventDelivery]:
        iserver = SiteServer(self._log_in, self._trusted)
        server = Server(iserver=iserver)
        await server.init()
        listening = self._listening
        await server.load_certificate(listening.certificate)
        await server.load_private_key(listening.key)
        await server.set_application_uri(listening.uri)
        server.set_server_name(f"fantwin {self._site}")
        server.application_type = ua.ApplicationType.Server
        server.product_uri = "urn:fantwin"
        host = listening.host.strip("[]")
        server.set_endpoint(f"opc.tcp://{f'[{host}]' if ':' in host else host}:{listening.port}/fantwin")
        server.socket_address = (host, listening.port)
        policies = [
            ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
            ua.SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
        ]
        tokens: list[type] = [ua.UserNameIdentityToken]
        if listening.is_open:
            policies.append(ua.SecurityPolicyType.NoSecurity)
            tokens.append(ua.AnonymousIdentityToken)
        server.set_security_policy(policies, permission_ruleset=Permissions(self._log_in))  # type: ignore[arg-type]
        server.set_identity_tokens(tokens)
        nodes = iserver.site_nodes
        namespace = nodes.namespace = await server.register_namespace(NAMESPACE)
        values = SiteValues(self._model, namespace)
        of_site = await build_address_space(server, nodes, self._site, self._trays, values.of)
        delivery = EventDelivery(iserver.subscription_service, namespace, self._trays)
        Methods(self._model, self._desk, of_site, delivery).bind(server, namespace)
        iserver.history_manager.set_storage(EventHistory(self._model, namespace))
        return server, nodes, values, delivery

    async def _publish_values(self, server: Server, nodes: SiteAddressSpace, values: SiteValues) -> None:
        """Once a second: what has changed, to those who subscribe to it."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            values.use(await asyncio.to_thread(values.newest))
            for number, (handle, watched) in enumerate(list(nodes.watched.items())):
                if handle in nodes.watched:
                    await watched.publish(handle)
                if number % _AT_ONCE == _AT_ONCE - 1:
                    await asyncio.sleep(0)
            self._clients = len(server.iserver.asyncio_transports)
            due_s = max(due_s + UPDATE_PERIOD_S, loop.time())
            await asyncio.sleep(due_s - loop.time())

    async def _publish_events(self, delivery: EventDelivery) -> None:
        while True:
            await self._woken.wait()
            self._woken.clear()
            with self._lock:
                taken, lost = list(self._pending), self._lost_unsaid
                self._pending.clear()
                self._lost_unsaid = False
            await delivery.to_all(taken)
            self._events_sent += len(taken)
            if lost:
                await delivery.ask_for_refresh()

    async def _end(self, server: Server) -> None:
        for transport in list(server.iserver.asyncio_transports):
            transport.abort()
        with contextlib.suppress(TimeoutError):  # the thread ends with its loop
            await asyncio.wait_for(server.stop(), STOP_LIMIT_S / 2)


def application_uri(site: str) -> str:
    """Of a server whose certificate names none."""
    return f"urn:{socket.gethostname()}:fantwin:{site}"

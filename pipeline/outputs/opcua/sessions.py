"""The sessions of clients: who has logged in, and the filters of his subscriptions."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable
from contextvars import ContextVar
from typing import Any

from asyncua import Node, ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import User as LibraryUser
from asyncua.crypto.permission_rules import UserRole
from asyncua.server.address_space import AttributeService, MethodService, NodeManagementService, ViewService
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from asyncua.server.subscription_service import SubscriptionService
from asyncua.server.user_managers import UserManager

from fantwin.pipeline.outputs.opcua.address_space import SiteAddressSpace
from fantwin.pipeline.outputs.opcua.event_filter import as_the_library_evaluates
from fantwin.pipeline.outputs.opcua.log_in import LogIn, SessionUser, TrustedClients

MOST_CONNECTIONS = 100
MOST_SUBSCRIPTIONS = 200
SHORTEST_PUBLISHING_MS = 100.0
EVENT_QUEUE, DATA_QUEUE = 10_000, 5
"""events, and at most values, that wait for a client"""

CURRENT_SESSION: ContextVar[SiteSession] = ContextVar("session")
"""the session for which a method runs"""
_ADDRESS: ContextVar[str] = ContextVar("address")
"""of the client that logs in"""


class SiteServer(InternalServer):
    """The server of the library, with the users and the nodes of a site."""

    def __init__(self, log_in: LogIn, trusted: TrustedClients) -> None:
        super().__init__(_SiteUsers(log_in))
        self.log_in, self.trusted = log_in, trusted
        self.allow_remote_admin = False
        self.max_connections = MOST_CONNECTIONS
        self.max_subscriptions = MOST_SUBSCRIPTIONS
        self.site_nodes = self.aspace = SiteAddressSpace()
        self.attribute_service, self.view_service = AttributeService(self.aspace), ViewService(self.aspace)
        self.method_service, self.node_mgt_service = MethodService(self.aspace), NodeManagementService(self.aspace)
        self.subscription_service = SubscriptionService(self.aspace, iserver=self)
        inside = LibraryUser(role=UserRole.Admin)
        self.isession = InternalSession(self, self.aspace, self.subscription_service, "Internal", user=inside)
        self.current_time_node = Node(self.isession, ua.NodeId(ua.ObjectIds.Server_ServerStatus_CurrentTime))
        self.server_status_node = Node(self.isession, ua.NodeId(ua.ObjectIds.Server_ServerStatus))

    def create_session(self, name: str, user: LibraryUser | None = None, external: bool = False) -> InternalSession:
        """A session of a client."""
        return SiteSession(self, self.aspace, self.subscription_service, name, SessionUser(), external=external)

    def register_server(self, server: Any, conf: Any = None) -> None:
        """Refuse: this is no discovery server."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)

    def decrypt_user_token(self, isession: Any, token: ua.UserNameIdentityToken) -> tuple[str, str]:
        """Name and password. The padding of PKCS #1 1.5 can be guessed from answers (Bleichenbacher): it is refused."""
        if (token.EncryptionAlgorithm or "").endswith("rsa-1_5"):
            raise ServiceError(ua.StatusCodes.BadIdentityTokenInvalid)
        return super().decrypt_user_token(isession, token)


class SiteSession(InternalSession):
    """The session of a client."""

    iserver: Any  # SiteServer
    user: Any

    def __init__(self, *args: Any, external: bool = False) -> None:
        super().__init__(*args, external=False)
        # a session can be continued by whoever knows its token, and the library counts them
        self.auth_token = ua.NodeId(secrets.token_bytes(32), 0, ua.NodeIdType.ByteString)
        self.external = external
        if external:
            self.iserver.register_external_session(self)

    @property
    def operator_name(self) -> str:
        """Of the user if he is an operator; empty: he may not act."""
        return str(self.user.name) if self.iserver.log_in.is_operator(self.user) else ""

    def activate_session(
        self, params: ua.ActivateSessionParameters, peer_certificate: bytes | None
    ) -> ua.ActivateSessionResult:
        """Log in. A channel without a signature is not encrypted, and takes no passwords.

        Raises:
            ServiceError: he may not.
        """
        address = self.name[0] if isinstance(self.name, tuple) else str(self.name)
        certificate = peer_certificate if params.ClientSignature.Signature else None
        if certificate is None and isinstance(params.UserIdentityToken, ua.UserNameIdentityToken):
            raise ServiceError(ua.StatusCodes.BadSecurityModeInsufficient)
        if certificate is not None and not self.iserver.trusted.trusts(certificate):
            self.iserver.log_in.log_untrusted(address)
            raise ServiceError(ua.StatusCodes.BadCertificateUntrusted)
        _ADDRESS.set(address)
        return super().activate_session(params, peer_certificate)

    async def call(self, params: list[ua.CallMethodRequest]) -> list[ua.CallMethodResult]:
        """Methods: those of one call run side by side, as each waits for its scorer."""
        CURRENT_SESSION.set(self)
        results = await asyncio.gather(*(self.iserver.method_service.call([each]) for each in params))
        return [result for each in results for result in each]

    async def create_subscription(
        self,
        params: ua.CreateSubscriptionParameters,
        callback: Callable[..., Any],
        request_callback: Callable[..., Any] | None = None,
    ) -> ua.CreateSubscriptionResult:
        """A subscription. One that asks for no interval gets the shortest."""
        interval_ms = max(SHORTEST_PUBLISHING_MS, params.RequestedPublishingInterval)
        params.RequestedPublishingInterval = ua.Double(interval_ms)
        return await super().create_subscription(params, callback, request_callback)

    async def create_monitored_items(self, params: ua.CreateMonitoredItemsParameters) -> Any:
        """Monitored items. No event is dropped because a client asks for a short queue."""
        for item in params.ItemsToCreate:
            wanted = item.RequestedParameters
            is_event = item.ItemToMonitor.AttributeId == ua.AttributeIds.EventNotifier
            wanted.QueueSize = ua.UInt32(EVENT_QUEUE if is_event else max(1, min(wanted.QueueSize, DATA_QUEUE)))
            if is_event and isinstance(wanted.Filter, ua.EventFilter):
                namespace = self.iserver.site_nodes.namespace
                wanted.Filter.WhereClause = as_the_library_evaluates(wanted.Filter.WhereClause, namespace)
        return await super().create_monitored_items(params)

    async def modify_monitored_items(self, params: ua.ModifyMonitoredItemsParameters) -> Any:
        """Monitored items. No event is dropped because a client asks for a short queue later; here none can be told
        from a value."""
        for item in params.ItemsToModify:
            item.RequestedParameters.QueueSize = ua.UInt32(EVENT_QUEUE)
        return await super().modify_monitored_items(params)


class _SiteUsers(UserManager):
    def __init__(self, log_in: LogIn) -> None:
        self._log_in = log_in

    def get_user(self, iserver: Any, username: Any = None, password: Any = None, certificate: Any = None) -> Any:
        """As the library asks for it."""
        return self._log_in.user(username, password, _ADDRESS.get())

"""The sessions of clients: who logs in, what he may do, and the filters of his subscriptions."""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from asyncua import Node, ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import USER_TYPES, PermissionRuleset, UserRole
from asyncua.crypto.permission_rules import User as LibraryUser
from asyncua.server.address_space import AttributeService, MethodService, NodeManagementService, ViewService
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from asyncua.server.subscription_service import SubscriptionService
from asyncua.server.user_managers import UserManager
from cryptography import x509
from cryptography.hazmat.primitives.serialization import Encoding

from fantwin.pipeline.outputs.opcua.address_space import SiteAddressSpace
from fantwin.pipeline.outputs.opcua.events import as_the_library_evaluates
from fantwin.pipeline.site.security_log import LoginFailures, SecurityLog
from fantwin.pipeline.site.users import User, Users
from fantwin.pipeline.site.users import UserRole as SiteRole


@dataclass
class SessionUser(LibraryUser):
    """may_act: whether he is an operator. name: empty for whoever is not logged in."""

    may_act: bool = False
    password_hash: str = ""
    """with which he has logged in"""


class Permissions(PermissionRuleset):
    """Which services are open: nobody writes, and nobody changes the address space."""

    def __init__(self, log_in: LogIn) -> None:
        self._log_in = log_in
        refused = {ua.ObjectIds.WriteRequest_Encoding_DefaultBinary}
        self._open = {ua.NodeId(kind) for kind in USER_TYPES if kind not in refused}

    def check_validity(self, user: Any, action_type: ua.NodeId, body: Any) -> bool:
        """Whether a service is open to a user, who may have been removed since he logged in."""
        return action_type in self._open and self._log_in.may_read(user)


class TrustedClients:
    """The certificates in a folder, read again when somebody connects."""

    def __init__(self, folder: Path | None) -> None:
        """folder: None: all clients are trusted."""
        self._folder = folder

    def trusts(self, certificate: bytes) -> bool:
        """Whether a client's certificate (DER) is among them."""
        if self._folder is None:
            return True
        for path in sorted(self._folder.glob("*")):
            try:
                found = path.read_bytes()
                is_pem = found.startswith(b"-----")
                der = x509.load_pem_x509_certificate(found).public_bytes(Encoding.DER) if is_pem else found
            except (OSError, ValueError):
                continue
            if secrets.compare_digest(der, certificate):
                return True
        return False


class LogIn:
    """Who has which password."""

    def __init__(self, users: Users | None, *, is_open: bool) -> None:
        """is_open: whoever does not log in may read."""
        self._users = users
        self._is_open = is_open
        self._failures = LoginFailures()
        self._log = SecurityLog()

    @property
    def problem(self) -> str:
        """What is wrong with the file of users; empty if nothing is."""
        return self._users.problem if self._users else ""

    def is_operator(self, who: object) -> bool:
        """Whether he is one now: the file may have changed since he logged in. who: the user of a session."""
        found = self._still(who)
        return found is not None and found.role == SiteRole.OPERATOR

    def may_read(self, who: object) -> bool:
        """Whether he may still read; for whoever is not logged in: whether anybody may."""
        return self._is_open or self._still(who) is not None

    def _still(self, who: object) -> User | None:
        """The user with whose password somebody has logged in; None: there is none, or he has another one now."""
        if self._users is None or not isinstance(who, SessionUser) or not who.name:
            return None
        found = self._users.of(who.name)
        return found if found is not None and found.password_hash == who.password_hash else None

    def log_untrusted(self, address: str) -> None:
        """A client has come whose certificate is not among the trusted ones."""
        self._log.add("client refused: its certificate is not in the folder `trusted`", by="OPC UA", address=address)

    def user(self, name: str | None, password: str | None, address: str) -> SessionUser | None:
        """Who logs in; None: nobody does.

        Raises:
            ServiceError: he has guessed too often.
        """
        if name is None:
            return SessionUser(UserRole.User, "") if self._is_open else None
        if self._users is None:
            return None
        self._users.of(name)
        if self._users.problem:
            self._log.add("login refused: the file of users cannot be read", by="OPC UA", user=name, address=address)
            return None
        if self._failures.begin(name, address):
            self._log.add("login refused: too many wrong passwords", by="OPC UA", user=name, address=address)
            raise ServiceError(ua.StatusCodes.BadUserAccessDenied)
        user = self._users.verified(name, password or "")
        if user is None:
            self._log.add("login refused: wrong name or password", by="OPC UA", user=name, address=address)
            return None
        self._failures.succeed(name, address)
        self._log.add("login", by="OPC UA", user=user.name, role=str(user.role), address=address)
        return SessionUser(UserRole.User, user.name, user.role == SiteRole.OPERATOR, user.password_hash)


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

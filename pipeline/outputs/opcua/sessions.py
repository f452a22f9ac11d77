"""Who is connected, what he may do, and how much: the sessions of the library with the rules of this server.

The library lets sessions be taken over by whoever guesses a small number, has no users and almost no limits; here a
session has a random token, a user who has given his password over an encrypted channel, and limits.
"""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable, Iterable, Sequence
from contextvars import ContextVar
from typing import Any

from asyncua import ua
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import User as LibraryUser
from asyncua.server.address_space import ViewService
from asyncua.server.binary_server_asyncio import OPCUAProtocol
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from asyncua.server.internal_subscription import InternalSubscription
from asyncua.server.user_managers import UserManager

from fantwin.pipeline.outputs.opcua.events import WhereClause
from fantwin.pipeline.outputs.opcua.log_in import LogIn, SessionUser, TrustedClients

MOST_CONNECTIONS = 100
MOST_SUBSCRIPTIONS = 200
MOST_ITEMS = 200_000
"""monitored items of all subscriptions"""
MOST_ITEMS_PER_CALL = 1000
MOST_NODES_PER_CALL = 5000
MOST_REFERENCES_PER_CALL = 200_000
MOST_METHODS_PER_CALL = 1000
MOST_HISTORIES_PER_CALL = 10
SHORTEST_PUBLISHING_MS = 100.0
LONGEST_LIFETIME_S = 600.0
"""a subscription from which nobody takes anything for so long is over, with all that waits in it"""
DATA_QUEUE, EVENT_QUEUE = 5, 10_000
"""values of a variable, and events, that wait for a client"""
MOST_UNACKNOWLEDGED = 10
"""messages that are kept for a client that wants them again"""
LONGEST_SESSION_MS = 600_000.0
"""without a request; then it is over, with its subscriptions"""
_METHODS_AT_ONCE = 32

CURRENT_SESSION: ContextVar[SiteSession] = ContextVar("session")
"""the session for which a method runs"""


class SiteServer(InternalServer):
    """The server of the library with sessions, limits and views of this module."""

    def __init__(self, log_in: LogIn, trusted: TrustedClients) -> None:
        super().__init__()
        self.log_in, self.trusted = log_in, trusted
        self.connections: Callable[[], Sequence[OPCUAProtocol]] = tuple
        """those that are open"""
        self.allow_remote_admin = False
        self.max_connections = MOST_CONNECTIONS
        self.max_subscriptions = MOST_SUBSCRIPTIONS
        self.max_unacked_messages_per_subscription = MOST_UNACKNOWLEDGED
        self.max_monitored_item_queue_size = EVENT_QUEUE
        self.max_session_timeout_ms = LONGEST_SESSION_MS
        self.view_service = SiteViews(self.aspace)

    def create_session(self, name: str, user: LibraryUser | None = None, external: bool = False) -> InternalSession:
        """A session of a client."""
        return SiteSession(self, self.aspace, self.subscription_service, name, SessionUser(), external=external)

    def certificate_of_caller(self) -> bytes | None:
        """The certificate (DER) of the client whose message is being answered; None: its channel is not encrypted.

        The library does not say which channel a session is called by, and hands over the certificate of a channel that
        uses none.
        """
        callers = [each for each in self.connections() if each._task is asyncio.current_task()]
        policy = callers[0].processor._connection.security_policy if callers and callers[0].processor else None
        is_encrypted = policy is not None and policy.Mode == ua.MessageSecurityMode.SignAndEncrypt
        return policy.peer_certificate if policy is not None and is_encrypted else None

    def register_server(self, server: Any, conf: Any = None) -> None:
        """This is no discovery server."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)

    def decrypt_user_token(self, isession: Any, token: ua.UserNameIdentityToken) -> tuple[str, str]:
        """Name and password. The padding of PKCS #1 1.5 can be guessed from answers (Bleichenbacher): it is refused."""
        if (token.EncryptionAlgorithm or "").endswith("rsa-1_5"):
            raise ServiceError(ua.StatusCodes.BadIdentityTokenInvalid)
        return super().decrypt_user_token(isession, token)


class SiteViews(ViewService):
    """Browsing: the types of references are looked up once."""

    def __init__(self, nodes: Any) -> None:
        super().__init__(nodes)
        self._below: dict[ua.NodeId, frozenset[ua.NodeId]] = {}

    def browse(self, params: ua.BrowseParameters) -> list[ua.BrowseResult]:
        """As much as a call may ask for."""
        left, found = MOST_REFERENCES_PER_CALL, list[ua.BrowseResult]()
        for each in params.NodesToBrowse:
            if left <= 0:
                found.append(ua.BrowseResult(StatusCode=ua.StatusCode(ua.UInt32(ua.StatusCodes.BadTooManyOperations))))
                continue
            found.append(self._browse(each))
            left -= len(found[-1].References) + 1
        return found

    def _suitable_reftype(self, ref1: ua.NodeId, ref2: ua.NodeId, subtypes: bool) -> bool:
        if ref1 == ua.NodeId(ua.ObjectIds.Null) or ref1 == ref2:
            return True
        if not subtypes:
            return False
        if ref1 not in self._below:
            if self._aspace.get(ref1) is None:
                return False
            self._below[ref1] = frozenset(self._get_sub_ref(ref1))
        return ref2 in self._below[ref1]


class SiteSession(InternalSession):
    """The session of a client."""

    iserver: Any  # SiteServer
    user: Any

    def __init__(self, *args: Any, external: bool = False) -> None:
        super().__init__(*args, external=False)
        self.auth_token = ua.NodeId(secrets.token_bytes(32), 0, ua.NodeIdType.ByteString)
        self.external = external
        self.certificate: bytes | None = None
        """of the client that has activated it; None: not yet, or it is not encrypted"""
        if external:
            self.iserver.register_external_session(self)

    @property
    def operator_name(self) -> str:
        """Of the user if he is an operator; empty: he may not act."""
        return str(self.user.name) if self.iserver.log_in.is_operator(self.user) else ""

    def activate_session(
        self, params: ua.ActivateSessionParameters, peer_certificate: bytes | None
    ) -> ua.ActivateSessionResult:
        """Log in. A user must come over a channel that is encrypted, and a session stays with its client.

        Raises:
            ServiceError: he may not.
        """
        certificate = self.iserver.certificate_of_caller()
        address = self.name[0] if isinstance(self.name, tuple) else str(self.name)
        if certificate is None and isinstance(params.UserIdentityToken, ua.UserNameIdentityToken):
            raise ServiceError(ua.StatusCodes.BadSecurityModeInsufficient)
        if certificate is not None and not self.iserver.trusted.trusts(certificate):
            self.iserver.log_in.log_untrusted(address)
            raise ServiceError(ua.StatusCodes.BadCertificateUntrusted)
        if self.is_activated() and certificate != self.certificate:
            raise ServiceError(ua.StatusCodes.BadSecurityChecksFailed)
        self.iserver.user_manager = _AtAddress(self.iserver.log_in, address)
        result = super().activate_session(params, peer_certificate)
        self.certificate = certificate
        return result

    async def call(self, params: list[ua.CallMethodRequest]) -> list[ua.CallMethodResult]:
        """Methods: those of one call run side by side, as each waits for its scorer."""
        _limit(params, MOST_METHODS_PER_CALL)
        CURRENT_SESSION.set(self)
        found: list[ua.CallMethodResult] = []
        for first in range(0, len(params), _METHODS_AT_ONCE):
            some = [self.iserver.method_service.call([each]) for each in params[first : first + _METHODS_AT_ONCE]]
            found += [result for results in await asyncio.gather(*some) for result in results]
        return found

    async def read(self, params: ua.ReadParameters) -> list[ua.DataValue]:
        """Read, within limits."""
        _limit(params.NodesToRead, MOST_NODES_PER_CALL)
        return await super().read(params)

    async def browse(self, params: ua.BrowseParameters) -> list[ua.BrowseResult]:
        """Browse, within limits."""
        _limit(params.NodesToBrowse, MOST_NODES_PER_CALL)
        return await super().browse(params)

    async def browse_next(self, parameters: ua.BrowseNextParameters) -> list[ua.BrowseResult]:
        """There is never more: a result is complete."""
        raise ServiceError(ua.StatusCodes.BadContinuationPointInvalid)

    async def translate_browsepaths_to_nodeids(self, params: list[ua.BrowsePath]) -> list[ua.BrowsePathResult]:
        """Paths to nodes, within limits."""
        _limit(params, MOST_NODES_PER_CALL)
        return await super().translate_browsepaths_to_nodeids(params)

    async def history_read(self, params: ua.HistoryReadParameters) -> list[ua.HistoryReadResult]:
        """Histories, within limits."""
        _limit(params.NodesToRead, MOST_HISTORIES_PER_CALL)
        return await super().history_read(params)

    async def create_subscription(
        self,
        params: ua.CreateSubscriptionParameters,
        callback: Callable[..., Any],
        request_callback: Callable[..., Any] | None = None,
    ) -> ua.CreateSubscriptionResult:
        """A subscription that ends by itself if nobody takes anything from it."""
        interval_ms = max(SHORTEST_PUBLISHING_MS, min(params.RequestedPublishingInterval, LONGEST_LIFETIME_S * 100))
        longest = round(LONGEST_LIFETIME_S * 1e3 / interval_ms)
        params.RequestedPublishingInterval = ua.Double(interval_ms)
        keep_alive = min(params.RequestedMaxKeepAliveCount or longest // 3, longest // 3)
        params.RequestedMaxKeepAliveCount = ua.UInt32(max(1, keep_alive))
        lifetime = min(params.RequestedLifetimeCount or longest, longest)
        params.RequestedLifetimeCount = ua.UInt32(max(lifetime, 3 * params.RequestedMaxKeepAliveCount))
        return await super().create_subscription(params, callback, request_callback)

    async def create_monitored_items(self, params: ua.CreateMonitoredItemsParameters) -> Any:
        """Monitored items with queues that fit."""
        self.own_subscription(params.SubscriptionId)
        _limit(params.ItemsToCreate, MOST_ITEMS_PER_CALL)
        service = self.subscription_service
        present = sum(len(each.monitored_item_srv._monitored_items) for each in service.subscriptions.values())
        if present + len(params.ItemsToCreate) > MOST_ITEMS:
            raise ServiceError(ua.StatusCodes.BadTooManyMonitoredItems)
        for item in params.ItemsToCreate:
            is_event = item.ItemToMonitor.AttributeId == ua.AttributeIds.EventNotifier
            wanted = item.RequestedParameters.QueueSize
            queue = EVENT_QUEUE if is_event else max(1, min(wanted, DATA_QUEUE))
            item.RequestedParameters.QueueSize = ua.UInt32(queue)
        results = await super().create_monitored_items(params)
        items = service.subscriptions[params.SubscriptionId].monitored_item_srv
        for result in results:
            made = items._monitored_items.get(result.MonitoredItemId)
            if made is not None and made.where_clause_evaluator is not None:
                made.where_clause_evaluator = WhereClause(items.logger, self.aspace, made.filter.WhereClause)
        return results

    async def modify_monitored_items(self, params: ua.ModifyMonitoredItemsParameters) -> Any:
        """Queues that fit."""
        self.own_subscription(params.SubscriptionId)
        _limit(params.ItemsToModify, MOST_ITEMS_PER_CALL)
        items = self.subscription_service.subscriptions[params.SubscriptionId].monitored_item_srv
        for item in params.ItemsToModify:
            made = items._monitored_items.get(item.MonitoredItemId)
            is_event = made is not None and made.where_clause_evaluator is not None
            wanted = item.RequestedParameters.QueueSize
            queue = EVENT_QUEUE if is_event else max(1, min(wanted, DATA_QUEUE))
            item.RequestedParameters.QueueSize = ua.UInt32(queue)
        return await super().modify_monitored_items(params)

    async def delete_monitored_items(self, params: ua.DeleteMonitoredItemsParameters) -> Any:
        """Of one's own subscription."""
        self.own_subscription(params.SubscriptionId)
        return await super().delete_monitored_items(params)

    async def set_monitoring_mode(self, params: ua.SetMonitoringModeParameters) -> list[ua.StatusCode]:
        """Of one's own subscription."""
        self.own_subscription(params.SubscriptionId)
        return await super().set_monitoring_mode(params)

    async def set_publishing_mode(self, params: ua.SetPublishingModeParameters) -> list[ua.StatusCode]:
        """Of one's own subscriptions."""
        for each in params.SubscriptionIds:
            self.own_subscription(each)
        return await super().set_publishing_mode(params)

    async def delete_subscriptions(self, ids: list[int]) -> list[ua.StatusCode]:
        """Of one's own."""
        for each in ids:
            self.own_subscription(each)
        return await super().delete_subscriptions(ids)

    async def transfer_subscriptions(
        self, params: ua.TransferSubscriptionsParameters, callback: Callable[..., Any]
    ) -> list[ua.TransferResult]:
        """A subscription stays with its session: a client that has lost its session subscribes again."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)

    def publish(self, acks: Iterable[ua.SubscriptionAcknowledgement] | None = None) -> tuple[int, list[ua.StatusCode]]:
        """How many subscriptions the session has, and whether each acknowledged message was of one of them."""
        of_session = [each for each in self.subscription_service.subscriptions.values() if self._owns(each)]
        if not of_session:
            raise ServiceError(ua.StatusCodes.BadNoSubscription)
        results: list[ua.StatusCode] = []
        for ack in acks or ():
            found = self.subscription_service.subscriptions.get(ack.SubscriptionId)
            if found is None or not self._owns(found):
                results.append(ua.StatusCode(ua.UInt32(ua.StatusCodes.BadSubscriptionIdInvalid)))
                continue
            found.publish([ack.SequenceNumber])
            results.append(ua.StatusCode())
        return len(of_session), results

    def republish(self, params: ua.RepublishParameters) -> ua.NotificationMessage:
        """A message again.

        Raises:
            ServiceError: it is not there any more.
        """
        subscription = self.own_subscription(params.SubscriptionId)
        found = subscription._not_acknowledged_results.get(params.RetransmitSequenceNumber)
        if found is None:
            raise ServiceError(ua.StatusCodes.BadMessageNotAvailable)
        return found.NotificationMessage

    def own_subscription(self, number: int) -> InternalSubscription:
        """One of this session.

        Raises:
            ServiceError: there is none of this number.
        """
        found = self.subscription_service.subscriptions.get(number)
        if found is None or not self._owns(found):
            raise ServiceError(ua.StatusCodes.BadSubscriptionIdInvalid)
        return found

    def _owns(self, subscription: InternalSubscription) -> bool:
        return subscription.session_id == self.session_id


class _AtAddress(UserManager):
    """The user manager while a client at this address logs in."""

    def __init__(self, log_in: LogIn, address: str) -> None:
        self._log_in, self._address = log_in, address

    def get_user(self, iserver: Any, username: Any = None, password: Any = None, certificate: Any = None) -> Any:
        """As the library asks for it."""
        return self._log_in.user(username, password, self._address)


def _limit(asked: Sequence[Any] | None, most: int) -> None:
    if asked is not None and len(asked) > most:
        raise ServiceError(ua.StatusCodes.BadTooManyOperations)

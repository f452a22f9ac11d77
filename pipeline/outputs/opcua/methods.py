"""The methods of conditions: each becomes a request to the scorer, and returns what that has answered.

The name of the operator is that of the user who has logged in: no argument carries it.
"""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

import asyncio
import math
import time
from typing import Any

from asyncua import Server, ua

from fantwin.pipeline.outputs.opcua.encoding import ALARM, COMMISSION, SHELVING_STATE, STATUS, standard
from fantwin.pipeline.outputs.opcua.events import EventDelivery, event_id
from fantwin.pipeline.outputs.opcua.requests import (
    COMMENT,
    EVENT_ID,
    FAN_METHODS,
    GOOD,
    METHODS,
    SHELVING_METHODS,
    SHELVING_TIME,
    ConditionMethod,
    status_of,
)
from fantwin.pipeline.outputs.opcua.sessions import CURRENT_SESSION
from fantwin.pipeline.outputs.opcua.site_nodes import SiteNodes, method_nodes
from fantwin.pipeline.site.fleet import Fan
from fantwin.pipeline.site.one_line import one_line
from fantwin.pipeline.site.request_desk import LONGEST_COMMENT, LONGEST_SHELVING_S, RequestDesk
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.schemas.enums import Action
from fantwin.schemas.messages import Request
from fantwin.scoring.alarms.alarm_state import is_retained

_SEARCHED = 200
"""transitions of a fan, among which an event is looked for"""


class Methods:
    """Of one server."""

    def __init__(self, model: SiteModel, desk: RequestDesk, nodes: SiteNodes, delivery: EventDelivery) -> None:
        self._model, self._desk = model, desk
        self._nodes, self._delivery = nodes, delivery

    def bind(self, server: Server, namespace: int) -> None:
        """Answer the methods of the standard's types and of fans."""
        for method in METHODS:
            for node in method_nodes(method):
                self._bind(server, node, method, (ALARM,))
        for method in SHELVING_METHODS:  # called on the condition or on its state machine
            for node in method_nodes(method):
                self._bind(server, node, method, (SHELVING_STATE, ALARM))
        (commission,) = FAN_METHODS
        self._bind(server, ua.NodeId(COMMISSION, namespace), commission, ("",))
        for name in ("ConditionRefresh", "ConditionRefresh2"):
            refresh = standard(f"ConditionType_{name}")
            server.iserver.isession.add_method_callback(refresh, self._refresh)

    def _bind(self, server: Server, node: ua.NodeId, method: ConditionMethod, paths: tuple[str, ...]) -> None:
        async def answer(parent: ua.NodeId, *arguments: ua.Variant) -> ua.StatusCode:
            return STATUS[await self._answer(method, paths, parent, arguments)]

        if server.iserver.aspace.get(node) is not None:
            server.iserver.isession.add_method_callback(node, answer)

    async def _answer(
        self, method: ConditionMethod, paths: tuple[str, ...], parent: ua.NodeId, arguments: tuple[ua.Variant, ...]
    ) -> str:
        """The status of a call, by name."""
        found = self._nodes.fan(parent)
        operator_name = CURRENT_SESSION.get().operator_name
        if found is None or found[1] not in paths:
            return "BadNodeIdInvalid"
        if not operator_name:
            return "BadUserAccessDenied"
        if refusal := _refusal(method, arguments):
            return refusal
        values = dict(zip(method.arguments, (each.Value for each in arguments), strict=True))
        fan = found[0]
        if EVENT_ID in values and not await asyncio.to_thread(self._is_of_occurrence, fan, values[EVENT_ID]):
            return "BadEventIdUnknown"
        request = Request(
            t_ns=time.time_ns(),
            action=method.action,
            fan=fan.number,
            duration_s=float(values.get(SHELVING_TIME) or 0.0) / 1e3,
            operator_name=operator_name,
            comment=_text(values.get(COMMENT)),
        )
        return await self._asked(fan, request, method.action)

    async def _asked(self, fan: Fan, request: Request, action: Action) -> str:
        try:
            (answer,) = await self._desk.ask(fan.tray, request, [fan.number])
        except TimeoutError:
            return "BadTimeout"
        return status_of(answer, action)

    def _is_of_occurrence(self, fan: Fan, wanted: Any) -> bool:
        """Whether an event is one of the fan's present alarm."""
        current = self._model.current_alarm(fan)
        if current is None or not isinstance(wanted, bytes):
            return False
        if wanted == event_id(current.newest):
            return True
        past = self._model.past.newest(_SEARCHED, tray=fan.tray, fan=fan.number)
        return any(alarm.onset_t_ns == current.newest.onset_t_ns and event_id(alarm) == wanted for _, alarm in past)

    async def _refresh(self, parent: ua.NodeId, *arguments: ua.Variant) -> ua.StatusCode:
        """ConditionRefresh of a subscription; ConditionRefresh2, which names one of its items, does the same."""
        numbers = [each.Value for each in arguments]
        if not numbers or not all(isinstance(each, int) for each in numbers):
            return STATUS["BadArgumentsMissing" if not numbers else "BadInvalidArgument"]
        session = CURRENT_SESSION.get()
        subscription = session.subscription_service.subscriptions.get(numbers[0])
        if subscription is None or subscription.session_id != session.session_id:
            return STATUS["BadSubscriptionIdInvalid"]
        retained = [each for each in self._model.current_alarms() if is_retained(each.newest)]
        await self._delivery.refresh(numbers[0], retained)
        return STATUS[GOOD]


def _refusal(method: ConditionMethod, arguments: tuple[ua.Variant, ...]) -> str:
    """Why a call is not worth asking; empty if it is."""
    if len(arguments) != len(method.arguments):
        return "BadArgumentsMissing" if len(arguments) < len(method.arguments) else "BadTooManyArguments"
    if method.action is None:
        return method.refusal
    values = dict(zip(method.arguments, (each.Value for each in arguments), strict=True))
    comment = values.get(COMMENT)
    if comment is not None and not isinstance(comment, ua.LocalizedText):
        return "BadTypeMismatch"
    if len(_text(comment)) > LONGEST_COMMENT:
        return "BadOutOfRange"
    return _shelving_refusal(values[SHELVING_TIME]) if SHELVING_TIME in values else ""


def _text(comment: ua.LocalizedText | None) -> str:
    return one_line(comment.Text or "") if comment is not None else ""


def _shelving_refusal(shelving_ms: Any) -> str:
    """Why a time of shelving is refused; empty if it is not. Without a time, an alarm is shelved until it clears, which
    is another method."""
    if not isinstance(shelving_ms, float | int) or isinstance(shelving_ms, bool):
        return "BadTypeMismatch"
    fits = math.isfinite(shelving_ms) and 0 < shelving_ms <= LONGEST_SHELVING_S * 1e3
    return "" if fits else "BadShelvingTimeOutOfRange"

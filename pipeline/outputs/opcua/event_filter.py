"""The filters of event subscriptions, written so that the library evaluates them as the standard says.

The library compares types of events for equality, knows no field below another one, and filters the events of a
refresh too, which every client needs (Part 9, 5.5.7).
"""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from asyncua import ua

from fantwin.pipeline.outputs.opcua.encoding import standard
from fantwin.pipeline.outputs.opcua.identifiers import FAN_ALARM_TYPE

CONDITION_ID = "NodeId"
_OF_REFRESH = ("RefreshStartEventType", "RefreshEndEventType", "RefreshRequiredEventType")
_OF_ALARMS = ("AlarmConditionType", "AcknowledgeableConditionType", "ConditionType", "BaseEventType")
_OF_SYSTEM = ("SystemEventType", "BaseEventType")


def path_of(clause: ua.SimpleAttributeOperand) -> str:
    """The path of a selected field. The node of a condition, its ConditionId, is selected as an attribute."""
    if not clause.BrowsePath:
        return CONDITION_ID if clause.AttributeId == ua.AttributeIds.NodeId else ""
    return "/".join(part.Name for part in clause.BrowsePath)


def as_the_library_evaluates(clause: ua.ContentFilter, namespace: int) -> ua.ContentFilter:
    """The same filter: a field has its path as its name, a type is the list of those of its subtypes that this server
    sends, and the events of a refresh pass. namespace: of the server's own types."""
    if not clause.Elements:
        return clause
    types = _types(namespace)
    refresh = _is_one_of(standard(name) for name in _OF_REFRESH)
    first = ua.ContentFilterElement(
        FilterOperator=ua.FilterOperator.Or,
        FilterOperands=[ua.ElementOperand(Index=ua.UInt32(1)), ua.ElementOperand(Index=ua.UInt32(2))],
    )
    return ua.ContentFilter(Elements=[first, refresh, *(_element(each, types) for each in clause.Elements)])


def _types(namespace: int) -> Mapping[ua.NodeId, Sequence[ua.NodeId]]:
    """The types that are sent, each with those that it is a subtype of."""
    named = {ua.NodeId(FAN_ALARM_TYPE, namespace): _OF_ALARMS}
    named |= {standard(name): _OF_SYSTEM for name in _OF_REFRESH}
    return {kind: (kind, *(standard(name) for name in above)) for kind, above in named.items()}


def _element(
    element: ua.ContentFilterElement, types: Mapping[ua.NodeId, Sequence[ua.NodeId]]
) -> ua.ContentFilterElement:
    operands = [_operand(each) for each in element.FilterOperands]
    if element.FilterOperator == ua.FilterOperator.OfType and isinstance(operands[0], ua.LiteralOperand):
        wanted = operands[0].Value.Value
        return _is_one_of(kind for kind, above in types.items() if wanted in above)
    return ua.ContentFilterElement(FilterOperator=element.FilterOperator, FilterOperands=operands)


def _operand(operand: Any) -> Any:
    if isinstance(operand, ua.ElementOperand):
        return ua.ElementOperand(Index=ua.UInt32(operand.Index + 2))  # two elements come first
    return _field(path_of(operand)) if isinstance(operand, ua.SimpleAttributeOperand) else operand


def _is_one_of(types: Iterable[ua.NodeId]) -> ua.ContentFilterElement:
    literals = [ua.LiteralOperand(Value=ua.Variant(each, ua.VariantType.NodeId)) for each in types]
    return ua.ContentFilterElement(
        FilterOperator=ua.FilterOperator.InList, FilterOperands=[_field("EventType"), *literals]
    )


def _field(path: str) -> ua.SimpleAttributeOperand:
    return ua.SimpleAttributeOperand(BrowsePath=[ua.QualifiedName(path)], AttributeId=ua.AttributeIds.Value)

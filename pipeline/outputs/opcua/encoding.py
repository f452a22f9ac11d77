"""Values as the OPC UA library wants them."""

# pyright: reportPrivateImportUsage=false, reportArgumentType=false
# (the library declares its names and integers otherwise than it uses them)
from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

from asyncua import ua

from fantwin.pipeline.outputs.opcua.conditions import OwnNode, StandardNode, Time

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
STATUS = {name: ua.StatusCode(ua.UInt32(code)) for name, code in vars(ua.StatusCodes).items() if isinstance(code, int)}


class SharedValue(ua.DataValue):
    """A value that nobody changes: the library copies the values of subscribed variables, which takes longer than all
    else, and this one need not be copied."""

    __slots__ = ()

    def __deepcopy__(self, memo: dict[int, Any]) -> SharedValue:
        return self


def time_of(t_ns: int) -> datetime | None:
    """None for 0, which is no time."""
    return _EPOCH + timedelta(microseconds=t_ns // 1000) if t_ns else None


def micros_of(at: datetime) -> int:
    """Microseconds since 1970. Without a time zone it is that of the library, UTC."""
    return (at.replace(tzinfo=at.tzinfo or UTC) - _EPOCH) // timedelta(microseconds=1)


def node_id(node: StandardNode | OwnNode, namespace: int) -> ua.NodeId:
    """namespace: index of this server's own nodes."""
    if isinstance(node, StandardNode):
        return ua.NodeId(getattr(ua.ObjectIds, node.name))
    return ua.NodeId(node.identifier, namespace) if node.identifier != "" else ua.NodeId()


def variant(kind: str, value: Any, namespace: int) -> ua.Variant:
    """kind: built-in type by name."""
    if kind == "LocalizedText":
        value = ua.LocalizedText(value)
    elif kind == "NodeId":
        value = node_id(value, namespace)
    elif kind == "DateTime":
        value = time_of(value.t_ns) if isinstance(value, Time) else value
        if value is None:  # the library cannot send a time that is none
            return ua.Variant()
    elif kind == "StatusCode":
        value = STATUS[value]
    return ua.Variant(value, ua.VariantType[kind])


def data_value(kind: str, value: Any, status: str, t_ns: int, namespace: int, now: datetime) -> SharedValue:
    """t_ns: source timestamp. A value with a bad status is none."""
    found = ua.Variant() if value is None else variant(kind, value, namespace)
    return SharedValue(found, STATUS[status], time_of(t_ns) or now, now)

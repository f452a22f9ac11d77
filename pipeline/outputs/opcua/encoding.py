"""Identifiers of nodes, and values as the OPC UA library wants them.

Identifiers are numbers for what exists once, `TRAY/FAN/...` for what a site has.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

from asyncua import ua

from fantwin.pipeline.site.fleet import Fan

NAMESPACE = "urn:fantwin:fans"
SITE_FOLDER, FAN_TYPE, FAN_ALARM_TYPE, COMMISSION = 1, 2, 3, 4
ALARM, SHELVING_STATE = "Alarm", "Alarm/ShelvingState"


def condition_identifier(fan: Fan) -> str:
    """Of the node of a fan's condition."""
    return f"{fan}/{ALARM}"


def fan_of(identifier: object) -> tuple[Fan, str] | None:
    """The fan of a node and the path below it, empty for the fan itself; None: the node is of no fan."""
    if not isinstance(identifier, str):
        return None
    tray, _, rest = identifier.partition("/")
    number, _, path = rest.partition("/")
    if not (number.isascii() and number.isdigit() and len(number) < 6 and str(int(number)) == number):
        return None
    return Fan(tray, int(number)), path


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


def standard(name: str) -> ua.NodeId:
    """A node of the standard, by the name of its identifier."""
    return ua.NodeId(getattr(ua.ObjectIds, name))


def null_or_time(t_ns: int) -> ua.Variant:
    """A time; null for 0, because the library cannot send a missing time."""
    return ua.Variant(time_of(t_ns), ua.VariantType.DateTime) if t_ns else ua.Variant()


def localized(text: str) -> ua.Variant:
    """A text for people."""
    return ua.Variant(ua.LocalizedText(text), ua.VariantType.LocalizedText)


def string(text: str) -> ua.Variant:
    """A text for programs."""
    return ua.Variant(text, ua.VariantType.String)


def boolean(value: bool) -> ua.Variant:
    """A flag."""
    return ua.Variant(value, ua.VariantType.Boolean)


def value_of(value: float | str, kind: str = "Double") -> ua.Variant:
    """A value of a built-in type."""
    return ua.Variant(value, ua.VariantType[kind])


def data_value(value: ua.Variant, status: str, t_ns: int, now: datetime) -> SharedValue:
    """A value with its status. t_ns: source timestamp; 0: now."""
    return SharedValue(value, STATUS[status], time_of(t_ns) or now, now)

"""Messages for tests that care about a few of their fields."""

from __future__ import annotations

from typing import Any, TypeVar, get_args

import numpy as np

from fantwin.schemas.enums import Severity, StageStatus
from fantwin.schemas.fields import columns
from fantwin.schemas.header import Header
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Alarm, Message
from fantwin.schemas.topics import TOPICS

MESSAGE_TYPES: tuple[type[Message], ...] = get_args(Message)
"""every type of message"""
TOPIC_OF = {topic.message: topic.name for topic in TOPICS}
MessageType = TypeVar("MessageType", bound=Message)


def filled(kind: type[MessageType], samples: int, fans: int, **given: Any) -> MessageType:
    """A message whose columns are zero, and valid, but for what is given: numbers, or arrays of the column's shape."""
    shapes = {"samples": (samples,), "samples x fans": (samples, fans), "fans": (fans,)}
    values = {
        name: np.broadcast_to(np.asarray(given.pop(name, name == "valid"), column.dtype), shapes[column.shape]).copy()
        for name, column in columns(kind).items()
        if name in given or not column.optional
    }
    return kind(**{"fans": fans, **values, **given})


def health(stage: str, instance: str = "all", producer: str = "", sequence: int = 0, **more: Any) -> Health:
    """Health of a process that is at work. Without `producer` it signs as `stage-instance-1`."""
    header = Header(producer or f"{stage}-{instance}-1", sequence, "")
    fields: dict[str, Any] = {"status": StageStatus.OK, "t_ns": 1, "uptime_s": 1.0, **more}
    return Health(header=header, stage=stage, instance=instance, **fields)


def alarm(
    fan: int = 0, t_ns: int = 7, tray: str = "tray1", producer: str = "scorer-1", sequence: int = 0, **more: Any
) -> Alarm:
    """An active alarm; its onset is its own time."""
    fields: dict[str, Any] = {"active": True, "severity": Severity.ALARM, "t_ns": t_ns, "onset_t_ns": t_ns}
    fields |= {"residual_rad_s": 0.0, "residual_std_rad_s": 1.0, "message": "", **more}
    return Alarm(header=Header(producer, sequence, tray), fan=fan, **fields)

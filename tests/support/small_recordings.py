"""Small recordings of raw samples with random numbers, alarms, and messages of any topic."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fantwin.pipeline.recordings.writing import RecordingWriter
from fantwin.schemas.enums import Statistic, Transition
from fantwin.schemas.header import Header
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Alarm, Message, Raw
from fantwin.schemas.topics import health_key, tray_key
from tests.support import made_messages
from tests.support.made_messages import TOPIC_OF


def key_of(message: Message, site: str = "plant") -> str:
    if isinstance(message, Health):
        return health_key(site, message.stage, message.instance)
    return tray_key(site, message.header.tray, TOPIC_OF[type(message)])


def write(
    path: Path,
    messages: Iterable[Message],
    metadata: Mapping[str, str] | None = None,
    start: int = 1,
    at: Callable[[Any], int] | None = None,
) -> Path:
    """A recording of a site that its metadata name. at: when a message was received; otherwise they are numbered."""
    about = metadata or {"site": "plant"}
    with RecordingWriter(path, about, overwrite=True) as writer:
        for number, message in enumerate(messages, start):
            writer.add_message(key_of(message, about.get("site", "plant")), message, at(message) if at else number)
    return path


def raw(
    sequence: int, *, samples: int = 10, fans: int = 2, tray: str = "tray1", producer: str = "a", clock: bool = True
) -> Raw:
    numbers = np.random.default_rng(sequence)
    count = np.arange(samples if clock else 0)
    command, speed_rad_s = numbers.normal(size=(2, samples, fans))
    times: dict[str, Any] = {"host_receive_t_ns": np.arange(samples) + sequence * samples}
    times |= {"device_clock_us": count, "device_sequence": count}
    header = Header(producer, sequence, tray)
    return Raw(header=header, fans=fans, command=command, speed_rad_s=speed_rad_s, **times)


def alarm(sequence: int) -> Alarm:
    fields = {"onset_t_ns": 50, "residual_rad_s": 3.5, "message": f"alarm {sequence}", "active": sequence % 2 == 0}
    fields |= {"transition": Transition.RAISED, "statistic": Statistic.DEVIATION}
    return made_messages.alarm(sequence, 70 + sequence, sequence=sequence, **fields)

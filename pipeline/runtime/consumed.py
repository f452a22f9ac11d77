"""Reports of what a session of a stage consumed, in as few messages as possible. With them its outputs can be made
again without having been recorded.

Each output carries its input position. From one output to the next it usually moves on without a break, and then the
first and the last say all. A `Consumed` is due

* for the first output of a session,
* for the two outputs on each side of a break: input is missing, or another producer follows,
* for an output that a timer triggered, since no input says when that was,
* for an output PERIOD_NS after the last one reported, by the time of the samples: a session that is killed reports no
  more,
* for the last output of a session that ends in order.
"""

from __future__ import annotations

from dataclasses import dataclass

from fantwin.schemas.fields import Array, time_column
from fantwin.schemas.header import InputPosition
from fantwin.schemas.messages import Consumed, Message
from fantwin.schemas.streams import continues
from fantwin.schemas.topics import BY_NAME
from fantwin.schemas.units import NS_PER_S

CONSUMED = "consumed"
PERIOD_NS = 120 * NS_PER_S
"""equal to the default `flush_interval_s` of the recorder"""


@dataclass
class _Reported:
    """The outputs of one topic of one tray."""

    newest: Consumed
    is_reported: bool
    reported_t_ns: int


class ConsumedReports:
    """The reports of one session of a stage, of all its trays."""

    def __init__(self) -> None:
        self._outputs: dict[tuple[str, str], _Reported] = {}

    def after(self, topic: str, message: Message) -> list[Consumed]:
        """What is due after this output, with the header it was published with."""
        position = message.header.input_position
        if position is None or not BY_NAME[topic].has_samples:
            return []
        times: Array = getattr(message, time_column(type(message)))
        if not len(times):
            return []
        newest = Consumed(
            header=message.header,
            topic=topic,
            first_t_ns=times.item(0),
            t_ns=times.item(-1),
        )
        key = message.header.tray, topic
        before = self._outputs.get(key)
        if before is None:
            self._outputs[key] = _Reported(newest, True, newest.t_ns)
            return [newest]
        has_break = not continues(_position(before.newest), position)
        due = [before.newest] if has_break and not before.is_reported else []
        before.newest, before.is_reported = newest, False
        if has_break or position.from_timer or abs(newest.t_ns - before.reported_t_ns) >= PERIOD_NS:
            before.is_reported, before.reported_t_ns = True, newest.t_ns
            due.append(newest)
        return due

    def last(self) -> list[Consumed]:
        """What is due at the end."""
        due = [each.newest for each in self._outputs.values() if not each.is_reported]
        for each in self._outputs.values():
            each.is_reported = True
        return due


def _position(reported: Consumed) -> InputPosition:
    assert reported.header.input_position
    return reported.header.input_position

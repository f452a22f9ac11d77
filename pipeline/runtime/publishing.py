"""The outputs of a stage: messages returned by its cores are stamped, encoded and published here, with reports of
what a session consumed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.runtime.stage import Stage, StageError
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.fields import Array, time_column
from fantwin.schemas.header import Header, InputPosition
from fantwin.schemas.health import Output
from fantwin.schemas.messages import Consumed, Message
from fantwin.schemas.streams import continues
from fantwin.schemas.topics import BY_NAME, TOPICS, tray_key
from fantwin.schemas.units import NS_PER_S

CONSUMED = "consumed"
PERIOD_NS = 120 * NS_PER_S
"""equal to the longest time between two flushes of the recorder"""


@dataclass
class _Reported:
    """The outputs of one topic of one tray."""

    newest: Consumed
    is_reported: bool
    reported_t_ns: int


class ConsumedReports:
    """Reports of what a session of a stage consumed, of all its trays, in as few messages as possible.

    With them its outputs can be made again without having been recorded. Each output carries its input position. From
    one output to the next it usually moves on without a break, and then the first and the last say all. A `Consumed` is
    due

    * for the first output of a session,
    * for the two outputs on each side of a break: input is missing, or another producer follows,
    * for an output that a timer triggered, since no input says when that was,
    * for an output PERIOD_NS after the last one reported, by the time of the samples: a session that is killed reports
      no more,
    * for the last output of a session that ends in order.
    """

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


_TOPIC_NAMES = {topic.message: topic.name for topic in TOPICS}


class Outputs:
    """Publishers for each topic a stage writes, of each tray; and how far the main input had been processed."""

    def __init__(self, bus: Bus, site: str, stage: Stage, trays: Iterable[str], producer: str) -> None:
        self._stage = stage
        self._producer = producer
        reports = (CONSUMED,) if stage.makes_samples_of_samples else ()
        self._publishers = {
            (tray, name): bus.publisher(
                tray_key(site, tray, name), BY_NAME[name], type_name(BY_NAME[name].message), producer
            )
            for tray in trays
            for name in (*stage.writes, *reports)
        }
        self._consumed = ConsumedReports()
        self._positions: dict[str, InputPosition] = {}
        """by tray: up to where the main input has been processed"""

    def advance(self, tray: str, topic: str, header: Header) -> None:
        """A message of the main input is being processed: outputs from now on refer to it."""
        self._positions[tray] = InputPosition.after(self._positions.get(tray), topic, header)

    def publish(self, tray: str, message: Message, *, from_timer: bool) -> Message:
        """Publish a message of a tray; returns it stamped.

        from_timer: it was made because time passed, not by an input.

        Raises:
            StageError: it is of a topic that the stage does not declare to write, or of no tray that it serves.
        """
        topic = _TOPIC_NAMES[type(message)]
        publisher = self._publishers.get((tray, topic))
        if publisher is None or topic == CONSUMED:
            raise StageError(self._refusal(tray, message))
        position = self._positions.get(tray)
        if position and from_timer:
            position = replace(position, from_timer=True)
        stamped = replace(message, header=Header(self._producer, publisher.published, tray, position))
        publisher.put(encode(stamped))
        if (tray, CONSUMED) in self._publishers:
            self._report(self._consumed.after(topic, stamped))
        return stamped

    def report_last(self) -> None:
        """Publish what the stage had consumed when it made its last outputs: no more follow."""
        self._report(self._consumed.last())

    def _report(self, due: Iterable[Consumed]) -> None:
        for report in due:
            publisher = self._publishers[report.header.tray, CONSUMED]
            header = replace(report.header, sequence=publisher.published)
            publisher.put(encode(replace(report, header=header)))

    def counts(self, has_more: Callable[[str], bool]) -> list[Output]:
        """How many messages have been published on each key. has_more: whether input of a tray waits from which more
        may still be made."""
        waits = {tray: has_more(tray) for tray, _ in self._publishers}
        return [
            Output(key=each.key, published=each.published, has_more=waits[tray])
            for (tray, _), each in self._publishers.items()
        ]

    def _refusal(self, tray: str, message: Message) -> str:
        name, topic = self._stage.name, _TOPIC_NAMES[type(message)]
        if topic not in self._stage.writes:
            return f"stage {name!r} returned a message of topic {topic!r}: add it to `writes` of its declaration"
        if not tray:
            return f"stage {name!r} serves all trays and returned a {topic} without one: set header.tray"
        return f"stage {name!r} returned a {topic} of tray {tray!r}, which this process does not serve"

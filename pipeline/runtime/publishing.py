"""The outputs of a stage: messages returned by its cores are stamped, encoded and published here."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.runtime.consumed import CONSUMED, ConsumedReports
from fantwin.pipeline.runtime.stage import Stage, StageError
from fantwin.schemas.codec import encode, type_name
from fantwin.schemas.header import Header, InputPosition
from fantwin.schemas.health import Output
from fantwin.schemas.messages import Consumed, Message
from fantwin.schemas.topics import BY_NAME, TOPICS, tray_key

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

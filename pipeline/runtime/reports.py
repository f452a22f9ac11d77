"""What a stage says of itself: its health messages, collected from all that it consists of."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

from fantwin.pipeline.bus.publisher import Publisher
from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.runtime.ending import Ending
from fantwin.pipeline.runtime.health import HealthBuilder
from fantwin.pipeline.runtime.inbox import DueMessages, Inbox
from fantwin.pipeline.runtime.publishing import Outputs
from fantwin.pipeline.runtime.receiving import Receiver
from fantwin.pipeline.runtime.stage import BuiltStage, Core, Stage
from fantwin.pipeline.runtime.started_sources import Sources
from fantwin.pipeline.runtime.steps import Steps
from fantwin.pipeline.timebase.host_clock import HOST_CLOCK
from fantwin.schemas.codec import encode
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.health import Health, Learning, Note
from fantwin.schemas.streams import stage_losses


@dataclass(kw_only=True, eq=False)
class Reports:
    """Builds and publishes the health of one process of a stage. on_health: is called with each while it runs."""

    stage: Stage
    parts: Mapping[str, BuiltStage]
    producer: str
    publisher: Publisher
    bus: Bus
    inbox: Inbox
    due: DueMessages
    sources: Sources
    receiver: Receiver
    steps: Steps
    outputs: Outputs
    health: HealthBuilder
    ending: Ending
    on_health: Callable[[Health], None] | None
    lost_at_stop: int = 0
    """messages for which there was no time at the end"""

    def publish(self, status: StageStatus) -> Health:
        """Publish the health as of now."""
        health = self._build(status)
        payload = encode(health)
        self.publisher.put(payload)
        if self.on_health:
            self.on_health(health)
        if "health" in self.stage.reads:
            # the bus does not return a session's own messages
            own = Envelope(self.publisher.key, "health", payload, HOST_CLOCK.now_ns(), health)
            self.steps.step([[own]])
        return health

    def publish_last(self, share: float) -> Health:
        """Publish the last health, without counts if collecting them fails. share: see Ending."""
        reported: list[Health] = []

        def report() -> None:
            status = StageStatus.DEGRADED if self.ending.error else StageStatus.STOPPED
            try:
                health = self._build(status, is_last=True)
                payload = encode(health)
            except Exception as error:  # noqa: BLE001  kept, and reported without what raised it
                self.ending.fail(error, f"counting failed: {type(error).__name__}: {error}")
                health = self._build(StageStatus.DEGRADED, with_counts=False, is_last=True)
                payload = encode(health)
            reported.append(health)
            self.publisher.put(payload)

        self.ending.run("reporting the last health", report, share)
        return reported[0] if reported else self._build(StageStatus.DEGRADED, with_counts=False, is_last=True)

    def lost(self) -> int:
        """Messages and samples that this process has lost."""
        return stage_losses(self.receiver.tracker.inputs(), self._counters(), may_drop=self.stage.may_drop)

    def _counters(self) -> Counter[str]:
        own = {
            **self.receiver.tracker.counters(),
            "lost_at_stop": self.lost_at_stop + self.sources.lost,
            "refused_requests": self.due.refused_requests,
            "refused_too_large": self.bus.refused_too_large,
            "refused_forged": self.bus.forgeries.count,
            "dropped": self.inbox.dropped,
        }
        counters = self.steps.counts + self.receiver.counts + Counter(own)  # without those that are 0
        for parts in self.parts.values():
            counters.update(parts.core.counters())
        return counters

    def _unsaved(self, cores: Sequence[Core]) -> Iterator[Envelope]:
        """What a kill would lose; at the end, what was received and there was no time to process."""
        return chain(tuple(self.due), *(core.unsaved() for core in cores))

    def _has_more(self, tray: str) -> bool:
        """Whether input waits from which more outputs of a tray may be made. A core that serves all trays takes any."""
        name = tray if tray in self.parts else ""
        return self.inbox.has_input(name) or (self.due.has(name) if name else bool(self.due))

    def _build(self, status: StageStatus, *, with_counts: bool = True, is_last: bool = False) -> Health:
        cores = [parts.core for parts in self.parts.values()] if with_counts else []
        tracker = self.receiver.tracker
        health = self.health.build(
            status=status,
            problems=[
                self.ending.problem,
                self.bus.certificate_warning(),
                self.bus.forgeries.problem(),
                tracker.problem(),
                *(core.problem() for core in cores),
            ],
            inputs=tracker.inputs(self._unsaved(cores)) if with_counts else (),
            outputs=self.outputs.counts(self._has_more) if with_counts else (),
            counters=self._counters() if with_counts else {},
            now_ns=HOST_CLOCK.now_ns(),
            notes=[*self._notes()] if with_counts else (),
            accepts=filter(None, (core.accepts() for core in cores)),
            learning=[*self._learning()] if with_counts else (),
        )
        return replace(health, header=Header(self.producer, self.publisher.published, ""), is_last=is_last)

    def _learning(self) -> Iterator[Learning]:
        for name, parts in self.parts.items():
            if learning := parts.core.learning():
                yield replace(learning, tray=name)

    def _notes(self) -> Iterator[Note]:
        if note := self.receiver.note():
            yield Note(tray="", text=note)
        for name, parts in self.parts.items():
            yield from (Note(tray=name, text=note) for note in parts.core.notes())

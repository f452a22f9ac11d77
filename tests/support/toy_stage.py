"""A stage that a test declares, run by a runner on a bus of its own."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fantwin.pipeline.bus.session import Bus
from fantwin.pipeline.config.shards import chosen_shard
from fantwin.pipeline.plugins import StageRow
from fantwin.pipeline.runtime.runner import Runner
from fantwin.pipeline.runtime.stage import BuiltStage, Context, Core, Stage, StageConfig
from fantwin.schemas.codec import decode, encode, type_name
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.header import Header
from fantwin.schemas.health import Health
from fantwin.schemas.messages import Grid, Message, Raw
from fantwin.schemas.topics import BY_NAME, health_key, tray_key
from tests.support.made_messages import filled

TRAY_A, TRAY_B = "a", "b"


class ToyConfig(StageConfig):
    """Nothing to configure."""


class Passer(Core):
    """Returns a Grid for each Raw, and one more at the end, so that a test sees that `close` was called."""

    def __init__(self) -> None:
        self.fans = 0

    def step(self, item: Any) -> Sequence[Message]:
        self.fans = item.fans
        return [self.grid(item.host_receive_t_ns)] if isinstance(item, Raw) else []

    def close(self) -> Sequence[Message]:
        return [self.grid(np.array([-1]))] if self.fans else []

    def counters(self):
        return {"lost_on_purpose": 2, "seen": 5}

    def problem(self) -> str:
        return ""

    def grid(self, t_ns: Any) -> Grid:
        return filled(Grid, len(t_ns), self.fans, period_ns=1, t_ns=t_ns)


class Silent(Passer):
    """Returns nothing."""

    def step(self, item: Any) -> Sequence[Message]:
        return []


class Burst:
    """A source that delivers its items while it is being stopped: the hardest moment."""

    def __init__(self, items: Sequence[Any]) -> None:
        self.items = items

    def start(self, deliver: Callable[[Any], None]) -> None:
        self.deliver = deliver

    def stop(self) -> None:
        for item in self.items:
            self.deliver(item)


def toy(build: Callable[[Context], BuiltStage] = lambda _context: BuiltStage(Passer()), **declared: Any) -> Stage:
    row: dict[str, Any] = {"name": "resampler", "declaration": "", "reads": ("raw",), "writes": ("grid",)}
    row |= {name: declared.pop(name) for name in ("name", "reads", "writes", "may_drop") if name in declared}
    return Stage(row=StageRow(**row), about="", config=ToyConfig, build=build, **declared)


def raw(t_ns: int) -> Raw:
    return filled(Raw, 1, 1, host_receive_t_ns=t_ns)


class Bench:
    """A stage running in a thread, and a second session on the bus that feeds it and listens."""

    def __init__(
        self, stage: Stage, config, tray: str | None = None, expects: type[Exception] = ZeroDivisionError
    ) -> None:
        """tray: as on the command line, one or several. expects: with what the stage may crash."""
        self._expects = expects
        self.stop = threading.Event()
        self.heard: queue.Queue[tuple[str, Message]] = queue.Queue()
        self._has_heard_its_last = threading.Event()
        self.bus = Bus(config.bus)
        self.bus.subscribe(tray_key("s", "*", "grid"), self._hear(Grid))
        self.bus.subscribe(health_key("s", "*", "*"), self._hear(Health))
        self.publisher = {
            name: self.bus.publisher(tray_key("s", name, "raw"), BY_NAME["raw"], type_name(Raw), "feeder")
            for name in (TRAY_A, TRAY_B)
        }
        self.runner = Runner(stage, config, chosen_shard(stage.name, config, tray), self.stop)
        self.last: list[Health] = []
        self.crashes: list[Exception] = []
        self.thread = threading.Thread(target=self._run)
        self.thread.start()
        self.health_with(lambda health: health.status == StageStatus.OK)

    def _run(self) -> None:
        try:
            self.last.append(self.runner.run())
        except self._expects as crash:
            self.crashes.append(crash)

    def _hear(self, kind: type[Message]) -> Callable[[str, bytes], None]:
        def hear(key: str, payload: bytes) -> None:
            message = decode(kind, payload)
            self.heard.put((key, message))
            if isinstance(message, Health) and message.is_last:
                self._has_heard_its_last.set()

        return hear

    def feed(self, tray: str, t_ns: int) -> None:
        """Publish one sample. Neighbours differ in their columns, so that a stage takes each by itself."""
        publisher = self.publisher[tray]
        sequence = np.array([t_ns]) if publisher.published % 2 else None
        sample = replace(raw(t_ns), header=Header("feeder", publisher.published, tray))
        publisher.put(encode(sample if sequence is None else replace(sample, device_sequence=sequence)))

    def next(self, kind: type[Message]) -> Any:
        while True:
            _, message = self.heard.get(timeout=20)
            if isinstance(message, kind):
                return message

    def health_with(self, fits: Callable[[Health], bool]) -> Health:
        while True:
            health = self.next(Health)
            if fits(health):
                return health

    def end(self) -> Health:
        self.stop.set()
        self.thread.join(20)
        assert self._has_heard_its_last.wait(20), "closing the bus drops what is on its way"
        self.bus.close()
        return self.last[0]

"""The core of a stage that shows a site to operators, fed with messages as the runner does; a scorer answers it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.runtime.stage import Context, Stage
from fantwin.pipeline.site.site_core import SiteCore
from fantwin.schemas.envelope import Envelope
from fantwin.schemas.header import Header
from fantwin.schemas.messages import Alarm, Message, Request, Score
from fantwin.schemas.topics import tray_key

SITE, TRAY, FANS = "hall", "tray1", 4
Fans = int | Sequence[Mapping[str, str]]
"""how many fans the tray has, or its entries [[tray.fan]]"""
TICK_S = 0.02
SECONDS_A_TICK = 1
"""of the time that the core is given"""
FIRST_ANSWER = 900
"""number of the message"""

CoreType = TypeVar("CoreType", bound=SiteCore)
Answer = Callable[[Request], list[Alarm]]


def tray_of(fans: Fans = FANS) -> TrayConfig:
    """The tray of the site."""
    given = {"fans": fans} if isinstance(fans, int) else {"fan": fans}
    return TrayConfig.model_validate({"name": TRAY, "speed_unit": "rpm", **given})


class RunningCore(Generic[CoreType]):
    """answer: what the scorer says to a request; the answers are passed back as the bus would."""

    def __init__(
        self, stage: Stage, config: Any, folder: Path, answer: Answer | None = None, fans: Fans = FANS, **more: Any
    ) -> None:
        """more: of the context."""
        self.producer = f"{stage.name}-all-0123"
        trays = (tray_of(fans),)
        context = replace(Context(SITE, trays, config, folder, folder, 0, producer=self.producer), **more)
        self.core: CoreType = stage.build(context).core  # type: ignore[assignment]
        self.sent: list[Request] = []
        self._answer = answer or (lambda _request: [])
        self._answers = 0
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._now_ns = 0
        self._is_closed = False
        self._thread = threading.Thread(target=self._tick, daemon=True)
        self._thread.start()

    def feed(self, *messages: Message) -> None:
        """Pass messages to the core: scores as envelopes."""
        with self._lock:
            for message in messages:
                is_score = isinstance(message, Score)
                self.core.step(Envelope.of(tray_key(SITE, TRAY, "score"), message, 0) if is_score else message)

    def problem(self) -> str:
        with self._lock:
            return self.core.problem()

    def counters(self) -> dict[str, int]:
        with self._lock:
            return dict(self.core.counters())

    def kill(self) -> None:
        """Nothing is sent any more, as if the process had died: connections stay."""
        self._ended.set()
        self._thread.join()

    def close(self) -> None:
        """Once, however often it is called."""
        if not self._is_closed:
            self._is_closed = True
            self.kill()
            self.core.close()

    def _tick(self) -> None:
        while not self._ended.wait(TICK_S):
            with self._lock:
                self._now_ns += SECONDS_A_TICK * 1_000_000_000
                for request in self.core.tick(self._now_ns):
                    assert isinstance(request, Request)
                    name = f"{self.producer}/{len(self.sent)}"
                    self.sent.append(request)
                    for alarm in self._answer(request):
                        header = Header("scorer-all-1", FIRST_ANSWER + self._answers, TRAY)
                        self._answers += 1
                        self.core.step(replace(alarm, request=name, header=header))

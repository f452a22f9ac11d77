"""A stage in a thread of this process, as the runner runs it."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Self

from fantwin.pipeline.config.settings import Config
from fantwin.pipeline.runtime.runner import Runner
from fantwin.pipeline.runtime.stage import Stage
from fantwin.schemas.enums import StageStatus
from fantwin.schemas.health import Health
from tests.support.running_chain import eventually


class RunningStage:
    """Runs from its beginning to `end`, or the end of a block; what it raised is raised then."""

    def __init__(self, stage: Stage, config: Config, shard: Any = None) -> None:
        self.healths: list[Health] = []
        """what it has sent, and its health at the end"""
        self._stop = threading.Event()
        self._error: BaseException | None = None
        self.runner = Runner(stage, config, shard, self._stop, self.healths.append)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_rest: object) -> None:
        self.end(raises=kind is None)

    @property
    def newest(self) -> Health | None:
        """The last health; None: none yet."""
        return self.healths[-1] if self.healths else None

    def counter(self, name: str) -> int:
        """Count as of the last health; 0 if it has none of this name."""
        counters = self.newest.counters if self.newest else ()
        return next((counter.value for counter in counters if counter.name == name), 0)

    def health_with(self, fits: Callable[[Health], bool], what: str) -> Health:
        """The first health from now on that fits."""
        return eventually(lambda: self.newest if self.newest and fits(self.newest) else None, what)

    def wait_until_ready(self) -> None:
        """Until its health says that it is at work."""
        self.health_with(lambda health: health.status == StageStatus.OK, "the stage is ready")

    def end(self, *, raises: bool = True) -> None:
        """Stop it and wait."""
        self._stop.set()
        self._thread.join()
        if raises and self._error is not None:
            raise self._error

    def _run(self) -> None:
        try:
            self.healths.append(self.runner.run())
        except BaseException as error:  # noqa: BLE001  raised again at the end
            self._error = error

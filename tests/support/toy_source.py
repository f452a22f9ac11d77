"""A whole source of samples in one file, as a new one would be written."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from fantwin.pipeline.sources.source import LinkUp, Reading, ReadingBatch, SourceConfig, SourceContext, SourceEvent
from fantwin.schemas.tacho import Tacho
from fantwin.schemas.units import NS_PER_S


class ToyConfig(SourceConfig, frozen=True):
    """`source = { kind = "toy", speeds = [...] }`."""

    kind: Literal["toy"] = "toy"
    speeds: tuple[float, ...]
    average_s: float | None = None

    @property
    def stated_tachos(self) -> tuple[Tacho, ...]:
        return () if self.average_s is None else (Tacho(kind="average", window_s=self.average_s),)


class ToySource:
    """Delivers a reading for each of the given speeds, all in the first second; accepts every command."""

    name = "toy"
    settings_to_check = "speeds"

    def __init__(self, config: ToyConfig, context: SourceContext) -> None:
        self._config, self._fans = config, context.fans
        self.sent: list[tuple[tuple[float, ...], tuple[float, ...]]] = []

    def start(self, deliver: Callable[[SourceEvent], None]) -> None:
        deliver(LinkUp())
        readings = (
            Reading((0.5,) * self._fans, (speed,) * self._fans, sequence=2 * number)
            for number, speed in enumerate(self._config.speeds)
        )
        deliver(ReadingBatch(NS_PER_S, tuple(readings)))

    def stop(self) -> None:
        pass

    def send(self, command: tuple[float, ...], set_point: tuple[float, ...]) -> str:
        self.sent.append((command, set_point))
        return ""

    def check(self) -> list[str]:
        return [] if self._config.speeds else ["toy: no speeds given"]

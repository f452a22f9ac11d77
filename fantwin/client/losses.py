"""What became of the samples that a client has published."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from fantwin.schemas.health import Health
from fantwin.schemas.streams import LOSS_PREFIX

REFUSED_KINDS = ("wrong_fan_count", "absurd_command", "time_order", "absurd_age", "second_client", "refused_readings")
"""counters of acquisition: samples that it refuses"""
LEAVE_GAPS = ("wrong_fan_count", "absurd_command", "time_order", "absurd_age")
GAPS = "on_line"
ELSEWHERE = ("refused", "commands")
"""losses that are refused samples, or none of samples"""
WITHOUT_SPEED = "absurd_speed"
"""counter of acquisition: speeds beyond `speed_max`, which it takes for missing ones"""


@dataclass(frozen=True)
class Losses:
    """Counts of samples since the client took up the tray.

    Attributes:
        published: taken by `publish`.
        received: of those, taken by acquisition.
        waiting: of those, kept here, or sent and not confirmed yet.
        not_kept: not taken by `publish`, which raised `NotKeptError`.
        refused: by acquisition, by reason (docs/reference/wire-protocol.md explains each).
        lost: on the way or in acquisition, by the names of its counters; `messages` counts messages of this client that
            it never got.
        absurd_speeds: single speeds beyond `speed_max` of the tray, which count as not measured.
    """

    published: int
    received: int
    waiting: int
    not_kept: int
    refused: Mapping[str, int] = field(default_factory=dict)
    lost: Mapping[str, int] = field(default_factory=dict)
    absurd_speeds: int = 0

    @property
    def any(self) -> bool:
        """Whether anything was refused or lost, or not kept."""
        return bool(self.not_kept or self.refused or self.lost)

    def __str__(self) -> str:
        parts = [f"{self.published} samples published, {self.received} received, {self.waiting} waiting"]
        parts += [f"{self.not_kept} not kept"] * (self.not_kept > 0)
        parts += [f"{count} refused ({kind})" for kind, count in self.refused.items()]
        parts += [f"{count} lost ({kind})" for kind, count in self.lost.items()]
        parts += [f"{self.absurd_speeds} speeds beyond speed_max"] * (self.absurd_speeds > 0)
        return ", ".join(parts)


class CountsOfAcquisition:
    """The counters of the sessions of acquisition, from when the client took up the tray."""

    def __init__(self, first: Health) -> None:
        """first: the health when the client took up the tray; what was counted before is not of this client."""
        self._first = {first.header.producer: _counters(first)}
        self._last: dict[str, dict[str, int]] = {}

    def add(self, health: Health, key: str, producer: str) -> None:
        """The newest health of a session. key, producer: of the stream of this client."""
        counters = _counters(health)
        missing = sum(line.missing for line in health.inputs if (line.key, line.producer) == (key, producer))
        before = self._first.get(health.header.producer, {})
        self._last[health.header.producer] = {name: n - before.get(name, 0) for name, n in counters.items()} | {
            f"{LOSS_PREFIX}messages": missing
        }

    def of(self, name: str) -> int:
        """A counter, over all sessions."""
        return max(0, sum(counts.get(name, 0) for counts in self._last.values()))

    def refused(self) -> dict[str, int]:
        """By reason, those that occurred."""
        return {name: self.of(name) for name in REFUSED_KINDS if self.of(name)}

    def lost(self) -> dict[str, int]:
        """By counter, those that occurred. The gap that a refused sample leaves in the numbers is not counted again."""
        names = sorted({name for counts in self._last.values() for name in counts if name.startswith(LOSS_PREFIX)})
        lost = {name.removeprefix(LOSS_PREFIX): self.of(name) for name in names}
        lost[GAPS] = lost.get(GAPS, 0) - sum(self.of(name) for name in LEAVE_GAPS)
        return {name: count for name, count in lost.items() if count > 0 and name not in ELSEWHERE}


def _counters(health: Health) -> dict[str, int]:
    return {counter.name: counter.value for counter in health.counters}

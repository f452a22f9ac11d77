"""What was decided, as people and machines read it: alarms from raised to cleared, and two such lists side by side."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from schemas.messages import Alarm


@dataclass(frozen=True)
class Episode:
    """An alarm from being raised to being cleared, or to the end: then `cleared_ns` is None."""

    tray: str
    fan: int
    raised_ns: int
    cleared_ns: int | None
    onset_ns: int
    severity: str
    residual_rad_s: float
    message: str

    def as_json(self) -> dict[str, Any]:
        """For machines; times in the recording's own clock, ns."""
        return {
            "tray": self.tray,
            "fan": self.fan,
            "raised_ns": self.raised_ns,
            "cleared_ns": self.cleared_ns,
            "onset_ns": self.onset_ns,
            "severity": self.severity,
            "residual": self.residual_rad_s,
            "message": self.message,
        }


def episodes(alarms: Iterable[Alarm]) -> list[Episode]:
    """The alarms of one or several trays, by the time they were raised.

    A session of the scorer that raises what an earlier one had raised and never cleared goes on with that alarm.
    """
    found: list[Episode] = []
    standing: dict[tuple[str, int], Alarm] = {}
    for alarm in sorted(alarms, key=lambda alarm: alarm.t_ns):
        fan = (alarm.header.tray, alarm.fan)
        if alarm.active:
            standing.setdefault(fan, alarm)
        elif fan in standing:
            found.append(_episode(standing.pop(fan), alarm.t_ns))
    found += [_episode(alarm, None) for alarm in standing.values()]
    return sorted(found, key=lambda episode: (episode.raised_ns, episode.tray, episode.fan))


@dataclass(frozen=True)
class WhatIf:
    """How one list of alarms differs from another. An alarm is in both where the same fan's overlap in time."""

    gained: list[Episode]
    lost: list[Episode]
    kept: list[Episode]
    """as they are now"""


def compare_episodes(now: list[Episode], before: list[Episode]) -> WhatIf:
    """What has been gained and lost since `before`."""
    kept = [episode for episode in now if any(_overlap(episode, other) for other in before)]
    return WhatIf(
        gained=[episode for episode in now if episode not in kept],
        lost=[other for other in before if not any(_overlap(other, episode) for episode in now)],
        kept=kept,
    )


def _overlap(one: Episode, other: Episode) -> bool:
    if (one.tray, one.fan) != (other.tray, other.fan):
        return False
    return _from(one) <= _to(other) and _from(other) <= _to(one)


def _from(episode: Episode) -> int:
    return episode.onset_ns


def _to(episode: Episode) -> int:
    return 2**63 if episode.cleared_ns is None else episode.cleared_ns


def _episode(alarm: Alarm, cleared_ns: int | None) -> Episode:
    return Episode(
        tray=alarm.header.tray,
        fan=alarm.fan,
        raised_ns=alarm.t_ns,
        cleared_ns=cleared_ns,
        onset_ns=alarm.onset_t_ns,
        severity=alarm.severity.name.lower(),
        residual_rad_s=alarm.residual_rad_s,
        message=alarm.message,
    )

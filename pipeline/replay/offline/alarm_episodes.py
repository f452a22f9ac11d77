"""What was decided, as people and machines read it: alarms from raised to cleared, and two such lists side by side."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from schemas.messages import Alarm, Diagnosis


@dataclass(frozen=True)
class Episode:
    """An alarm from being raised to being cleared, or to the end: then `cleared_ns` is None."""

    tray: str
    fan: int
    raised_ns: int
    cleared_ns: int | None
    onset_ns: int
    severity: str
    """the highest"""
    residual_rad_s: float | None
    torque_balance_command: float | None
    """as it was raised; None where none was known"""
    message: str
    causes: tuple[Diagnosis, ...]
    """as they were known last"""

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
            "torque_balance": self.torque_balance_command,
            "message": self.message,
            "causes": [asdict(cause) for cause in self.causes],
        }


def episodes(alarms: Iterable[Alarm]) -> list[Episode]:
    """The alarms of one or several trays, by the time they were raised.

    A session of the scorer that raises what an earlier one had raised and never cleared goes on with that alarm.
    """
    found: list[Episode] = []
    standing: dict[tuple[str, int], list[Alarm]] = {}
    for alarm in sorted(alarms, key=lambda alarm: alarm.t_ns):
        fan = (alarm.header.tray, alarm.fan)
        if alarm.active:
            standing.setdefault(fan, []).append(alarm)
        elif fan in standing:
            found.append(_episode([*standing.pop(fan), alarm], alarm.t_ns))
    found += [_episode(told, None) for told in standing.values()]
    return sorted(found, key=lambda episode: (episode.raised_ns, episode.tray, episode.fan))


@dataclass(frozen=True)
class AlarmDiff:
    """How one list of alarms differs from another. An alarm is in both where the same fan's overlap in time."""

    gained: list[Episode]
    lost: list[Episode]
    kept: list[Episode]
    """as they are now"""


def compare_episodes(now: list[Episode], before: list[Episode]) -> AlarmDiff:
    """What has been gained and lost since `before`."""
    kept = [episode for episode in now if any(_overlap(episode, other) for other in before)]
    return AlarmDiff(
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


def _episode(told: list[Alarm], cleared_ns: int | None) -> Episode:
    """told: all that was said of it, in order."""
    first = told[0]
    return Episode(
        tray=first.header.tray,
        fan=first.fan,
        raised_ns=first.t_ns,
        cleared_ns=cleared_ns,
        onset_ns=first.onset_t_ns,
        severity=max(alarm.severity for alarm in told).name.lower(),
        residual_rad_s=_known(first.residual_rad_s),
        torque_balance_command=_known(first.torque_balance_command),
        message=first.message,
        causes=next((alarm.causes for alarm in reversed(told) if alarm.causes), ()),
    )


def _known(value: float) -> float | None:
    """Of an alarm: a message holds 0 for what was not known, and what was is never so to the last bit."""
    return value or None

"""Alarm episodes, each from raised to cleared, and the comparison of two lists of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from schemas.messages import Alarm, Diagnosis
from scoring.alarms.current_alarms import words_of


@dataclass(frozen=True)
class Episode:
    """One alarm from raised to cleared; `cleared_ns` is None if it was active at the end."""

    tray: str
    fan: int
    raised_ns: int
    cleared_ns: int | None
    onset_ns: int
    severity: str
    """the highest"""
    residual_rad_s: float | None
    torque_balance_command: float | None
    """both when it was raised; None where unknown"""
    message: str
    causes: tuple[Diagnosis, ...]
    """the newest diagnosis"""

    def as_json(self) -> dict[str, Any]:
        """The JSON form; times on the recording's clock in ns."""
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
    """The episodes of one or several trays, in the order they were raised.

    If a scorer restarts without a snapshot and raises an alarm that its predecessor raised and did not clear, both
    are one episode.
    """
    found: list[Episode] = []
    open_alarms: dict[tuple[str, int], list[Alarm]] = {}
    for alarm in sorted(alarms, key=lambda alarm: alarm.t_ns):
        fan = (alarm.header.tray, alarm.fan)
        if alarm.active:
            open_alarms.setdefault(fan, []).append(alarm)
        elif fan in open_alarms:
            found.append(_episode([*open_alarms.pop(fan), alarm], alarm.t_ns))
    found += [_episode(alarms_of_fan, None) for alarms_of_fan in open_alarms.values()]
    return sorted(found, key=lambda episode: (episode.raised_ns, episode.tray, episode.fan))


@dataclass(frozen=True)
class AlarmDiff:
    """How two lists of episodes differ. An episode is in both if one of the same fan overlaps it in time."""

    gained: list[Episode]
    lost: list[Episode]
    kept: list[Episode]
    """in the new list, as they are there"""


def compare_episodes(now: list[Episode], before: list[Episode]) -> AlarmDiff:
    """The episodes that are gained, lost and kept compared with `before`."""
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


def _episode(messages: list[Alarm], cleared_ns: int | None) -> Episode:
    """messages: all of this episode, in order."""
    first = messages[0]
    return Episode(
        tray=first.header.tray,
        fan=first.fan,
        raised_ns=first.t_ns,
        cleared_ns=cleared_ns,
        onset_ns=first.onset_t_ns,
        severity=max(alarm.severity for alarm in messages).name.lower(),
        residual_rad_s=_known(first.residual_rad_s),
        torque_balance_command=_known(first.torque_balance_command),
        message=words_of(first),
        causes=next((alarm.causes for alarm in reversed(messages) if alarm.causes), ()),
    )


def _known(value: float) -> float | None:
    """None for 0.0, which a message holds where the value is unknown."""
    return value or None

"""Where everything lies in a view: the entities, and the two timelines."""

from __future__ import annotations

from collections.abc import Sequence

TIMELINE = "time"
"""of the samples and alarms"""
DAYS = "day"
"""the timeline of wear: its points are hours apart and go back to the commissioning"""
ALARMS_PATH = "site/alarms"
FLEET_LOG = "fleet/log"
WEAR = "wear"
FAN_PARTS = ("speed", "deviation", "outside", "not_scored")
BALANCE, SCORE = "balance", "score"
FANS_ON_A_PAGE = 8
"""Rerun draws a page of a hundred plots only seven times a second"""


def fan_path(tray: str, fan: int, part: str) -> str:
    """Entity of one fan below its tray.

    `part` is `speed` (measured, twin), `deviation`, `outside` or `not_scored`.
    """
    return f"{tray}/fan_{fan}/{part}"


def pages_of(fans: Sequence[int], size: int = FANS_ON_A_PAGE) -> list[Sequence[int]]:
    """The fans of a tray, a page at a time."""
    return [fans[start : start + size] for start in range(0, len(fans), size)]


def judged_path(tray: str, kind: str, page: int) -> str:
    """Entity of the torque balances or the scores of the fans of a page, side by side: one call for all of them. Of a
    fleet, each fan is a page of its own."""
    return f"{tray}/{kind}/page_{page}"


def state_path(tray: str, fan: int) -> str:
    """Entity of a fan's state lane."""
    return f"{tray}/state/fan_{fan}"


def auxiliary_path(tray: str, column: str, fan: int | None = None) -> str:
    """Entity of what a fan's source measures beside command and speed; without a fan, that of all fans."""
    return f"{tray}/{column}" if fan is None else f"{tray}/{column}/fan_{fan}"


def log_path(tray: str) -> str:
    """Entity of a tray's log."""
    return f"{tray}/log"


def wear_path(tray: str, fan: int | None = None) -> str:
    """Entity of the wear of a fan; without a fan, that of all fans of the tray."""
    return f"{WEAR}/{tray}" if fan is None else f"{WEAR}/{tray}/fan_{fan}"

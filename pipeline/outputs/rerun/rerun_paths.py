"""Where everything lies in a view: the entities, and the two timelines."""

from __future__ import annotations

from collections.abc import Sequence

TIMELINE = "time"
"""of the samples and alarms"""
DAYS = "day"
"""the timeline of wear: its points are hours apart and go back to the commissioning"""
STAGES_PATH = "stages"
ALARMS_PATH = "site/alarms"
FLEET_LOG = "fleet/log"
SHOWN = "shown"
WEAR = "wear"
FAN_PARTS = ("speed", "deviation", "outside", "not_scored")
BALANCE, SCORE = "balance", "score"
FANS_ON_A_PAGE = 8
"""Rerun draws a page of a hundred plots only seven times a second"""


def fan_path(root: str, fan: int, part: str) -> str:
    """Entity of one fan below the root of its tray, which is the tray's name but in a fleet.

    `part` is `speed` (measured, twin), `deviation`, `outside` or `not_scored`.
    """
    return f"{root}/fan_{fan}/{part}"


def pages_of(fans: Sequence[int]) -> list[Sequence[int]]:
    """The fans of a tray, a page at a time."""
    return [fans[start : start + FANS_ON_A_PAGE] for start in range(0, len(fans), FANS_ON_A_PAGE)]


def judged_path(tray: str, kind: str, page: int) -> str:
    """Entity of the torque balances or the scores of the fans of a page, side by side: one call for all of them."""
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


def place_root(place: int, tray: str) -> str:
    """In a fleet, the root of a tray's fans in plot number `place`."""
    return f"{SHOWN}/plot_{place}/{tray}"


def place_in(root: str) -> int | None:
    """The number of the plot whose root begins so; None: it is no root of a plot."""
    shown, _, name = root.partition("/")
    return int(name.removeprefix("plot_")) if shown == SHOWN and name.startswith("plot_") else None


def place_lane(place: int) -> str:
    """In a fleet, the entity of the state lane of plot number `place`."""
    return f"{SHOWN}/state/plot_{place}"


def place_beside(place: int, kind: str) -> str:
    """In a fleet, the entity of the fan in plot number `place`: its balance or score, or a column of its source."""
    return f"{SHOWN}/{kind}/plot_{place}"

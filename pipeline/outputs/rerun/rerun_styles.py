"""The entities and timelines of a view, and the colours, widths and names of its series.

The colours are legible on Rerun's dark and on its light background.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import rerun as rr

from fantwin.pipeline.site.trace import SILENT, state_names
from fantwin.schemas.fan_names import fan_label
from fantwin.schemas.units import SpeedUnit

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


Shown = TypeVar("Shown")


def pages_of(fans: Sequence[Shown], size: int = FANS_ON_A_PAGE) -> list[Sequence[Shown]]:
    """Fans, a page at a time."""
    return [fans[start : start + size] for start in range(0, len(fans), size)]


def judged_path(tray: str, kind: str, page: int) -> str:
    """Entity of the torque balances or the scores of the fans of a page, side by side: one call for all of them. Of a
    fleet, each fan is a page of its own."""
    return f"{tray}/{kind}/page_{page}"


def state_path(tray: str, fan: int, name: str) -> str:
    """Entity of a fan's state lane, which is called as the fan is."""
    return f"{tray}/state/{rr.escape_entity_path_part(fan_label(fan, name)) if name else f'fan_{fan}'}"


def auxiliary_path(tray: str, column: str, fan: int) -> str:
    """Entity of what a fan's source measures beside command and speed."""
    return f"{tray}/{column}/fan_{fan}"


def log_path(tray: str) -> str:
    """Entity of a tray's log."""
    return f"{tray}/log"


def wear_path(tray: str, fan: int | None = None) -> str:
    """Entity of the wear of a fan; without a fan, that of all fans of the tray."""
    return f"{WEAR}/{tray}" if fan is None else f"{WEAR}/{tray}/fan_{fan}"


LINE_WIDTH = 1.2
VIOLET = (160, 100, 250)
GREEN = (25, 160, 75)
RED = (240, 50, 50)
GREY = (135, 135, 135)
FAN_COLORS = (
    VIOLET,
    GREEN,
    (220, 110, 30),
    (30, 140, 210),
    (210, 80, 160),
    (140, 130, 40),
    (0, 150, 150),
    GREY,
)
"""of fans in one plot"""
STATE_COLORS = {
    "normal": (38, 150, 76),
    "suspect": (250, 178, 0),
    "alarm": (224, 36, 36),
    "returning": (232, 120, 60),
    "stopped": (70, 82, 104),
    "starting": (40, 160, 170),
    SILENT: (70, 70, 70),
}
UNKNOWN_COLOR = (110, 110, 110)


def speed_style(unit: SpeedUnit, width: float) -> rr.Measurements:
    """Style of the series of a fan's `speed`: measured, twin with band, and the lowest and highest ends of the band,
    which are not seen: an axis fits the lines, not the bands around them.

    Width 0 shows the band only.
    """
    twin = f"twin ± 2σ ({unit})"
    return rr.Measurements.from_fields(
        names=[f"measured ({unit})", twin, twin, twin],
        colors=[VIOLET, GREEN, GREEN, GREEN],
        widths=[width, width, 0.0, 0.0],
    )


def balance_style(fans: int, shown: int | None = None) -> rr.SeriesLines:
    """Style of the torque balances of some fans and what is expected of each; shown: of which alone, None: of all."""
    return rr.SeriesLines.from_fields(
        names=[*["torque balance"] * fans, *["expected"] * fans],
        colors=[*[VIOLET] * fans, *[GREEN] * fans],
        widths=LINE_WIDTH,
        visible_series=None if shown is None else [number % fans == shown for number in range(2 * fans)],
    )


def score_style(fans: int, shown: int | None = None) -> rr.SeriesLines:
    """Style of the scores of some fans, of their limit, and of a line above it that is not seen: without it the limit
    would be the edge of the plot. shown: of which fan alone, None: of all."""
    return rr.SeriesLines.from_fields(
        names=[*["score"] * fans, "limit", "limit"],
        colors=[*[VIOLET] * fans, RED, RED],
        widths=[*[LINE_WIDTH] * (fans + 1), 0.0],
        visible_series=None if shown is None else [number == shown or number >= fans for number in range(fans + 2)],
    )


def log_fan_styles(recording: rr.RecordingStream, tray: str, fan: int, unit: SpeedUnit, name: str) -> None:
    """Log the static names, colours and widths of the series and the lane of a fan."""
    names = state_names()
    styles = {
        fan_path(tray, fan, "speed"): speed_style(unit, LINE_WIDTH),
        fan_path(tray, fan, "deviation"): rr.Measurements.from_fields(names="area in alarm", colors=RED, widths=0.0),
        fan_path(tray, fan, "outside"): rr.SeriesPoints(names="dots outside band", colors=RED, marker_sizes=2.0),
        fan_path(tray, fan, "not_scored"): rr.SeriesLines(names="not scored", colors=GREY, widths=LINE_WIDTH),
        state_path(tray, fan, name): rr.StateConfiguration(
            values=names, colors=[STATE_COLORS.get(name, UNKNOWN_COLOR) for name in names]
        ),
    }
    for path, style in styles.items():
        recording.log(path, style, static=True)

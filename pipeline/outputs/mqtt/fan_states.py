"""The states of fans as retained texts, and which of them changed."""

from __future__ import annotations

import math
from typing import Any

from fantwin.pipeline.recordings.dates import format_utc
from fantwin.pipeline.site.fleet import Fan, FanGroup, FanNow
from fantwin.pipeline.site.site_model import SiteModel, TrayNow
from fantwin.schemas.units import RAD_S_PER_UNIT

AT_ONCE = ("state", "group", "in_alarm", "judged")
"""what of a state is published at once when it changes"""


class FanStates:
    """What was published last about each fan."""

    def __init__(self, model: SiteModel) -> None:
        self._model = model
        self._published: dict[Fan, dict[str, Any]] = {}

    def changed(self, *, is_full: bool, with_silent: bool) -> dict[Fan, dict[str, Any]]:
        """The states that are to be published now.

        is_full: also those of which only a number has changed. with_silent: also of trays that were never heard.
        """
        trays = {each.tray: each for each in self._model.trays_now()}
        found: dict[Fan, dict[str, Any]] = {}
        for now in self._model.every_fan():
            tray = trays.get(now.fan.tray)
            if tray is None and not with_silent and now.group not in (FanGroup.ALARM, FanGroup.SILENCED):
                continue
            state, before = self._state(now, tray), self._published.get(now.fan)
            if before is None or any(state[name] != before[name] for name in (state if is_full else AT_ONCE)):
                self._published[now.fan] = state
                found[now.fan] = state | {"time": format_utc(tray.t_ns) if tray else None}
        return found

    def _state(self, now: FanNow, newest: TrayNow | None) -> dict[str, Any]:
        tray = self._model.tray(now.fan.tray)
        assert tray is not None
        measured = predicted = math.nan
        judged = False
        if newest is not None and newest.is_heard:
            measured, predicted = newest.values[now.fan.number, :2].tolist()
            judged = bool(newest.is_judged[now.fan.number])
        unit = RAD_S_PER_UNIT[tray.speed_unit]
        return {
            "name": now.about.name,
            "place": now.about.place,
            "state": now.state,
            "group": str(now.group),
            "in_alarm": now.group == FanGroup.ALARM,
            "judged": judged,
            "score": _number(now.score),
            "speed": _number(measured / unit),
            "predicted_speed": _number(predicted / unit),
            "speed_unit": tray.speed_unit,
            "since": format_utc(now.since_t_ns) if now.since_t_ns else None,
        }


def _number(value: float) -> float | None:
    return float(f"{value:.4g}") if math.isfinite(value) else None

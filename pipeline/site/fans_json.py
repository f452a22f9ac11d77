"""The fans of a site as JSON: each with what it does now, how far it is off, and why."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fantwin.pipeline.config.settings import TrayConfig
from fantwin.pipeline.site.fan_history import CURVES
from fantwin.pipeline.site.fleet import Fan, FanGroup, FanNow
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.schemas.health import Learning, Sweep
from fantwin.schemas.messages import Array
from fantwin.schemas.units import RAD_S_PER_UNIT
from fantwin.scoring.alarms.alarm_text import deviation_in
from fantwin.scoring.alarms.current_alarms import CurrentAlarm
from fantwin.scoring.diagnosis.causes import CANNOT_TELL, likely_causes

MOST_LIVE = 256
"""fans whose speeds are in each live event of the fleet; of a larger site only those of fans in alarm"""
MOST_LIVE_ALARMS = 40
SPARK_S, SPARK_CURVES = 60, ("t_s", "measured", "predicted", "half_width")
_MEASURED, _PREDICTED, _HALF_WIDTH, _COMMAND = map(
    CURVES.index, ("measured_speed_rad_s", "predicted_speed_rad_s", "band_half_width_rad_s", "command")
)
_LEAST_PREDICTED_RAD_S = 1.0
"""a deviation in percent of a lower speed says nothing"""
_UNKNOWN = (None, None, None, None, None)

Row = tuple[float | None, float | None, float | None, float | None, float | None]
"""speed in the unit of the tray, command, deviation of the speed from the twin in percent, speed of the twin,
half width of its band; None: not known"""


def fans_json(model: SiteModel, fans: Sequence[FanNow]) -> list[dict[str, Any]]:
    """Fans of the site in this order."""
    rows, units = _rows(model), {tray.name: str(tray.speed_unit) for tray in model.trays}
    alarms = {(each.newest.header.tray, each.newest.fan): each for each in model.current_alarms()}
    learning = learning_json(model)
    found: list[dict[str, Any]] = []
    for now in fans:
        tray, number = now.fan
        of_tray = rows.get(tray)
        speed, command, deviation, *_ = of_tray[number] if of_tray else _UNKNOWN
        found.append(
            {
                "tray": tray,
                "fan": number,
                "name": now.about.name,
                "place": now.about.place,
                "state": now.state,
                "group": str(now.group),
                "score": None if math.isnan(now.score) else round(now.score, 4),
                "since_t_ns": now.since_t_ns,
                "in_alarm": now.group == FanGroup.ALARM,
                "speed": speed,
                "speed_unit": units[tray],
                "command": command,
                "deviation_percent": deviation,
                **_of_alarm(alarms.get((tray, number))),
                "learning": _of_fan(learning[tray], number) if tray in learning else None,
            }
        )
    return found


def live_fans(model: SiteModel) -> list[Fan]:
    """The fans whose speeds are live: all, or in a larger site those in alarm with the highest scores."""
    if sum(tray.fans for tray in model.trays) > MOST_LIVE:
        return model.in_alarm()[:MOST_LIVE_ALARMS]
    return [Fan(tray.name, number) for tray in model.trays for number in range(tray.fans)]


def live_values(model: SiteModel) -> dict[str, Any]:
    """Columns of `Row`, and the index of each fan's cell."""
    fans, begin = live_fans(model), 0
    rows = _rows(model) if fans else {}
    begins: dict[str, int] = {}
    for tray in model.trays:
        begins[tray.name], begin = begin, begin + tray.fans
    of_fans = [rows[fan.tray][fan.number] if fan.tray in rows else _UNKNOWN for fan in fans]
    names = ("speed", "command", "deviation_percent", "twin", "half_width")
    columns = {name: [row[at] for row in of_fans] for at, name in enumerate(names)}
    return {"fans": [begins[fan.tray] + fan.number for fan in fans], **columns}


def _rows(model: SiteModel) -> Mapping[str, Sequence[Row]]:
    """Of the fans of each tray that is heard."""
    per_unit = {tray.name: RAD_S_PER_UNIT[tray.speed_unit] for tray in model.trays}
    found: dict[str, Sequence[Row]] = {}
    for tray in model.trays_now():
        if tray.is_heard:
            measured, predicted, half_width, command = (
                tray.values[:, at] for at in (_MEASURED, _PREDICTED, _HALF_WIDTH, _COMMAND)
            )
            usual = np.where(predicted >= _LEAST_PREDICTED_RAD_S, predicted, np.nan)
            deviation = 100.0 * (measured - predicted) / usual
            speeds = (each / per_unit[tray.tray] for each in (predicted, half_width))
            columns = measured / per_unit[tray.tray], command, deviation, *speeds
            found[tray.tray] = list(zip(*map(_known, columns), strict=True))
    return found


def learning_json(model: SiteModel) -> dict[str, dict[str, Any]]:
    """What the first twin of each tray waits for, by tray; none of one that has a twin or is configured otherwise."""
    of_trays = [(model.tray(name), each) for name, each in model.learning().items()]
    return {tray.name: _of_learning(each, tray) for tray, each in of_trays if tray and len(each.fans) == tray.fans}


def _of_learning(learning: Learning, tray: TrayConfig) -> dict[str, Any]:
    return {
        "what": learning.what,
        "until_t_ns": learning.until_t_ns,
        "helps": learning.helps,
        "command": "" if tray.source.why_no_commands else f"fantwin command --tray {tray.name} --sweep",
        "sweep": sweep_json(learning.sweep) if learning.sweep else None,
        "fans": [{"progress": round(fan.progress, 4), "missing": fan.missing} for fan in learning.fans],
    }


def sweep_json(sweep: Sweep) -> dict[str, str]:
    """What an operator may ask of the learner of a tray."""
    return {"plan": sweep.plan, "running": sweep.running, "ended": sweep.ended}


def _of_fan(learning: Mapping[str, Any], number: int) -> dict[str, Any]:
    """What the first twin waits for, of one fan: what would help only where it lacks something."""
    fan = learning["fans"][number]
    helps = {name: learning[name] if fan["missing"] else "" for name in ("helps", "command")}
    return {**fan, "what": learning["what"], "until_t_ns": learning["until_t_ns"], **helps}


def _known(values: Array) -> list[float | None]:
    return [None if math.isnan(value) else float(f"{value:.5g}") for value in values.tolist()]


def _of_alarm(alarm: CurrentAlarm | None) -> dict[str, Any]:
    """Words of an active alarm; empty where there is none."""
    if alarm is None or not alarm.newest.active:
        return {"deviation": "", "cause": "", "probability": None}
    causes = alarm.causes
    return {
        "deviation": deviation_in(alarm.raised.about) if alarm.raised else "",
        "cause": likely_causes(causes),
        "probability": causes[0].probability if causes and causes[0].cause != CANNOT_TELL else None,
    }

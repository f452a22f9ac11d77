"""What is known about the site, as JSON: what the page, the API and the live events send."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from fantwin.pipeline.config.settings import FanConfig, TrayConfig
from fantwin.pipeline.recordings.clips.clip import Clip
from fantwin.pipeline.site.fan_history import Curves
from fantwin.pipeline.site.fans_json import SPARK_CURVES, SPARK_S, fans_json, learning_json, live_fans, live_values
from fantwin.pipeline.site.fleet import SHOWN_CLASSES, Fan
from fantwin.pipeline.site.site_model import SiteModel
from fantwin.pipeline.site.stage_states import StageState
from fantwin.schemas.channels import CHANNELS
from fantwin.schemas.enums import Feedback, Transition
from fantwin.schemas.messages import Alarm, Array, ModelCard
from fantwin.schemas.twin_card import CardError, TwinCard
from fantwin.schemas.units import NS_PER_S, RAD_S_PER_UNIT
from fantwin.scoring.alarms.alarm_state import is_listed
from fantwin.scoring.alarms.current_alarms import CurrentAlarm
from fantwin.scoring.calibration.calibration import together
from fantwin.scoring.diagnosis.causes import (
    CANNOT_TELL,
    advice,
    less_likely,
    likely_causes,
    likely_evidence,
    likely_with_share,
    short_name,
)

LEVELS, NO_LEVEL = 250, 255
"""a score of 1, at the limit, is level 100; what is not judged has none"""
_SPEEDS = 3
"""the first curves are speeds"""


def site_json(model: SiteModel, viewer_urls: Mapping[str, str]) -> dict[str, Any]:
    """What does not change while the gateway runs: the trays in the order of the cells, and what their classes mean:
    name, group, and what a fan with an alarm does now."""
    trays = [
        {
            "name": tray.name,
            "fans": tray.fans,
            "names": [fan.name for fan in tray.fan],
            "places": [fan.place for fan in tray.fan],
            "speed_unit": tray.speed_unit,
            "viewer_url": viewer_urls.get(tray.name, ""),
        }
        for tray in model.trays
    ]
    return {
        "site": model.site,
        "trays": trays,
        "classes": [each.name for each in SHOWN_CLASSES],
        "groups": [str(each.group) for each in SHOWN_CLASSES],
        "now": [each.now for each in SHOWN_CLASSES],
        "channels": [{"name": each.name, "title": each.title, "unit": each.unit} for each in CHANNELS],
        "level_at_limit": 100,
    }


def fleet_json(model: SiteModel) -> dict[str, Any]:
    """All fans at a glance: class and level of each cell, a byte each, in base64; speeds of the live fans; what the
    first twins wait for; and of silent trays, when the last sample came, 0 for never.
    """
    classes, score = model.fans_now()
    level = np.where(np.isnan(score), NO_LEVEL, (np.nan_to_num(score, posinf=9.0) * 100).clip(0, LEVELS))
    return {
        "classes": _packed(classes),
        "levels": _packed(level.astype(np.uint8)),
        "counts": model.counts(),
        "values": live_values(model),
        "learning": learning_json(model),
        "silent_since_t_ns": {
            tray.name: model.newest_t_ns(tray.name) for tray in model.trays if model.is_silent(tray.name)
        },
    }


def fan_in_full(model: SiteModel, fan: Fan) -> dict[str, Any]:
    """One fan with its alarm and its twin."""
    alarm, twin = model.current_alarm(fan), model.twin(fan.tray)
    return {
        **fans_json(model, [model.fan_now(fan)])[0],
        "newest_t_ns": model.newest_t_ns(fan.tray),
        "alarm": alarm_json(alarm, model.about(fan)) | {"now": model.words_now([fan])[0]} if alarm else None,
        "twin": twin_json(twin, fan.number) if twin else None,
        "wear": [_wear_json(row) for row in model.wear(fan)],
    }


def _wear_json(row: Mapping[str, Any]) -> dict[str, Any]:
    """Changes and limit are shares of the speed. t_ns: at which they hold."""
    shown = ("parameter", "unit", "change", "beside", "per_day", "days", "limit", "reached_t_ns", "unknown_reason")
    values = {name: row[name] for name in shown}
    return _without_nan({**values, "error": row["change_std_error"], "t_ns": row["seen_t_ns"]})


def _without_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_nan(each) for key, each in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def twin_json(card: ModelCard, fan: int) -> dict[str, Any]:
    """The twin in force, and the parameters of one fan that it uses."""
    try:
        found = TwinCard.from_json(card.card_json)
    except CardError:  # of a version that this one does not know
        shown = {}
    else:
        values = found.parameters[fan if fan < found.fans else 0]
        used = found.used_parameters or found.parameter_names
        shown = {name: value for name, value in zip(found.parameter_names, values, strict=True) if name in used}
    return {"name": card.twin, "kind": card.kind, "sha256": card.sha256, "since_t_ns": card.t_ns, "parameters": shown}


def curves_json(curves: Curves, tray: TrayConfig) -> dict[str, Any]:
    """Columns by name; speeds in the unit of the tray, null where nothing was measured or judged."""
    values = curves.values.astype(np.float64)
    values[:, :_SPEEDS] /= RAD_S_PER_UNIT[tray.speed_unit]
    names = ("measured", "predicted", "half_width", "torque_balance_command", "score", "command")
    columns = {name: _or_null(values[:, number]) for number, name in enumerate((*names, *curves.channels))}
    return {"speed_unit": tray.speed_unit, "t_s": (curves.t_ns / 1e9).round(3).tolist(), **columns}


def sparks_json(model: SiteModel) -> dict[str, Any]:
    """The last minute of the fans whose speeds are live, a sample a second: speed, twin and half width of its band."""
    sparks: list[dict[str, Any]] = []
    for fan in live_fans(model):
        tray, since_t_ns = model.tray(fan.tray), model.newest_t_ns(fan.tray) - SPARK_S * NS_PER_S
        assert tray, "live fans are of known trays"
        curves = model.history(fan, since_t_ns)
        _, each_second = np.unique(curves.t_ns // NS_PER_S, return_index=True)
        thinned = Curves(curves.t_ns[each_second], curves.values[each_second], curves.channels)
        found = curves_json(thinned, tray)
        sparks.append(
            {
                "tray": fan.tray,
                "fan": fan.number,
                "name": model.about(fan).name,
                **{name: found[name] for name in SPARK_CURVES},
            }
        )
    return {"fans": sparks}


def alarm_json(current: CurrentAlarm, about: FanConfig) -> dict[str, Any]:
    """A current alarm with what the page says of it. about: its fan. probability: of the first of the likely causes."""
    causes = current.causes
    return {
        **current.as_json(),
        "name": about.name,
        "place": about.place,
        "about": current.describing.about if current.describing else "",
        "listed": is_listed(current.newest),
        "states": current.states(),
        "cause": likely_causes(causes),
        "cause_with_share": likely_with_share(causes),
        "probability": causes[0].probability if causes and causes[0].cause != CANNOT_TELL else None,
        "evidence": likely_evidence(causes),
        "advice": advice(causes),
        "other_causes": [
            {"cause": short_name(each.cause), "probability": each.probability} for each in less_likely(causes)
        ],
    }


def alarms_json(model: SiteModel, *, everything: bool) -> dict[str, Any]:
    """All current alarms, each with what its fan does `now`. everything: also those that are over."""
    found = [each for each in model.current_alarms() if everything or is_listed(each.newest)]
    fans = [Fan(each.newest.header.tray, each.newest.fan) for each in found]
    of_each = zip(found, fans, model.words_now(fans), strict=True)
    return {"alarms": [alarm_json(each, model.about(fan)) | {"now": now} for each, fan, now in of_each]}


def clip_json(clip: Clip) -> dict[str, Any]:
    """A clip of alarms, for machines."""
    return {
        "name": clip.name,
        "tray": clip.tray,
        "since_t_ns": clip.since_ns,
        "until_t_ns": clip.until_ns,
        "bytes": clip.size_bytes,
        "acknowledged": clip.is_acknowledged,
        "problem": clip.problem,
        "alarms": [each.about() for each in clip.alarms],
    }


def mark_json(alarm: Alarm) -> dict[str, Any]:
    """What has happened to the alarm of a fan."""
    return {
        "name": alarm.fan_name,
        "onset_t_ns": alarm.onset_t_ns,
        "transition": alarm.transition.name.lower(),
        "severity": alarm.severity.name.lower(),
        "active": alarm.active,
        "message": alarm.message,
        "operator_name": alarm.operator_name,
        "comment": alarm.comment,
    }


def transition_json(number: int, alarm: Alarm, feedback: Feedback = Feedback.NONE) -> dict[str, Any]:
    """A transition of the history. feedback: the last one on its alarm."""
    return {
        "number": number,
        "t_ns": alarm.t_ns,
        "tray": alarm.header.tray,
        "fan": alarm.fan,
        **mark_json(alarm),
        "feedback": feedback.name.lower(),
        "causes": [{"cause": short_name(each.cause), "probability": each.probability} for each in alarm.causes],
    }


def rates_json(model: SiteModel) -> dict[str, Any]:
    """The rate of false alarms that really was beside the declared one, of each tray and of all."""
    rates = model.observed_rates()
    trays = {tray: rate.as_json() for tray, rate in rates.items()}
    return {"trays": trays, "site": together(list(rates.values())).as_json()}


def answers_json(answers: Sequence[Alarm]) -> dict[str, Any]:
    """The scorer's answers to a request, with an `error` if it has refused it for every fan."""
    body: dict[str, Any] = {
        "answers": [
            {
                "fan": each.fan,
                "name": each.fan_name,
                "transition": each.transition.name.lower(),
                "message": each.message,
            }
            for each in answers
        ]
    }
    is_refused = all(each.transition == Transition.REFUSED for each in answers)
    return {"error": answers[0].message} | body if is_refused else body


def stages_json(states: Iterable[StageState]) -> list[dict[str, Any]]:
    """The stages, in the order of the data flow."""
    return [_stage_json(state) for state in states]


def _stage_json(state: StageState) -> dict[str, Any]:
    view = state.view
    health = view.health if view else None
    return {
        "name": state.label,
        "state": str(state.word),
        "detail": state.detail or (health.problem if health else ""),
        "in_hz": round(view.rate_in_hz, 1) if view else 0.0,
        "out_hz": round(view.rate_out_hz, 1) if view else 0.0,
        "lost": health.lost if health else 0,
        "latency_p50_ms": _rounded(health.latency_p50_ms, 1) if health else 0.0,
        "latency_p99_ms": _rounded(health.latency_p99_ms, 1) if health else 0.0,
        "uptime_s": _rounded(health.uptime_s, 0) if health else 0.0,
        "notes": [f"{note.tray}: {note.text}" if note.tray else note.text for note in health.notes] if health else [],
    }


def _rounded(value: float, digits: int) -> float:
    """0 for what is no number: health is what its sender makes it."""
    return round(value, digits) if math.isfinite(value) else 0.0


def _or_null(values: Array) -> Sequence[float | None]:
    return [None if math.isnan(value) else float(f"{value:.5g}") for value in values.tolist()]


def _packed(values: Array) -> str:
    return base64.b64encode(values.tobytes()).decode()
